"""What starts nodes: this machine, Ray, MPI, or a command by hand on any machine."""

from __future__ import annotations

import subprocess
from collections.abc import Callable, Collection
from contextlib import suppress
from pathlib import Path
from typing import Any, Protocol, TypeAlias

from cavmarl.config.workers import WorkersConfig
from cavmarl.core.errors import ConfigError, WorkerDeathError
from cavmarl.core.huge_pages import huge_heap
from cavmarl.core.processes import start_python
from cavmarl.parallel.network.mpi_transport import MPI, mpi_transport
from cavmarl.parallel.network.ray_actors import RayActors
from cavmarl.parallel.network.tcp_transport import TcpListener
from cavmarl.parallel.network.transport import Place, TransportListener
from cavmarl.parallel.nodes.node_process import run_on_ray
from cavmarl.parallel.nodes.node_system import MACHINE, Machine, NodeSystem
from cavmarl.parallel.placement.backend_name import RAY, BackendName
from cavmarl.parallel.processes.watchdog import is_stopped

NODE = "cavmarl.parallel.nodes.local_node"  # the program of a node
LOOPBACK = "127.0.0.1"  # where nodes of this machine meet
MIN_KEY = 32  # characters of a key file
END_S = 5.0  # for nodes to end by themselves


Route: TypeAlias = Callable[[Place], Place]


def straight(place: Place) -> Place:
    """Where to call in order to reach a place: there."""
    return place


class NodeStarter(Protocol):
    """Starts nodes, and starts others in the place of those that are lost."""

    @property
    def count(self) -> int:
        """How many nodes there are to be."""
        ...

    def trouble(self, begun: Collection[int]) -> str | None:
        """Why a node does not come, in words; one that was killed before it began begins again.

        Args:
            begun: processes of the nodes that have begun, which are not looked at.
        """
        ...

    def retry(self, number: int, pid: int, is_silent: bool) -> str | None:
        """Start one again that was lost before it had begun; else why not, in words."""
        ...

    def replace(self, number: int, is_silent: bool) -> None:
        """One is lost, or silent, and may still run."""
        ...

    def stopped(self) -> set[int]:
        """Nodes whose processes are stopped (SIGSTOP), as far as that can be seen."""
        ...

    def close(self) -> None: ...


class LocalNodes:
    """Processes of this machine, which end with this one."""

    def __init__(
        self,
        nodes: int,
        listener: TcpListener,
        place: Place,
        max_retries: int,  # of nodes that are killed or stopped before they have begun
    ) -> None:
        self.count = nodes
        self._listener, self._place = listener, place
        self._retries = max_retries
        self._seen_stopped: set[int] = set()
        self._processes: list[subprocess.Popen[Any]] = []
        try:
            self._processes = [self._start(number) for number in range(nodes)]
        except BaseException:
            self.close()
            raise

    def _start(self, number: int) -> subprocess.Popen[Any]:
        told = map(str, (*self._place, number))
        # States that are kept, and large frames, are new memory each time.
        process = start_python(["-m", NODE, *told], huge_heap(), stdin=subprocess.PIPE, text=True)
        assert process.stdin is not None
        with suppress(BrokenPipeError), process.stdin as pipe:
            pipe.write(f"{self._listener.secret.hex()}\n")
        return process

    def trouble(self, begun: Collection[int]) -> str | None:
        stopped = {n for n in self.stopped() if self._processes[n].pid not in begun}
        for number in stopped & self._seen_stopped:  # at two looks
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
        if self._processes[number].pid != pid:  # another one has been started already
            return None
        if self._retries == 0:
            return self._ended(number)
        self._retries -= 1
        self.replace(number, is_silent)
        return None

    def _ended(self, number: int) -> str:
        process = self._processes[number]
        process.kill()
        return (
            f"node {number} ended with {process.wait()} before it had begun; what it printed "
            "stands on standard error"
        )

    def replace(self, number: int, is_silent: bool) -> None:
        self._processes[number].kill()
        self._processes[number].wait()
        self._processes[number] = self._start(number)

    def stopped(self) -> set[int]:
        return {n for n, process in enumerate(self._processes) if is_stopped(process.pid)}

    def close(self) -> None:
        for process in self._processes:
            with suppress(subprocess.TimeoutExpired):
                process.wait(END_S)
            process.kill()
            process.wait()
        self._processes = []


class RayNodes:
    """Actors of a Ray cluster."""

    def __init__(
        self,
        actors: RayActors,
        listener: TcpListener,
        max_retries: int,  # of nodes that are lost while they are given their zones
    ) -> None:
        self._actors = actors
        self.count = actors.workers
        self._retries = max_retries
        actors.start(listener.place, listener.secret)

    def trouble(self, begun: Collection[int]) -> str | None:
        return self._actors.trouble()

    def retry(self, number: int, pid: int, is_silent: bool) -> str | None:
        if self._retries == 0:
            return f"node {number}, an actor of Ray, was lost before it had begun"
        self._retries -= 1
        self.replace(number, is_silent)
        return None

    def replace(self, number: int, is_silent: bool) -> None:
        if is_silent:
            self._actors.restart(number)
        else:  # Ray starts it again
            self._actors.trouble()

    def stopped(self) -> set[int]:
        return set()  # Ray does not say

    def close(self) -> None:
        self._actors.close()


class MpiNodes:
    """The other ranks of an MPI run, which has no failover.

    Raises:
        ConfigError: this process is not rank 0, or there are too few others.
    """

    def __init__(self, nodes: int) -> None:
        self.count = nodes
        mpi_transport().check_caller(nodes)

    def trouble(self, begun: Collection[int]) -> str | None:
        return None

    def retry(self, number: int, pid: int, is_silent: bool) -> str | None:
        mpi_transport().is_broken = True
        return f"rank {number + 1} was lost before it had begun: MPI has no failover"

    def replace(self, number: int, is_silent: bool) -> None:
        """Raises WorkerDeathError: none takes the place of a lost rank."""
        mpi_transport().is_broken = True
        cause = "it says nothing" if is_silent else "its connection has ended"
        raise WorkerDeathError(
            number, f"rank {number + 1} of MPI, which has no failover", 0, "step", [cause]
        )

    def stopped(self) -> set[int]:
        return set()  # they may be on other machines

    def close(self) -> None:
        """They end with the connection."""


class JoinedNodes:
    """Nodes that are started by hand: `cavmarl node --join`."""

    def __init__(self, count: int) -> None:
        self.count = count

    def trouble(self, begun: Collection[int]) -> str | None:
        return None

    def retry(self, number: int, pid: int, is_silent: bool) -> str | None:
        """Another one is awaited."""
        return None

    def replace(self, number: int, is_silent: bool) -> None:
        """Another one may be started by hand."""

    def stopped(self) -> set[int]:
        return set()  # they are on other machines

    def close(self) -> None:
        """They end with the connection."""


Start: TypeAlias = Callable[
    [BackendName, int, WorkersConfig, Path, Route], tuple[NodeStarter, TransportListener]
]
"""Begins to start nodes; arguments as of `start_nodes`."""


def start_nodes(
    backend: BackendName,  # nodes of this machine, Ray or MPI, or that are started by hand
    num_worlds: int,  # so many actors of Ray are of use where the backend does not say how many
    settings: WorkersConfig,
    base_dir: Path,  # the folder that a relative key file starts from
    route: Route,  # for nodes of this machine
) -> tuple[NodeStarter, TransportListener]:
    """Begin to start nodes; they call the listener.

    Raises:
        ConfigError: a key file that cannot be, or MPI without as many other ranks.
        MissingExtraError: Ray, or mpi4py, is not installed.
        WorkerError: the port cannot be listened on, or nodes cannot be started.
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
            f"backend = '{backend}' without workers.key_file: name the file with the key that "
            "nodes have to know"
        )
    return JoinedNodes(nodes), TcpListener(host, read_key(base_dir / settings.key_file), port)


def system_of(backend: BackendName) -> NodeSystem:
    """Return the system that such nodes are on."""
    return Machine(mpi_transport()) if backend.is_mpi else MACHINE


def read_key(path: Path) -> bytes:
    """The key of a file, which this user alone can read.

    Raises:
        ConfigError: it cannot be read, is too short, or others can read it.
    """
    make = "make one: (umask 077; openssl rand -hex 32 > FILE), the same file on all machines"
    try:
        with open(path, "rb") as file:
            key, mode = file.read(1 << 16).strip(), path.stat().st_mode
    except OSError as error:
        raise ConfigError(f"key file {path}: {error.strerror or error}; {make}") from error
    if mode & 0o077:
        raise ConfigError(f"key file {path}: others can read it; chmod 600 {path}")
    if len(key) < MIN_KEY:
        raise ConfigError(f"key file {path}: has {len(key)} of {MIN_KEY} characters; {make}")
    return key
