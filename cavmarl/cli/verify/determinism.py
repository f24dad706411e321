"""`cavmarl verify determinism`: checks that repeated runs give the same bits."""

from __future__ import annotations

from dataclasses import asdict
from typing import Annotated

import typer
from rich.console import Console

from cavmarl.cli.output import JsonPath, PolicyName, about, say_difference, with_world, write_json
from cavmarl.config.world_spec import WorldSpec, with_sensors_of_drivers
from cavmarl.core.progress import counting


@with_world()
def verify_determinism(
    world: WorldSpec,
    policy: PolicyName = "idm",
    steps: Annotated[int, about("Number of steps to compare.", metavar="N")] = 600,
    json_path: JsonPath = None,
) -> None:
    """Compare runs of the same world in three new processes.

    On the first difference, print it and exit with 1.
    """
    from cavmarl.verify.determinism import verify_determinism as verify

    console = Console()
    world = with_sensors_of_drivers(world, [policy])
    with counting(console, f"three times {policy} in {world.env}") as progress:
        found = verify(world, policy, steps=steps, progress=progress)
    write_json(json_path, asdict(found))
    if found.difference is not None:
        one, other = (f"in process {number}" for number in found.difference.processes)
        said = say_difference(found.difference, (one, other))
        console.print(said, markup=False, soft_wrap=True)
        raise typer.Exit(1)
    console.print(
        f"equal: {found.steps} steps in {len(found.hash_seeds)} processes (PYTHONHASHSEED "
        f"{', '.join(found.hash_seeds)}) on a loaded machine; state {found.state_hash}",
        markup=False,
        highlight=False,
        soft_wrap=True,
    )
