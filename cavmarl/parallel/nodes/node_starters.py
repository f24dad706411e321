"""Starters of nodes: on this machine, by Ray, by MPI, or by hand on any machine."""

from __future__ import annotations

import subprocess
from collections.abc import Callable, Collection
from contextlib import suppress
from pathlib import Path
from typing import Any, TypeAlias

from cavmarl.config.workers import WorkersConfig
from cavmarl.core.errors import ConfigError, WorkerDeathError
from cavmarl.core.huge_pages import huge_heap
from cavmarl.core.private_files import check_private
from cavmarl.core.processes import end_process, start_python
from cavmarl.parallel.network.mpi_transport import MPI, MPI_CURE, mpi_transport
from cavmarl.parallel.network.ray_actors import RayActors
from cavmarl.parallel.network.tcp_transport import TcpListener
from cavmarl.parallel.network.transport import Place, TransportListener
from cavmarl.parallel.nodes.node_process import run_on_ray
from cavmarl.parallel.nodes.node_system import MACHINE, Machine, NodeSystem
from cavmarl.parallel.placement.backend_name import RAY, BackendName
from cavmarl.parallel.processes.watchdog import is_stopped

NODE = "cavmarl.parallel.nodes.local_node"  # the program of a node
LOOPBACK = "127.0.0.1"  # address for nodes of this machine
MIN_KEY = 32  # characters of a key file
END_S = 5.0  # time for nodes to end


Route: TypeAlias = Callable[[Place], Place]
"""Maps a place to the place to call instead, for example a forwarder that injects faults."""


def straight(place: Place) -> Place:
    """Return the place unchanged: the default `Route`."""
    return place


class NodeStarter:
    """Starts nodes, and replaces lost nodes. The base class serves nodes started by hand."""

    def __init__(self, count: int) -> None:
        self.count = count  # number of nodes

    def trouble(self, begun: Collection[int]) -> str | None:
        """Return why a node will not join; restart nodes that were killed before they began work.

        Args:
            begun: process ids of nodes that have begun work and need no check.
        """
        return None

    def retry(self, number: int, pid: int, is_silent: bool) -> str | None:
        """Restart a node that was lost before it had begun work; return why that is impossible."""
        self.replace(number, is_silent)
        return None

    def replace(self, number: int, is_silent: bool) -> None:
        """Replace a node that is lost, or silent and may still run.

        By default, do nothing: the pool waits for another node, which may be started by hand.
        """

    def stopped(self) -> set[int]:
        """Return the nodes whose processes are known to be stopped (SIGSTOP)."""
        return set()  # unknown on other machines

    def close(self) -> None:
        """End the nodes; by default, they end with their connections."""


class LocalNodes(NodeStarter):
    """Nodes as processes of this machine, which end with this process."""

    def __init__(
        self,
        nodes: int,
        listener: TcpListener,
        place: Place,
        max_retries: int,  # for nodes that are killed or stopped before they begin work
    ) -> None:
        super().__init__(nodes)
        self._listener, self._place = listener, place
        self._retries = max_retries
        self._seen_stopped: set[int] = set()
        self._processes: list[subprocess.Popen[Any]] = []
        try:
            self._processes = [self.start(number) for number in range(nodes)]
        except BaseException:
            self.close()
            raise

    def start(self, number: int) -> subprocess.Popen[Any]:
        """Start the process of a node."""
        arguments = map(str, (*self._place, number))
        # Huge pages pay off, because kept states and large frames are allocated again each time.
        process = start_python(
            ["-m", NODE, *arguments], huge_heap(), stdin=subprocess.PIPE, text=True
        )
        assert process.stdin is not None
        with suppress(BrokenPipeError), process.stdin as pipe:
            pipe.write(f"{self._listener.secret.hex()}\n")
        return process

    def trouble(self, begun: Collection[int]) -> str | None:
        stopped = {n for n in self.stopped() if self._processes[n].pid not in begun}
        for number in stopped & self._seen_stopped:  # stopped at two checks in a row
            self._processes[number].kill()
            self._processes[number].wait()
        self._seen_stopped = stopped
        for number, process in enumerate(self._processes):
            if process.pid not in begun and process.poll() is not None:
                is_killed = process.returncode < 0
                why = self.retry(number, process.pid, False) if is_killed else self._ended(number)
                if why is not None:
                    return why
        return None

    def retry(self, number: int, pid: int, is_silent: bool) -> str | None:
        if self._processes[number].pid != pid:  # the process was replaced already
            return None
        if self._retries == 0:
            return self._ended(number)
        self._retries -= 1
        self.replace(number, is_silent)
        return None

    def _ended(self, number: int) -> str:
        process = self._processes[number]
        process.kill()
        status = process.wait()
        cure = (
            "it was killed, by a user, for lack of memory, or because it did not answer: use "
            "fewer nodes, or raise workers.max_retries"
            if status < 0
            else "see its standard error"
        )
        return f"node {number} ended with exit status {status} before it had begun work; {cure}"

    def replace(self, number: int, is_silent: bool) -> None:
        self._processes[number].kill()
        self._processes[number].wait()
        self._processes[number] = self.start(number)

    def stopped(self) -> set[int]:
        return {n for n, process in enumerate(self._processes) if is_stopped(process.pid)}

    def close(self) -> None:
        for process in self._processes:
            end_process(process, END_S)
        self._processes = []


class RayNodes(NodeStarter):
    """Nodes as actors of a Ray cluster."""

    def __init__(
        self,
        actors: RayActors,
        listener: TcpListener,
        max_retries: int,  # for nodes that are lost before they begin work
    ) -> None:
        super().__init__(actors.workers)
        self._actors = actors
        self._retries = max_retries
        actors.start(listener.place, listener.secret)

    def trouble(self, begun: Collection[int]) -> str | None:
        return self._actors.trouble()

    def retry(self, number: int, pid: int, is_silent: bool) -> str | None:
        if self._retries == 0:
            return (
                f"node {number}, an actor of Ray, was lost before it had begun work, more often "
                "than workers.max_retries allows; `ray logs` has its output: remove the reason, or "
                "raise workers.max_retries"
            )
        self._retries -= 1
        self.replace(number, is_silent)
        return None

    def replace(self, number: int, is_silent: bool) -> None:
        if is_silent:
            self._actors.restart(number)
        else:  # Ray restarts it
            self._actors.trouble()

    def close(self) -> None:
        self._actors.close()


class MpiNodes(NodeStarter):
    """Nodes as the other ranks of an MPI run, which has no failover.

    Raises:
        ConfigError: this process is not rank 0, or there are too few other ranks.
    """

    def __init__(self, nodes: int) -> None:
        super().__init__(nodes)
        mpi_transport().check_caller(nodes)

    def retry(self, number: int, pid: int, is_silent: bool) -> str | None:
        mpi_transport().is_broken = True
        return f"rank {number + 1} was lost before it had begun work: {MPI_CURE}"

    def replace(self, number: int, is_silent: bool) -> None:
        """Raise WorkerDeathError: a lost rank cannot be replaced."""
        mpi_transport().is_broken = True
        cause = "it does not answer" if is_silent else "its connection has ended"
        part = f"rank {number + 1} of MPI, which has no failover"
        raise WorkerDeathError(number, part, 0, "step", [cause], MPI_CURE)


Start: TypeAlias = Callable[
    [BackendName, int, WorkersConfig, Path, Route], tuple[NodeStarter, TransportListener]
]
"""Starts nodes like `start_nodes`, with the same arguments."""


def start_nodes(
    backend: BackendName,
    num_worlds: int,  # limit on the number of Ray actors if the backend names no number
    settings: WorkersConfig,
    base_dir: Path,  # folder of a relative key file
    route: Route,  # maps the place of the listener to the place that nodes of this machine call
) -> tuple[NodeStarter, TransportListener]:
    """Start nodes, which will call the listener.

    Raises:
        ConfigError: the key file is unusable, or MPI has too few ranks.
        MissingExtraError: Ray, or mpi4py, is not installed.
        WorkerError: the process cannot listen on the port, or cannot start nodes.
    """
    nodes = backend.count or 1
    if backend.kind == RAY:
        at_most = backend.count or num_worlds
        actors = RayActors(run_on_ray, backend.count, at_most)
        listener = TcpListener(actors.address)
        return RayNodes(actors, listener, settings.max_retries), listener
    if backend.address is None:
        listener = TcpListener(LOOPBACK)
        return LocalNodes(nodes, listener, route(listener.place), settings.max_retries), listener
    if backend.address == MPI:
        return MpiNodes(nodes), mpi_transport().listen("", b"")
    host, port = backend.address
    if not settings.key_file:
        raise ConfigError(
            f"backend = '{backend}' without workers.key_file: set it to the file with the key that "
            "nodes have to know"
        )
    return NodeStarter(nodes), TcpListener(host, read_key(base_dir / settings.key_file), port)


def system_of(backend: BackendName) -> NodeSystem:
    """Return the system of the nodes of a backend."""
    return Machine(mpi_transport()) if backend.is_mpi else MACHINE


def read_key(path: Path) -> bytes:
    """Read a key from a file that only this user can read.

    Raises:
        ConfigError: the file cannot be read, is too short, or other users can read it.
    """
    make = "make one: (umask 077; openssl rand -hex 32 > FILE), the same file on all machines"
    try:
        check_private("key file", path)
        with open(path, "rb") as file:
            key = file.read(1 << 16).strip()
    except OSError as error:
        raise ConfigError(f"key file {path}: {error.strerror or error}; {make}") from error
    if len(key) < MIN_KEY:
        raise ConfigError(f"key file {path}: has {len(key)} of {MIN_KEY} characters; {make}")
    return key
