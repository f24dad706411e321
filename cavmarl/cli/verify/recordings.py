"""`cavmarl verify recording`: repeats a recorded run without its drivers and clients."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from cavmarl.cli.output import Backend, JsonPath, Workers, Zones, about, with_world, write_json
from cavmarl.config.world_spec import WorldSpec
from cavmarl.core.progress import counting


@with_world("agents", "background", "settings", "sensors_of")
def verify_recording(
    world: WorldSpec,
    recording: Annotated[
        Path,
        about("Folder written by --record --record-also commands.", "--recording", metavar="DIR"),
    ],
    zones: Zones = None,
    backend: Backend = None,
    workers: Workers = None,
    json_path: JsonPath = None,
) -> None:
    """Repeat a recorded run from its commands, and compare the state after each step.

    No driver, follower or trace is needed. On the first difference, print it and exit with 1.
    """
    from cavmarl.verify.recorded_runs import repeat_recording

    console = Console()
    with counting(console, f"{recording} in {world.env}") as progress:
        found = repeat_recording(
            recording, world, zones=zones, backend=backend, workers=workers, progress=progress
        )
    write_json(json_path, asdict(found))
    if found.first_difference is not None:
        step, tick = found.first_difference
        console.print(
            f"the state differs first at step {step}, tick {tick}: the world, the version of "
            "cavmarl or the recorded commands are not those of the run",
            markup=False,
            soft_wrap=True,
        )
        raise typer.Exit(1)
    console.print(
        f"equal: {found.steps} steps in {found.episodes} episodes; state {found.state_hash}",
        markup=False,
        highlight=False,
        soft_wrap=True,
    )
