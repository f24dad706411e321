"""`cavmarl bench step`: agent-steps a second next to highway-env's."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

from rich.console import Console
from rich.table import Table

from cavmarl.bench.harness import make_table, measuring
from cavmarl.cli.output import JsonPath, about, check_bound, end_below, write_json

if TYPE_CHECKING:
    from cavmarl.bench.step_speed import StepSpeed

_SENSORS = {"lidar": "64 rays", "kinematics": "no rays"}
_SIDES = {
    "batched": "cavmarl, batched",
    "single": "cavmarl, 1 world",
    "more": "cavmarl, batched",
    "dicts": "cavmarl, dicts",
    "highway_env": "highway-env",
    "highway_env_raw": "highway-env, raw",
}


def step(
    agents: Annotated[int, about("Controlled vehicles in each world.")] = 100,
    worlds: Annotated[int, about("Number of parallel worlds.")] = 16,
    repeats: Annotated[int, about("Number of measurements of each row.")] = 5,
    at_least: Annotated[
        float | None, about("Exit with 1 if the ratio with a lidar is below.", callback=check_bound)
    ] = None,
    json_path: JsonPath = None,
) -> None:
    """Agent-steps a second next to highway-env's: same road, vehicles and rates; one core."""
    from cavmarl.bench.step_speed import measure_step_speed

    console = Console()
    with measuring(console) as say:
        found = measure_step_speed(agents, worlds, repeats, say)
    console.print(_table(found))
    console.print(
        f"batched over highway-env: [bold]{found.ratio:,.0f}[/] with a lidar, "
        f"[bold]{found.ratio_kinematics:,.0f}[/] without "
        f"({found.ratio_kinematics_raw:,.0f} over its raw observation)\n"
        f"an agent among ten times as many costs [bold]{found.cost_of_more:.2f}[/] times as much; "
        f"dicts add [bold]{found.dict_us:.2f} µs[/] an agent and step"
    )
    write_json(json_path, found.to_dict())
    end_below(at_least, found.ratio)


def _table(found: StepSpeed) -> Table:
    rows = [
        (
            _SENSORS[row.sensors],
            _SIDES[row.side],
            str(row.worlds),
            *(f"{value:,.0f}" for value in (row.agents, row.low, row.median, row.high)),
        )
        for row in sorted(found.rows, key=lambda row: list(_SENSORS).index(row.sensors))
    ]
    title = (
        f"agent-steps/s of one core: {found.rows[0].agents} controlled vehicles on "
        f"{found.road_m / 1000.0:.1f} km of four lanes,\n"
        f"two ticks a step; ours with 16 neighbours too; {found.repeats} turns"
    )
    heads = ("observation", "side", "worlds", "agents", "min", "median", "max")
    return make_table(title, heads, rows)
