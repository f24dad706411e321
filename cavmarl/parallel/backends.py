"""Worlds that are stepped together, in this process or shared out over others."""

from __future__ import annotations

from pathlib import Path

from cavmarl.engine.world_setup import World, check_hosts, leads_hosts
from cavmarl.parallel.hosts.remote_worlds import RemoteWorlds
from cavmarl.parallel.pooled_worlds import PooledWorlds
from cavmarl.parallel.sensor_workers.sensor_worker_setup import local_worlds
from cavmarl.parallel.split_hosts.divided_worlds import DividedWorlds
from cavmarl.parallel.step_arrays import SteppedWorlds

__all__ = ["make_worlds"]


def make_worlds(
    world: World,
    base_dir: Path,
    num_worlds: int,
    workers: int | str | None = None,
    hosts: str | None = None,
    in_next_step: bool = False,
) -> SteppedWorlds:
    """Worlds of this process, of worker processes or of hosts.

    Args:
        world: what each is made of.
        base_dir: the folder that its relative files start from.
        num_worlds: W.
        workers: how many run them; 0 or None: this process; "ray": as many hosts as are of use.
        hosts: "ray": workers are on the machines of a Ray cluster; None: on this one.
        in_next_step: when worlds begin anew; see `SteppedWorlds`.

    Raises:
        ConfigError: workers or hosts that cannot be, or a setting that they cannot have.
        MissingExtraError: hosts on Ray without Ray.
        WorkerError: no process, no cluster, or no memory.
    """
    on_ray = check_hosts(workers, hosts)
    number = None if workers == "ray" else int(workers or 0)
    if number and leads_hosts(num_worlds, workers, hosts):
        return DividedWorlds(world, base_dir, num_worlds, number, in_next_step)
    if on_ray:
        return RemoteWorlds(world, base_dir, num_worlds, number, in_next_step)
    if number:
        return PooledWorlds(world, base_dir, num_worlds, number, in_next_step)
    return local_worlds(world, base_dir, num_worlds, in_next_step)
