"""Where worlds run: backends by name, and how one is chosen."""

from __future__ import annotations

from pathlib import Path
from typing import Protocol

from cavmarl.core.errors import ConfigError
from cavmarl.engine.world_setup import World
from cavmarl.parallel.nodes.node_groups import NodeGroups
from cavmarl.parallel.nodes.node_starters import system_of
from cavmarl.parallel.nodes.node_worlds import NodeWorlds
from cavmarl.parallel.placement.backend_name import (
    LOCAL,
    NODES,
    OWN,
    PROCESSES,
    RAY,
    BackendName,
    read_backend,
)
from cavmarl.parallel.workers.pooled_worlds import PooledWorlds
from cavmarl.parallel.worlds.sensor_worker_setup import local_worlds
from cavmarl.parallel.worlds.step_arrays import SteppedWorlds


class MakeWorlds(Protocol):
    """Makes worlds of a registered backend."""

    def __call__(
        self,
        world: World,  # what each is made of
        base_dir: Path,  # the folder that its relative files start from
        num_worlds: int,  # W
        workers: int | None,  # N of `backend="name:N"`; None of `backend="name"`
        in_next_step: bool,  # when worlds begin anew; see `SteppedWorlds`
    ) -> SteppedWorlds:
        """Return worlds that are stepped together."""
        ...


_REGISTERED: dict[str, MakeWorlds] = {}


def register_backend(name: str, make: MakeWorlds) -> None:
    """Add a place where worlds run, which `backend` of `make_vec` and `parallel_env` can name.

    Args:
        name: of the backend.
        make: makes worlds there; what they do must be what the worlds of this process do.

    Raises:
        ConfigError: the name is taken or no name.
    """
    if not name.isidentifier():
        raise ConfigError(f"backend {name!r}: must be a name of letters, digits and _")
    if name in OWN:
        raise ConfigError(f"backend '{name}': one of cavmarl's own; take another name")
    _REGISTERED[name] = make


def find_backend(
    backend: str | None = None, workers: int | None = None, nodes: int | None = None
) -> BackendName:
    """Read where worlds run; arguments and errors as of `read_backend`."""
    return read_backend(backend, workers, nodes, _REGISTERED)


def shows_state(backend: BackendName) -> bool:
    """Return whether this process can have the state of the worlds, to draw or record them."""
    return backend.kind in OWN


def make_worlds(
    world: World,  # what each is made of
    base_dir: Path,  # the folder that its relative files start from
    num_worlds: int,  # W
    backend: BackendName,  # where they run
    in_next_step: bool = False,  # when worlds begin anew; see `SteppedWorlds`
) -> SteppedWorlds:
    """Make worlds.

    Raises:
        ConfigError: a setting that worlds of this backend cannot have.
        MissingExtraError: a backend on Ray without Ray, or on MPI without mpi4py.
        WorkerError: no process, no cluster, or no memory.
    """
    count = backend.count
    if backend.kind == LOCAL:
        return local_worlds(world, base_dir, num_worlds, in_next_step)
    if backend.kind == PROCESSES:
        return PooledWorlds(world, base_dir, num_worlds, count or 1, in_next_step)
    if backend.kind in (NODES, RAY):
        # The pools of whole worlds have a thread each, and MPI is for one thread.
        by_zones = count == 1 or backend.is_mpi or backend.is_split(num_worlds)
        make = NodeWorlds if by_zones else NodeGroups
        system = system_of(backend)
        return make(world, base_dir, num_worlds, backend, in_next_step, system=system)
    return _REGISTERED[backend.kind](world, base_dir, num_worlds, count, in_next_step)
