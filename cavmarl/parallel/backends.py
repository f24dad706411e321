"""Backends, which run worlds: their names, their registration and their choice."""

from __future__ import annotations

from pathlib import Path
from typing import Protocol

from cavmarl.core.errors import ConfigError
from cavmarl.core.extensions import REGISTERED_BACKENDS
from cavmarl.engine.world_setup import World
from cavmarl.handoff.simulators.simulator_kinds import check_servers, hosted_zones
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
    """Makes the worlds of a registered backend."""

    def __call__(
        self,
        world: World,
        base_dir: Path,  # folder of relative paths
        num_worlds: int,  # W
        workers: int | None,  # N of `backend="name:N"`, None for `backend="name"`
        in_next_step: bool,  # whether new episodes start a step later; see `SteppedWorlds`
    ) -> SteppedWorlds:
        """Make worlds that are stepped together."""
        ...


def register_backend(name: str, make: MakeWorlds) -> None:
    """Register a backend for the argument `backend` of `make_vec` and `parallel_env`.

    Args:
        name: name of the backend.
        make: function that makes worlds; they must behave like worlds of this process.

    Raises:
        ConfigError: the name is not an identifier, or is taken.
    """
    REGISTERED_BACKENDS.add(name, make, make, OWN)


def find_backend(
    backend: str | None = None, workers: int | None = None, nodes: int | None = None
) -> BackendName:
    """Return the backend that the arguments name. Arguments and errors: see `read_backend`."""
    return read_backend(backend, workers, nodes, REGISTERED_BACKENDS)


def shows_state(backend: BackendName) -> bool:
    """Return whether this process can read the state of the worlds, to draw or record them."""
    return backend.kind in OWN


def make_worlds(
    world: World,
    base_dir: Path,  # folder of relative paths
    num_worlds: int,  # W
    backend: BackendName,
    in_next_step: bool = False,  # whether new episodes start a step later; see `SteppedWorlds`
) -> SteppedWorlds:
    """Make worlds.

    Raises:
        ConfigError: the backend does not support a setting.
        MissingExtraError: Ray or mpi4py is not installed.
        WorkerError: a process or cluster cannot be started, or there is not enough memory.
    """
    count = backend.count
    if world.config.zones.simulators and backend.kind != LOCAL:
        _check_simulators(world, num_worlds, backend)
    if backend.kind == LOCAL:
        return local_worlds(world, base_dir, num_worlds, in_next_step)
    if backend.kind == PROCESSES:
        return PooledWorlds(world, base_dir, num_worlds, count or 1, in_next_step)
    if backend.kind in (NODES, RAY):
        # `NodeGroups` needs one thread per group, but MPI supports a single thread.
        by_zones = count == 1 or backend.is_mpi or backend.is_split(num_worlds)
        make = NodeWorlds if by_zones else NodeGroups
        system = system_of(backend)
        return make(world, base_dir, num_worlds, backend, in_next_step, system=system)
    made: MakeWorlds = REGISTERED_BACKENDS[backend.kind]
    return made(world, base_dir, num_worlds, count, in_next_step)


def _check_simulators(world: World, num_worlds: int, backend: BackendName) -> None:
    """Check that the processes of a backend can run zones in other simulators.

    Raises:
        ConfigError: the backend does not support a setting of these zones, or servers are missing.
    """
    config = world.config
    check_servers(hosted_zones(config.zones.simulators, world.partition.count), num_worlds)
    wrong = {
        "zones.journal": backend.kind == PROCESSES and config.zones.journal,
        "workers.balance_steps": config.workers.balance_steps and num_worlds > 1,
        "workers.sensors": config.workers.sensors,
    }
    for key, is_set in wrong.items():
        if is_set:
            raise ConfigError(
                f"{key}: worlds of the backend '{backend.kind}' with zones.simulators do not "
                "support this; leave it out, or use backend='local'"
            )
