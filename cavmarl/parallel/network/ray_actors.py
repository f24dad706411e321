"""`RayActors`: hosts as Ray's actors; Ray starts them, and starts them again."""

from __future__ import annotations

import weakref
from collections.abc import Callable, Sequence
from typing import Any

from cavmarl.core.errors import WorkerError, require
from cavmarl.parallel.network.ray_cluster import choose_nodes, join, leave, nodes_with

ENDS_S = 3.0  # for actors to return by themselves: Ray prints a complaint for each that is killed
SPARES = 1  # hosts that wait for another one's death: a new actor takes seconds

Main = Callable[[tuple[str, int], bytes, int], None]


class RayHost:
    """The actor: its one call lasts as long as it lives."""

    def run(self, main: Main, place: tuple[str, int], secret: bytes, number: int) -> None:
        main(place, secret, number)


class RayActors:
    """Actors on the nodes of a Ray cluster.

    An actor that dies is started again by Ray, on its node or, if that one is gone, on another one,
    and makes the same call again. Ray carries no step: it hands over what to run, where the caller
    is, and the secret.

    Attributes:
        address: of this node.
        workers: how many there are.

    Raises:
        MissingExtraError: Ray is not installed.
        ConfigError: this program is not on a node, or there are too few CPUs.
        NoAdmissibleWorkerError: all nodes are too busy.
        WorkerError: no cluster.
    """

    def __init__(
        self,
        main: Main,  # what each runs; a function of a module, which every node has to have
        workers: int | None,  # actors with a CPU of their own; None: as many as there are free CPUs
        at_most: int,  # so many are of use
    ) -> None:
        self._main = main
        self._actors: list[Any] = []
        self._calls: list[Any] = []
        self._ray: Any = require("ray", "ray")
        has_joined = join()
        self._finalizer = weakref.finalize(
            self, _end, self._ray, self._actors, self._calls, has_joined
        )
        try:
            known = nodes_with(at_most if workers is None else workers)
            free = sum(node.cpus for node in known)
            self.workers = max(1, min(free, at_most)) if workers is None else workers
            # A spare one here does not die with the node of another one.
            self._nodes = [*choose_nodes(known, self.workers), *[known[0].name] * SPARES]
            self.address: str = self._ray.util.get_node_ip_address()
        except BaseException:
            self.close()
            raise

    def start(self, place: tuple[str, int], secret: bytes) -> None:
        for number, node in enumerate(self._nodes):
            try:
                self._start(number, node, place, secret)
            except self._ray.exceptions.RayError as error:
                raise WorkerError(f"Ray cannot start host {number}: {error}") from error

    def _start(self, number: int, node: str, place: tuple[str, int], secret: bytes) -> None:
        strategies = self._ray.util.scheduling_strategies
        actor = self._ray.remote(RayHost).options(
            num_cpus=1 if number < self.workers else 0,
            max_restarts=-1,
            max_task_retries=-1,
            scheduling_strategy=strategies.NodeAffinitySchedulingStrategy(node, soft=True),
        )
        self._actors.append(actor.remote())
        call = self._actors[-1].run.remote(self._main, place, secret, number)
        self._calls.append(call)

    def restart(self, number: int) -> None:
        """End one that may still run; Ray starts it again."""
        self._ray.kill(self._actors[number], no_restart=False)

    def trouble(self) -> str | None:
        """Why a host does not come: its call has ended."""
        ended, _ = self._ray.wait(self._calls, num_returns=len(self._calls), timeout=0)
        for call in ended:
            try:
                self._ray.get(call)
            except self._ray.exceptions.RayError as error:
                return str(error)
        return None

    def close(self) -> None:
        """End all of them; leave the cluster if no other part needs it."""
        self._finalizer()


def _end(ray: Any, actors: Sequence[Any], calls: Sequence[Any], has_joined: bool) -> None:
    if not ray.is_initialized():  # the program has ended it
        return
    if calls:
        ray.wait(calls, num_returns=len(calls), timeout=ENDS_S)
    for actor in actors:
        ray.kill(actor, no_restart=True)
    if has_joined:
        leave()
