"""Where worlds run: backends by name, and how one is chosen."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Protocol

from cavmarl.core.errors import ConfigError
from cavmarl.engine.world_setup import World, check_workers
from cavmarl.parallel.hosts.remote_worlds import RemoteWorlds
from cavmarl.parallel.network.mpi_transport import MPI
from cavmarl.parallel.nodes.node_starters import place_of, system_of
from cavmarl.parallel.nodes.node_worlds import NodeWorlds
from cavmarl.parallel.pooled_worlds import PooledWorlds
from cavmarl.parallel.sensor_workers.sensor_worker_setup import local_worlds
from cavmarl.parallel.step_arrays import SteppedWorlds

LOCAL, PROCESSES, RAY, NODES = "local", "processes", "ray", "nodes"
AT = "@"  # between `nodes` and where they are started


class MakeWorlds(Protocol):
    def __call__(
        self,
        world: World,  # what each is made of
        base_dir: Path,  # the folder that its relative files start from
        num_worlds: int,  # W
        workers: int | None,  # how many run them; None: as many as are of use
        in_next_step: bool,  # when worlds begin anew; see `SteppedWorlds`
    ) -> SteppedWorlds:
        """Worlds that are stepped together."""
        ...


@dataclass(frozen=True)
class Backend:
    make: MakeWorlds  # makes them there
    # whether the number of workers, or the name in its place, has to be given
    needs_workers: bool = False
    # whether the caller can have the state of so many worlds with so many workers, to draw it
    shows_state: Callable[[int, int | None], bool] = lambda num_worlds, workers: False


def _is_split(num_worlds: int, workers: int | None) -> bool:
    """Whether there are more workers than worlds: each hosts some zones of all of them."""
    return workers is not None and workers > num_worlds


def _always(num_worlds: int, workers: int | None) -> bool:
    return True


def _local(
    world: World, base_dir: Path, num_worlds: int, workers: int | None, in_next_step: bool
) -> SteppedWorlds:
    return local_worlds(world, base_dir, num_worlds, in_next_step)


def _processes(
    world: World, base_dir: Path, num_worlds: int, workers: int | None, in_next_step: bool
) -> SteppedWorlds:
    return PooledWorlds(world, base_dir, num_worlds, int(workers or 1), in_next_step)


def _ray(
    world: World, base_dir: Path, num_worlds: int, workers: int | None, in_next_step: bool
) -> SteppedWorlds:
    if workers is not None and _is_split(num_worlds, workers):
        return NodeWorlds(world, base_dir, num_worlds, workers, in_next_step, RAY)
    return RemoteWorlds(world, base_dir, num_worlds, workers, in_next_step)


def _nodes(
    world: World,
    base_dir: Path,
    num_worlds: int,
    workers: int | None,
    in_next_step: bool,
    hosts: str = "",
) -> SteppedWorlds:
    return NodeWorlds(
        world, base_dir, num_worlds, int(workers or 1), in_next_step, hosts, system=system_of(hosts)
    )


_BACKENDS = {
    LOCAL: Backend(_local, shows_state=_always),
    PROCESSES: Backend(_processes, needs_workers=True, shows_state=_always),
    RAY: Backend(_ray, needs_workers=True, shows_state=_is_split),
    NODES: Backend(_nodes, needs_workers=True, shows_state=_always),
}
_OWN = frozenset(_BACKENDS)


def register_backend(name: str, make: MakeWorlds) -> None:
    """Add a place where worlds run, which `hosts` of `make_vec` and `parallel_env` can name.

    Args:
        name: of the backend.
        make: makes worlds there; what they do must be what the worlds of this process do.

    Raises:
        ConfigError: the name is taken or no name.
    """
    if not name.isidentifier():
        raise ConfigError(f"backend {name!r}: must be a name of letters, digits and _")
    if name in _OWN:
        raise ConfigError(f"backend '{name}': one of cavmarl's own; take another name")
    _BACKENDS[name] = Backend(make)


def places_of(
    workers: int | str | None, hosts: str | None, nodes: int | None
) -> tuple[int | str | None, str | None]:
    """`workers` and `hosts` where worlds may be over nodes instead; `_backend` reads them."""
    if nodes is None:
        return workers, hosts
    if workers:
        raise ConfigError(
            f"nodes = {nodes!r} with workers = {workers!r}: nodes are processes of their own; "
            "leave one out"
        )
    if hosts not in (None, RAY, MPI):
        place_of(str(hosts))
    if not check_workers(nodes):
        raise ConfigError(f"nodes = {nodes!r}: must be 1 or more; leave it out for this process")
    return nodes, NODES if hosts is None else f"{NODES}{AT}{hosts}"


def _backend(name: str) -> Backend | None:
    """The one of a name, which for nodes may say where they are started."""
    kind, _, where = name.partition(AT)
    if where and kind == NODES:
        return replace(_BACKENDS[NODES], make=partial(_nodes, hosts=where))
    return _BACKENDS.get(name)


def check_hosts(workers: int | str | None, hosts: str | None) -> tuple[str, int | None]:
    """The backend that both name, and its number of workers, None where it finds that out."""
    known = ", ".join(f"'{name}'" for name in sorted(_BACKENDS, key=lambda name: name != RAY))
    if hosts is not None and _backend(hosts) is None:
        raise ConfigError(f"hosts = {hosts!r}: must be {known}, or None for this machine")
    if isinstance(workers, str) and (workers not in _BACKENDS or workers in (LOCAL, PROCESSES)):
        names = ", ".join(f"'{name}'" for name in _BACKENDS if name not in (LOCAL, PROCESSES))
        raise ConfigError(f"workers = {workers!r}: must be a whole number, or {names}")
    if isinstance(workers, str):
        if hosts not in (None, workers):
            raise ConfigError(f"workers = {workers!r} with hosts = {hosts!r}: name one of both")
        return workers, None
    number = check_workers(workers)
    if hosts is None:
        return (PROCESSES, number) if number else (LOCAL, 0)
    if hosts == LOCAL and number:
        raise ConfigError(
            f"hosts = 'local' with workers = {number}: it has none; name 'processes', or leave "
            "one out"
        )
    backend = _backend(hosts)
    if backend is not None and backend.needs_workers and not number:
        by_name = "" if hosts in _OWN - {RAY} else f", or workers='{hosts}'"
        raise ConfigError(f"hosts = '{hosts}' without workers: say how many{by_name}")
    return hosts, number or None


def shows_state(num_worlds: int, workers: int | str | None, hosts: str | None) -> bool:
    """Whether this process can have the state of the worlds; the rest as of `check_hosts`."""
    name, number = check_hosts(workers, hosts)
    backend = _backend(name)
    return backend is not None and backend.shows_state(num_worlds, number)


def make_worlds(
    world: World,  # what each is made of
    base_dir: Path,  # the folder that its relative files start from
    num_worlds: int,  # W
    # how many run them; 0 or None: this process; a backend's name: as many as are of use there
    workers: int | str | None = None,
    hosts: str | None = None,  # a backend's name; None: this machine
    in_next_step: bool = False,  # when worlds begin anew; see `SteppedWorlds`
) -> SteppedWorlds:
    """Worlds of the backend that `workers` and `hosts` name.

    Raises:
        ConfigError: workers or hosts that cannot be, or a setting that they cannot have.
        MissingExtraError: hosts on Ray without Ray.
        WorkerError: no process, no cluster, or no memory.
    """
    name, number = check_hosts(workers, hosts)
    backend = _backend(name)
    assert backend is not None
    return backend.make(world, base_dir, num_worlds, number, in_next_step)
