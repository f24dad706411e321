"""`cavmarl plan`: which worker would host which shard, by what zones cost here and now."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console

from cavmarl.cli.output import (
    Agents,
    Background,
    JsonPath,
    Seed,
    Settings,
    parse_settings,
    print_error,
    write_json,
)
from cavmarl.config import ZONE_LAYOUTS
from cavmarl.errors import ConfigError

if TYPE_CHECKING:
    from cavmarl.balance.problem import Problem
    from cavmarl.balance.snapshot import Snapshot

__all__ = ["plan"]

NOW, IDLE = "now", "idle"


def plan(
    env: Annotated[
        str | None,
        typer.Argument(metavar="[ENV]", help="Name, folder or map file; not with --again."),
    ] = None,
    zones: Annotated[int, typer.Option(help="Of each world.")] = 9,
    workers: Annotated[int, typer.Option(help="That shards are placed on.")] = 3,
    worlds: Annotated[int, typer.Option(min=1, help="Of the environment.")] = 1,
    layout: Annotated[
        str, typer.Option(help=f"{', '.join(ZONE_LAYOUTS)}, or a zone file.")
    ] = "bisection",
    snapshot: Annotated[
        str,
        typer.Option(
            help=f"How busy workers are: {NOW} as this machine is, {IDLE}, or the plan of a file."
        ),
    ] = NOW,
    steps: Annotated[int, typer.Option(help="Of each world that are measured.")] = 50,
    before: Annotated[int, typer.Option(help="Steps of each world that come first.")] = 50,
    tolerance: Annotated[float, typer.Option(help="Imbalance below which nothing moves.")] = 0.1,
    again: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Make a stored plan once more from what it says; exit code 1 if it is another.",
        ),
    ] = None,
    agents: Agents = None,
    background: Background = None,
    seed: Seed = 0,
    settings: Settings = None,
    json_path: JsonPath = None,
) -> None:
    """Measure what each zone costs, place the shards, and print the plan; nothing is started."""
    from cavmarl.balance.plan import make_plan
    from cavmarl.balance.plan_text import describe_plan

    if again is not None:
        _make_again(again)
        return
    if env is None:
        raise ConfigError("name an environment, or give --again with a stored plan")
    if workers < 1:
        raise ConfigError(f"workers = {workers}: must be at least 1")
    console = Console()
    with console.status("measuring"):
        problem = _measured(
            env,
            zones,
            worlds,
            layout,
            _snapshot(snapshot, workers),
            tolerance,
            (steps, before),
            seed,
            agents=agents,
            background=background,
            overrides=parse_settings(settings),
        )
    made = make_plan(problem)
    console.print(describe_plan(made), markup=False, highlight=False, soft_wrap=True)
    write_json(json_path, made.to_dict())


def _measured(
    env: str,
    zones: int,
    worlds: int,
    layout: str,
    snapshot: Snapshot,
    tolerance: float,
    steps: tuple[int, int],
    seed: int,
    **world: Any,
) -> Problem:
    from cavmarl.balance.problem import BalanceRule, Problem
    from cavmarl.evaluate.shard_costs import measure_shards, side_neighbors
    from cavmarl.evaluate.sharded_worlds import world_maker

    rule = BalanceRule(tolerance=tolerance)
    simulation = world_maker(env, layout=layout, seconds=3600, seed=seed, **world)(zones)
    costs = measure_shards(simulation, worlds, seed, steps=steps[0], before=steps[1])
    return Problem(costs, side_neighbors(simulation.partition), snapshot, rule)


def _snapshot(said: str, workers: int) -> Snapshot:
    from cavmarl.balance.probe import take_snapshot
    from cavmarl.balance.snapshot import idle_snapshot, snapshot_from_dict

    if said == NOW:
        return take_snapshot(dict.fromkeys(range(workers)))
    if said == IDLE:
        return idle_snapshot(workers)
    found = snapshot_from_dict(_read(Path(said)).get("snapshot", {}))
    if len(found.workers) != workers:
        raise ConfigError(f"{said}: has {len(found.workers)} workers, not {workers}: --workers")
    return found


def _make_again(path: Path) -> None:
    from cavmarl.balance.plan import plan_from_dict, replan
    from cavmarl.balance.plan_text import describe_plan

    stored = plan_from_dict(_read(path))
    made = replan(stored, stored.problem.snapshot)
    Console().print(describe_plan(made), markup=False, highlight=False, soft_wrap=True)
    if made != stored:
        print_error(f"{path}: its shards do not stand where its own figures put them")
        raise typer.Exit(1)


def _read(path: Path) -> dict[str, Any]:
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        raise ConfigError(f"{path}: cannot be read ({error})") from error
    if not isinstance(document, dict):
        raise ConfigError(f"{path}: not a plan")
    return document
