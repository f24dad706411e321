"""`cavmarl plan`: assigns shards to workers by measured costs of the zones."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console

from cavmarl.cli.output import (
    WORLD,
    JsonPath,
    about,
    print_error,
    with_world,
    write_json,
)
from cavmarl.config.world_spec import WorldSpec
from cavmarl.config.zones import ZONE_LAYOUTS
from cavmarl.core.errors import ConfigError, NoAdmissibleWorkerError
from cavmarl.core.progress import counting

if TYPE_CHECKING:
    from cavmarl.balance.load_snapshot import LoadSnapshot
    from cavmarl.evaluate.shard_costs import MeasuredWorlds
    from cavmarl.roads.network import RoadNetwork
    from cavmarl.zones.partition.zone_partition import ZonePartition

NOW, IDLE = "now", "idle"
LASTING_S = 3600  # length of an episode: longer than any measurement


@with_world()
def plan(
    world: WorldSpec,
    env: Annotated[
        str | None,
        typer.Argument(
            metavar="ENV",
            help="Environment: its name, its folder, a map file or a .sumocfg; not with --again.",
        ),
    ] = None,
    zones: Annotated[int, about("Number of zones of each world.", metavar="K", panel=WORLD)] = 9,
    workers: Annotated[int, about("Number of workers.", metavar="N")] = 3,
    worlds: Annotated[
        int, about("Number of parallel worlds.", metavar="N", min=1, panel=WORLD)
    ] = 1,
    layout: Annotated[
        str,
        about(
            f"Shape of the zones: {', '.join(ZONE_LAYOUTS)}, or a zone file.",
            metavar="LAYOUT",
            panel=WORLD,
        ),
    ] = "bisection",
    snapshot: Annotated[
        str,
        about(
            f"Load of the workers: {NOW} (as measured on this machine), {IDLE}, or a stored plan.",
            metavar="LOAD",
        ),
    ] = NOW,
    steps: Annotated[int, about("Number of measured steps of each world.", metavar="N")] = 50,
    before: Annotated[int, about("Number of steps before the measurement.", metavar="N")] = 50,
    tolerance: Annotated[
        float, about("Imbalance below which no shard is moved.", metavar="X")
    ] = 0.1,
    again: Annotated[
        Path | None,
        about(
            "Recompute a stored plan, or the plans in the manifest of a run. If one differs, exit "
            "with 1.",
            metavar="FILE",
        ),
    ] = None,
    cut: Annotated[
        Path | None,
        about(
            "Write a zone file whose zones have about equal measured costs.",
            "--write-zones",
            metavar="FILE",
        ),
    ] = None,
    json_path: JsonPath = None,
) -> None:
    """Measure the cost of each zone, assign the shards to workers, and print the plan."""
    from cavmarl.balance.balance_plan import make_plan
    from cavmarl.balance.plan_text import describe_plan
    from cavmarl.balance.problem import BalanceRule, Problem
    from cavmarl.evaluate.built_in_runs import world_maker
    from cavmarl.evaluate.shard_costs import measure_shards

    if again is not None:
        _make_again(again)
        return
    if env is None:
        raise ConfigError(
            "the environment is missing: name one, or give --again with a stored plan"
        )
    if workers < 1:
        raise ConfigError(f"--workers {workers}: must be at least 1")
    rule = BalanceRule(tolerance=tolerance)
    seen = _snapshot(snapshot, workers)
    console = Console()
    with counting(console, f"steps of {env}") as told:
        simulation = world_maker(world, layout=layout, seconds=LASTING_S)(zones)
        measured = measure_shards(
            simulation, worlds, world.seed, steps=steps, before=before, told=told
        )
    partition = simulation.partition
    try:
        made = make_plan(Problem(measured.costs, partition.side_neighbors, seen, rule))
    except NoAdmissibleWorkerError as error:
        raise NoAdmissibleWorkerError(
            f"{error}; with --snapshot {IDLE} the plan assumes idle workers", error.rejections
        ) from error
    console.print(describe_plan(made), markup=False, highlight=False, soft_wrap=True)
    if cut is not None:
        said = _cut_anew(simulation.network, partition, measured, tolerance, cut)
        console.print(said, markup=False, highlight=False, soft_wrap=True)
    write_json(json_path, made.to_dict())


def _cut_anew(
    network: RoadNetwork,
    partition: ZonePartition,
    measured: MeasuredWorlds,
    tolerance: float,
    path: Path,
) -> str:
    """Write zones of about equal cost if that improves the balance; return what was done."""
    from cavmarl.handoff.repartition_plan import propose_zones
    from cavmarl.zones.partition.zone_file import write_zones

    found = propose_zones(
        network, partition, measured.places, measured.zone_costs_s(), tolerance=tolerance
    )
    if found is None:
        return (
            f"new zones would not improve the balance by more than the tolerance; {path} is not "
            "written"
        )
    write_zones(path, found.partition)
    return (
        f"new zones in {path}: cost of zones, max / mean, {found.before:.3f} before and "
        f"{found.after:.3f} after; {found.moved} of {len(measured.places)} vehicles change zone"
    )


def _snapshot(said: str, workers: int) -> LoadSnapshot:
    from cavmarl.balance.load_snapshot import idle_snapshot
    from cavmarl.balance.plan_file import read_plan
    from cavmarl.balance.probe import take_snapshot

    if said == NOW:
        return take_snapshot(dict.fromkeys(range(workers)))
    if said == IDLE:
        return idle_snapshot(workers)
    found = read_plan(Path(said)).problem.snapshot
    if len(found.workers) != workers:
        raise ConfigError(
            f"{said}: has {len(found.workers)} workers, but --workers is {workers}; make them equal"
        )
    return found


def _make_again(path: Path) -> None:
    from cavmarl.balance.balance_plan import replan
    from cavmarl.balance.plan_file import read_plans
    from cavmarl.balance.plan_text import describe_plan

    stored = read_plans(path)
    made = [replan(plan, plan.problem.snapshot) for plan in stored]
    text = "\n\n".join(map(describe_plan, made))
    Console().print(text, markup=False, highlight=False, soft_wrap=True)
    if made != stored:
        print_error(f"{path}: the recomputed plan differs from the stored one")
        raise typer.Exit(1)
