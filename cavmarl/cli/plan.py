"""`cavmarl plan`: places shards on workers by the zones' measured costs."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console

from cavmarl.cli.output import JsonPath, about, print_error, with_world, write_json
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
LASTING_S = 3600  # of the worlds: longer than any measurement


@with_world()
def plan(
    world: WorldSpec,
    env: Annotated[
        str | None,
        typer.Argument(metavar="[ENV]", help="Name, folder or map file; not with --again."),
    ] = None,
    zones: Annotated[int, about("Zones of each world.")] = 9,
    workers: Annotated[int, about("Workers that shards are placed on.")] = 3,
    worlds: Annotated[int, about("Number of parallel worlds.", min=1)] = 1,
    layout: Annotated[str, about(f"{', '.join(ZONE_LAYOUTS)}, or a zone file.")] = "bisection",
    snapshot: Annotated[
        str,
        about(f"How busy workers are: {NOW} as this machine is, {IDLE}, or the plan of a file."),
    ] = NOW,
    steps: Annotated[int, about("Measured steps of each world.")] = 50,
    before: Annotated[int, about("Unmeasured steps of each world, first.")] = 50,
    tolerance: Annotated[float, about("Imbalance below which nothing moves.")] = 0.1,
    again: Annotated[
        Path | None,
        about(
            "Make a stored plan, or those of a run's manifest, once more from what they say; "
            "exit code 1 if one is another.",
            metavar="FILE",
        ),
    ] = None,
    cut: Annotated[
        Path | None,
        about(
            "Extension: write a zone file here that shares out what was measured.",
            "--cut-anew",
            metavar="FILE",
        ),
    ] = None,
    json_path: JsonPath = None,
) -> None:
    """Measure what each zone costs, place the shards, and print the plan; nothing is started."""
    from cavmarl.balance.balance_plan import make_plan
    from cavmarl.balance.plan_text import describe_plan
    from cavmarl.balance.problem import BalanceRule, Problem
    from cavmarl.evaluate.built_in_runs import world_maker
    from cavmarl.evaluate.shard_costs import measure_shards

    if again is not None:
        _make_again(again)
        return
    if env is None:
        raise ConfigError("name an environment, or give --again with a stored plan")
    if workers < 1:
        raise ConfigError(f"workers = {workers}: must be at least 1")
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
            f"{error}; --snapshot {IDLE} supposes that they are otherwise idle", error.rejections
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
    """Write zones of about the same cost, if that gains anything, and say what."""
    from cavmarl.handoff.repartition_plan import propose_zones
    from cavmarl.zones.partition.zone_file import write_zones

    found = propose_zones(
        network, partition, measured.places, measured.zone_costs_s(), tolerance=tolerance
    )
    if found is None:
        return f"cut anew: no other zones are more even by the tolerance; {path} is not written"
    write_zones(path, found.partition)
    return (
        f"cut anew: costs of zones, max / mean, from {found.before:.3f} to {found.after:.3f}; "
        f"{found.moved} of {len(measured.places)} vehicles are in other zones: {path}"
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
        raise ConfigError(f"{said}: has {len(found.workers)} workers, not {workers}: --workers")
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
        print_error(f"{path}: its shards do not stand where its own figures put them")
        raise typer.Exit(1)
