"""`cavmarl verify --replay`: a tick that no host survived, run again in one process."""

from __future__ import annotations

from pathlib import Path

import typer
from rich.console import Console

from cavmarl.cli.output import write_json
from cavmarl.core.errors import LostTickError


def run_again(path: Path, env: str | None, json_path: Path | None) -> None:
    """As it was, then without the faults of its plan; exit code 1 if it fails as it was.

    What a zone's code raises without faults is not caught: its traceback is what one looks for.
    """
    from cavmarl.handoff.fault_injection.reproducer_file import read_reproducer
    from cavmarl.verify.replay import changed_versions, replay_tick, world_of

    console = Console(soft_wrap=True, highlight=False, markup=False)
    kept = read_reproducer(path)
    world = world_of(kept, env)
    console.print(f"{kept.config['name']}, tick {kept.tick} of the run, on record: {kept.cause}")
    for change in changed_versions(kept):
        console.print(f"note: {change}")
    found = {"recorded": kept.cause, "failure": "", "state_hash": ""}
    try:
        found["state_hash"] = replay_tick(kept, world)
        console.print(f"as it was: reached, state {found['state_hash']}")
    except LostTickError as error:
        found["failure"] = str(error)
        console.print(f"as it was: {error}")
    write_json(json_path, found)
    if found["failure"]:
        found["state_hash"] = replay_tick(kept, world, faults=False)
        console.print(f"without faults: reached, state {found['state_hash']}")
        write_json(json_path, found)
        raise typer.Exit(1)
