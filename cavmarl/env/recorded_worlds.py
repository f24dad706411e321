"""Recording the worlds that an environment steps: what a recording of them is told."""

from __future__ import annotations

import sys
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from cavmarl.config.env import EnvConfig
from cavmarl.core.errors import ConfigError
from cavmarl.core.machine import describe_machine
from cavmarl.engine.simulation import Simulation
from cavmarl.engine.world_description import describe_world
from cavmarl.engine.world_setup import World
from cavmarl.parallel.backends import shows_state
from cavmarl.parallel.local_worlds import kept_elsewhere
from cavmarl.recordings.recording_writer import RecordingWriter


def check_recording(
    config: EnvConfig,
    record: str | Path | None,
    num_worlds: int,
    workers: int | str | None,
    hosts: str | None,
) -> None:
    """Refuse to record worlds whose state cannot be had here.

    Raises:
        ConfigError: they are such worlds.
    """
    if record is None or (not workers and hosts in (None, "local")):
        return
    key = kept_elsewhere(config)
    if not key and config.traffic.source != "native":
        key = f"traffic.source = {config.traffic.source!r}"
    if key or not shows_state(num_worlds, workers, hosts):
        what = f" and {key}" if key else ""
        raise ConfigError(
            f"record = {str(record)!r} with workers = {workers or hosts!r}{what}: such worlds are "
            "only recorded in the caller's process; use workers=0"
        )


def recording_of(
    path: str | Path, world: World, simulation: Simulation, **more: Any
) -> RecordingWriter:
    """What writes frames of a world, with its manifest.

    Args:
        path: of the recording.
        world: what each of its worlds is made of.
        simulation: one of them, for the reach of its zones.
        more: for the manifest.

    Raises:
        RecordingError: there is something at `path`, or it cannot be written.
        MissingExtraError: pyarrow is not installed.
    """
    config = world.config
    return RecordingWriter(
        path,
        environment=f"{config.name}-v{config.version}",
        network=world.network,
        partition=world.partition,
        halo_m=float(simulation.zone_loads().halo_m),
        sim_dt_s=config.clock.sim_dt_s,
        step_s=config.clock.ctrl_dt_s,
        manifest={
            "started": datetime.now(UTC).isoformat(timespec="seconds"),
            "command": [Path(sys.argv[0]).name, *sys.argv[1:]],
            "world": describe_world(config, world.network, world.demand, world.partition),
            **more,
            **describe_machine(),
        },
    )
