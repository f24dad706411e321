"""`WorldArguments`: the keywords that `make_vec` and `parallel_env` share, and what they make."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypedDict, Unpack

from cavmarl.config.driver_form import with_sensors_of
from cavmarl.config.registry import load_config
from cavmarl.config.removed_keys import removed_argument
from cavmarl.core.errors import ConfigError
from cavmarl.core.seeds import check_seed
from cavmarl.engine.world_setup import check_agents, make_world
from cavmarl.env.drawn_worlds import check_rendering
from cavmarl.env.recorded_worlds import Record, check_recording
from cavmarl.parallel.backends import find_backend, make_worlds
from cavmarl.parallel.worlds.step_arrays import SteppedWorlds


class WorldArguments(TypedDict, total=False):
    """Keywords of `make_vec` and `parallel_env` that say which worlds are made, and where they run.

    Attributes:
        zones: shadows zones.count, how many shards run the world; results do not depend on it.
        backend: where the worlds run (docs/guides/divide_a_world.md). Results do not depend on it.
            "local": in the caller's process. "processes:N": in N worker processes of this machine.
            "nodes:N": in N processes that share nothing, started on this machine
            (docs/guides/nodes.md). "nodes:N@HOST:PORT": in N nodes that are started by hand and
            join there.
            "nodes:N@mpi": in N other ranks of an MPI run. "ray:N": in N actors of a Ray cluster
            (docs/guides/nodes.md), "ray": in as many as are of use.
            The name of a registered backend: there, "name:N" with N workers.
        workers: short form: N for "processes:N", 0 for "local".
        nodes: short form: N for "nodes:N".
        sensor_workers: shadows workers.sensors, how many processes the sensors of `rig` are shared
            out over (docs/guides/sensor_workers.md). Results do not depend on it.
        agents: shadows population.agents.
        background: shadows population.background.
        seed: of the first reset, if that is given none.
        max_cycles: steps until truncation; shadows horizon_s.
        sensors_of: a trained driver, whose sensors and actions the agents get.
        render_mode: `rgb_array` or None; `parallel_env` also takes `human`.
        record: a new folder to record into, or `RecordOptions` (docs/guides/recordings.md).
        overrides: values for any other key, such as `{"sensors.lidar.rays": 32}`.
    """

    zones: int | None
    backend: str | None
    workers: int | None
    nodes: int | None
    sensor_workers: int | None
    agents: int | None
    background: int | None
    seed: int | None
    max_cycles: int | None
    sensors_of: str | Path | None
    render_mode: str | None
    record: Record | None
    overrides: Mapping[str, Any] | None


def start_worlds(
    env: str | Path,
    num_worlds: int,
    in_next_step: bool,
    render_modes: tuple[str, ...],
    **given: Unpack[WorldArguments],
) -> SteppedWorlds:
    """Make the worlds that the arguments name, after all arguments are checked.

    Args:
        env: name of an entry of `envs/`, a folder with an env.yaml, or a map file.
        num_worlds: how many of them.
        in_next_step: when a world that is over begins anew; see `SteppedWorlds`.
        render_modes: that are possible.
        given: as `WorldArguments` describes them.

    Raises:
        TypeError: an argument of another name.
        ConfigError, PolicyError, MapError, WorkerError, MissingExtraError: as of `make_vec`.
    """
    if refusal := next(filter(None, map(removed_argument, given)), None):
        raise ConfigError(refusal)
    known = WorldArguments.__annotations__
    if unknown := [name for name in given if name not in known]:
        raise TypeError(f"unexpected keyword argument {unknown[0]!r}; there are {', '.join(known)}")
    backend = find_backend(given.get("backend"), given.get("workers"), given.get("nodes"))
    if (seed := given.get("seed")) is not None:
        check_seed(seed)
    config, base_dir = load_config(
        env,
        zones=given.get("zones"),
        sensor_workers=given.get("sensor_workers"),
        agents=given.get("agents"),
        background=given.get("background"),
        max_cycles=given.get("max_cycles"),
        overrides=with_sensors_of(given.get("overrides"), given.get("sensors_of")),
    )
    check_agents(config)
    check_rendering(config, given.get("render_mode"), backend, render_modes)
    check_recording(config, given.get("record"), backend)
    world = make_world(config, base_dir)
    return make_worlds(world, base_dir, num_worlds, backend, in_next_step)
