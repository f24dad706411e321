"""`NodeSupply`: starts nodes, lets them join, and gives them to pools."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from threading import RLock

from cavmarl.core.processes import is_fork
from cavmarl.engine.compilation import compiled_before
from cavmarl.engine.world_setup import World
from cavmarl.parallel.nodes.joining_nodes import ANYONE, JoiningNode, JoiningNodes
from cavmarl.parallel.nodes.leases import lease_ticks
from cavmarl.parallel.nodes.link import Link
from cavmarl.parallel.nodes.node_files import files_of
from cavmarl.parallel.nodes.node_starters import LocalNodes, Route, Start, start_nodes, straight
from cavmarl.parallel.nodes.node_system import MACHINE, NodeSystem
from cavmarl.parallel.placement.backend_name import BackendName
from cavmarl.parallel.worlds.journaled_worlds import without_journals
from cavmarl.parallel.worlds.local_worlds import LocalWorlds
from cavmarl.parallel.worlds.world_message import make_world_message

SPARES = 1  # additional nodes that may wait to replace a lost node


class NodeSupply:
    """The nodes for one or more pools, which may run in several threads.

    Attributes:
        count: number of nodes of all pools if none is lost.
        joining_nodes: nodes that have joined and belong to no pool.

    Raises:
        ConfigError: a setting that nodes do not support.
        MissingExtraError: Ray, or mpi4py, is not installed.
        WorkerError: a node cannot be started.
    """

    def __init__(
        self,
        world: World,
        base_dir: Path,  # folder of relative paths
        num_worlds: int,  # W of all pools
        backend: BackendName,
        in_next_step: bool,  # whether new episodes start a step later; see `SteppedWorlds`
        *,
        by_worlds: bool = False,  # whether each node hosts worlds of its own
        route: Route = straight,  # maps a place to the place to call instead
        system: NodeSystem = MACHINE,
        start: Start = start_nodes,  # starts the nodes
    ) -> None:
        config = world.config
        if not compiled_before():
            LocalWorlds(without_journals(world), 1, warm=True)
        self._join_timeout_s = config.workers.join_timeout_s
        self._lock, self._pid = RLock(), os.getpid()
        self._are_complete = False  # whether the pools have ever had all their nodes
        self._begun: list[int] = []  # process ids of the nodes of pools
        files = files_of(config, base_dir)
        self._starter, listener = start(backend, num_worlds, config.workers, base_dir, route)
        self.count = self._starter.count
        job = {
            "message": make_world_message(world, base_dir),
            "num_worlds": -(-num_worlds // self.count) if by_worlds else num_worlds,
            "in_next_step": in_next_step,
            "lease_ticks": lease_ticks(config),
        }
        self.joining_nodes = JoiningNodes(
            listener, job, files, self._room, world.partition.count, system
        )

    @property
    def is_here(self) -> bool:
        """True if this process has started the nodes on this machine."""
        return isinstance(self._starter, LocalNodes)

    def _room(self) -> int:
        return self.count - len(self._begun) + SPARES

    def look(self) -> bool:
        """Serve joining nodes; return whether a node is ready."""
        with self._lock:
            self.joining_nodes.look(0.0)
            self._restart_dropped()  # a node that cannot be restarted stays lost
            return bool(self.joining_nodes.ready)

    def take(
        self, num: int, trouble: Callable[[], None], waits: bool = True
    ) -> list[tuple[JoiningNode, Link]]:
        """Return ready nodes with their connections.

        Args:
            num: the number of nodes; if `waits` is false, there may be fewer.
            trouble: called while nodes are awaited.
            waits: whether to wait for the nodes.

        Raises:
            CavmarlError: a node has raised this error.
            WorkerError: the nodes do not join in time.
        """

        def why() -> str | None:
            trouble()
            return self._restart_dropped() or self._starter.trouble(self._begun)

        with self._lock:
            joining_nodes, wanted = self.joining_nodes, num
            while waits and len(self._usable()) < num:
                joining_nodes.await_ready(wanted, self._join_timeout_s, why)
                wanted = len(joining_nodes.ready) + 1
            found = [joining_nodes.take(number) for number in self._usable()[:num]]
            self._begun += [joining_node.pid for joining_node, _ in found]
            self._are_complete |= len(self._begun) == self.count
            return found

    def _restart_dropped(self) -> str | None:
        """Restart nodes that joined and sent a bad frame; return why that is impossible."""
        dropped = self.joining_nodes.dropped
        while dropped:
            node = dropped.pop()
            if why := self._starter.retry(node.asked, node.pid, False):
                return why
        return None

    def _usable(self) -> list[int]:
        """Return the ready nodes; spare nodes count only once the pools have been complete."""
        joining_nodes, spares = self.joining_nodes, range(self.count, ANYONE)
        ready = joining_nodes.ready
        return [n for n in ready if self._are_complete or joining_nodes.asked(n) not in spares]

    def replace(self, node: JoiningNode, is_silent: bool) -> None:
        """Start another node in place of a lost node."""
        with self._lock:
            self._begun.remove(node.pid)
            self._starter.replace(node.asked, is_silent)

    def retry(self, node: JoiningNode, is_silent: bool) -> str | None:
        """Restart a node that was lost before it had begun work; return why that is impossible."""
        with self._lock:
            self._begun.remove(node.pid)
            return self._starter.retry(node.asked, node.pid, is_silent)

    def stopped(self) -> set[int]:
        """Return the start numbers of nodes whose processes are stopped."""
        return self._starter.stopped()

    def close(self) -> None:
        """Dismiss waiting nodes and end the processes, unless this process is a fork."""
        if is_fork(self._pid):
            return
        self.joining_nodes.close()
        self._starter.close()
