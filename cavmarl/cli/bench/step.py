"""`cavmarl bench step`: compares the speed of steps with highway-env."""

from __future__ import annotations

from dataclasses import asdict
from typing import Annotated

from cavmarl.bench.harness import BenchmarkReport, Say, is_kept, silent
from cavmarl.cli.output import about, check_bound

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
    agents: Annotated[
        int, about("Number of controlled vehicles in each world.", metavar="N")
    ] = 100,
    worlds: Annotated[int, about("Number of parallel worlds.", metavar="N")] = 16,
    repeats: Annotated[int, about("Number of measurements per row of the table.", metavar="N")] = 5,
    at_least: Annotated[
        float | None,
        about(
            "Exit with 1 if the ratio with a lidar is below X.", metavar="X", callback=check_bound
        ),
    ] = None,
    say: Say = silent,
) -> BenchmarkReport:
    """Compare agent-steps per second on one core with highway-env.

    Both simulators have the same road, vehicles and rates.
    """
    from cavmarl.bench.step_speed import measure_step_speed

    found = measure_step_speed(agents, worlds, repeats, say)
    return BenchmarkReport(
        f"agent-steps/s of one core: {found.rows[0].agents} controlled vehicles on "
        f"{found.road_m / 1000.0:.1f} km of four lanes,\n"
        f"two ticks per step; cavmarl also observes 16 neighbours; {found.repeats} turns",
        {
            "observation": "observation",
            "side": "shown_side",
            "worlds": "worlds",
            "agents": "agents:,.0f",
            "min": "low:,.0f",
            "median": "median:,.0f",
            "max": "high:,.0f",
        },
        [
            {**asdict(row), "observation": _SENSORS[row.sensors], "shown_side": _SIDES[row.side]}
            for row in sorted(found.rows, key=lambda row: list(_SENSORS).index(row.sensors))
        ],
        notes=[
            f"batched over highway-env: [bold]{found.ratio:,.0f}[/] with a lidar, "
            f"[bold]{found.ratio_kinematics:,.0f}[/] without "
            f"({found.ratio_kinematics_raw:,.0f} over highway-env's raw observation)",
            f"with ten times as many agents, each costs [bold]{found.cost_of_more:.2f}[/] times as "
            f"much; dicts add [bold]{found.dict_us:.2f} µs[/] per agent and step",
        ],
        facts=asdict(found),
        holds=is_kept(at_least, found.ratio),
    )
