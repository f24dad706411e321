"""`WorldArguments`: the keyword arguments of `make_vec` and `parallel_env`, and their worlds."""

from __future__ import annotations

import difflib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypedDict, Unpack

from cavmarl.config.driver_form import with_sensors_of
from cavmarl.config.registry import load_config, load_plugins_of
from cavmarl.config.removed_keys import removed_argument
from cavmarl.core.errors import ConfigError, UnknownArgumentError
from cavmarl.core.seeds import check_seed
from cavmarl.engine.world_setup import check_agents, make_world
from cavmarl.env.drawn_worlds import check_external_agents, check_rendering
from cavmarl.env.recorded_worlds import Record, check_recording
from cavmarl.parallel.backends import find_backend, make_worlds
from cavmarl.parallel.worlds.step_arrays import SteppedWorlds


class WorldArguments(TypedDict, total=False):
    """Keyword arguments of `make_vec` and `parallel_env`: the worlds, and where they run.

    Attributes:
        zones: sets zones.count, the number of shards of the world. Results do not depend on it.
        zone_simulators: sets zones.simulators, the zones that other simulators run, by number:
            `{2: "carla://HOST:PORT"}`, or the name of a registered simulator
            (docs/guides/zone_simulators.md).
        backend: where the worlds run (docs/guides/divide_a_world.md). Results do not depend on it.
            "local": in the caller's process. "processes:N": in N worker processes of this machine.
            "nodes:N": in N processes without shared memory, started on this machine
            (docs/guides/nodes.md). "nodes:N@HOST:PORT": in N nodes that are started by hand and
            connect to that address. "nodes:N@mpi": in N other ranks of an MPI run.
            "ray:N": in N actors of a Ray cluster (docs/guides/nodes.md); "ray": in as many
            actors as are useful. The name of a registered backend, or "name:N" for N workers.
        workers: short form: N for "processes:N", 0 for "local".
        nodes: short form: N for "nodes:N".
        sensor_workers: sets workers.sensors, the number of processes that compute the sensors of
            `rig` (docs/guides/sensor_workers.md). Results do not depend on it.
        agents: sets population.agents.
        background: sets population.background.
        seed: seed of the first reset if that call has none.
        max_cycles: steps until truncation; sets horizon_s.
        sensors_of: a trained driver; the agents get its sensors and actions.
        render_mode: `rgb_array` or None; `parallel_env` also accepts `human`.
        record: a new folder to record into, or `RecordOptions` (docs/guides/recordings.md).
        overrides: values of any other keys, such as `{"sensors.lidar.rays": 32}`.
    """

    zones: int | None
    zone_simulators: Mapping[int, str] | None
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
    may_be_alone: bool = False,
    **given: Unpack[WorldArguments],
) -> SteppedWorlds:
    """Make the worlds that the arguments describe, after a check of all arguments.

    Args:
        env: name of an entry of `envs/`, a folder with an env.yaml, a map file, or a .sumocfg.
        num_worlds: number of worlds.
        in_next_step: whether worlds reset in the next step; see `SteppedWorlds`.
        render_modes: allowed render modes.
        may_be_alone: whether a world with `traffic.demand` may have no agents.
        given: see `WorldArguments`.

    Raises:
        UnknownArgumentError: `WorldArguments` has no argument of that name.
        ConfigError, PolicyError, MapError, WorkerError, MissingExtraError: see `make_vec`.
    """
    if refusal := next(filter(None, map(removed_argument, given)), None):
        raise ConfigError(refusal)
    known = WorldArguments.__annotations__
    if unknown := [name for name in given if name not in known]:
        close = difflib.get_close_matches(unknown[0], known, n=1)
        meant = f"did you mean {close[0]}? " if close else ""
        raise UnknownArgumentError(
            f"unexpected keyword argument {unknown[0]!r}: {meant}It must be one of "
            f"{', '.join(known)}; overrides sets every other key of env.yaml"
        )
    if (seed := given.get("seed")) is not None:
        check_seed(seed)
    load_plugins_of(env, given.get("overrides"))  # the driver may use sensors of the plugins
    config, base_dir = load_config(
        env,
        zones=given.get("zones"),
        zone_simulators=given.get("zone_simulators"),
        sensor_workers=given.get("sensor_workers"),
        agents=given.get("agents"),
        background=given.get("background"),
        max_cycles=given.get("max_cycles"),
        overrides=with_sensors_of(given.get("overrides"), given.get("sensors_of")),
    )
    backend = find_backend(given.get("backend"), given.get("workers"), given.get("nodes"))
    check_agents(config, may_be_alone=may_be_alone)
    check_rendering(config, given.get("render_mode"), backend, render_modes)
    check_recording(config, given.get("record"), backend)
    check_external_agents(config, backend)
    world = make_world(config, base_dir)
    world.tell_tolerated()
    return make_worlds(world, base_dir, num_worlds, backend, in_next_step)
