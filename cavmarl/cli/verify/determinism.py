"""`cavmarl verify-determinism`: checks that the same scenario gives the same bits."""

from __future__ import annotations

from typing import Annotated

import typer
from rich.console import Console

from cavmarl.cli.evaluate import progress_bar
from cavmarl.cli.output import (
    Agents,
    Background,
    Environment,
    JsonPath,
    PolicyName,
    Seed,
    Settings,
    about,
    parse_settings,
    say_difference,
    write_json,
)


def verify_determinism(
    env: Environment,
    policy: PolicyName = "idm",
    steps: Annotated[int, about("Compared steps.")] = 600,
    seed: Seed = 0,
    agents: Agents = None,
    background: Background = None,
    settings: Settings = None,
    json_path: JsonPath = None,
) -> None:
    """Drive one world in three fresh processes; exit code 1 and where they first differ."""
    from cavmarl.verify.determinism import verify_determinism as verify

    overrides = parse_settings(settings)
    console = Console()
    with progress_bar(console) as bar:
        task = bar.add_task(f"three times {policy} in {env}")
        found = verify(
            env,
            policy,
            steps=steps,
            seed=seed,
            agents=agents,
            background=background,
            overrides=overrides,
            progress=lambda k, n: bar.update(task, completed=k, total=n),
        )
    write_json(json_path, found.to_dict())
    if found.difference is not None:
        one, other = (f"in process {number}" for number in found.difference.processes)
        said = say_difference(found.difference, (one, other))
        console.print(said, markup=False, soft_wrap=True)
        raise typer.Exit(1)
    console.print(
        f"equal: {found.steps} steps in {len(found.hash_seeds)} processes (PYTHONHASHSEED "
        f"{', '.join(found.hash_seeds)}), with load beside; state {found.state_hash}",
        markup=False,
        highlight=False,
        soft_wrap=True,
    )
