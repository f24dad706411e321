"""Cost of dividing a world, by phases of the tick, compared with the undivided world.

All zones run in this process on one core, so the whole work is visible. For each number of zones
there are two worlds; one of them has a stopwatch on every phase. A turn is divided into parts. In
each part, all worlds advance in a random order. Ratios are taken within a turn. So other load on
the machine and data evicted from caches affect all worlds equally.
"""

from __future__ import annotations

import math
import random
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from statistics import linear_regression, median, median_low
from typing import Annotated, Any

import typer

from benchmarks.program import run
from benchmarks.sharding_turns import Pair, Turn, TwinWorlds
from cavmarl.bench.harness import BenchmarkReport, Say, check_range, numbers_of, one_core, silent
from cavmarl.cli.output import Agents, Background, Seed, Settings, about, parse_settings
from cavmarl.config.zones import MAX_ZONES, ZONE_LAYOUTS
from cavmarl.core.errors import ConfigError, EvaluationError
from cavmarl.engine.simulation import Simulation
from cavmarl.evaluate.built_in_runs import world_maker

TURN_S = 10
PARTS = 5  # parts of a turn


def measure(
    env: Annotated[str, typer.Argument(help="Name, folder or map file of an environment.")],
    demand: Annotated[
        list[Path] | None,
        about("A .rou.xml, .add.xml or .sumocfg file that replaces the environment's vehicles; "
              "repeatable.", "--demand", "-d"),
    ] = None,
    zones: Annotated[str, about("Comma-separated numbers of zones; 1 is always measured.")] = "1,4",
    layout: Annotated[str, about(f"{', '.join(ZONE_LAYOUTS)}, or a zone file.")] = "bisection",
    agents: Agents = None,
    background: Background = None,
    after: Annotated[int, about("Simulated seconds before the first turn.")] = 120,
    repeats: Annotated[int, about("Turns per world, of 10 simulated seconds.")] = 5,
    check: Annotated[bool, about("Also measure the monitor of invariants.", "--check")] = False,
    seed: Seed = 0,
    settings: Settings = None,
    say: Say = silent,
) -> BenchmarkReport:  # fmt: skip
    """Measure a world with several numbers of zones, by phase; fail if the states differ."""
    counts = numbers_of("--zones", zones)
    check_numbers(counts, after, repeats)
    if demand and (agents, background) != (None, None):
        raise ConfigError("--demand: it replaces all vehicles; omit --agents and --background")

    def maker(**more: Any) -> Callable[[int], Simulation]:
        return world_maker(
            env,
            demand or (),
            layout=layout,
            seconds=after + (repeats + 1) * TURN_S,
            seed=seed,
            agents=agents,
            background=background,
            overrides={**parse_settings(settings), **more},
        )

    checked = maker(**{"zones.check_invariants": True}) if check else None
    return measure_sharding(
        maker(), counts, after_s=after, repeats=repeats, make_checked=checked, say=say
    )


def measure_sharding(
    make: Callable[[int], Simulation],
    zones: Sequence[int],
    *,
    after_s: int = 120,
    repeats: int = 5,
    make_checked: Callable[[int], Simulation] | None = None,
    say: Say = silent,
) -> BenchmarkReport:
    """Measure the worlds in turn on one core."""
    check_numbers(zones, after_s, repeats)
    with one_core():
        say("creating the worlds")
        worlds = [TwinWorlds(make, count, make_checked) for count in sorted({1, *zones})]
        first = worlds[0].plain.simulation
        clock = first.config.clock
        for own in worlds:
            say(f"the first {after_s} s in {own.zones} zones")
            for number in range(len(own.worlds)):
                own.run(number, round(after_s / clock.ctrl_dt_s))
            own.end_turn()
        _check_equal(worlds)
        steps = round(TURN_S / clock.ctrl_dt_s)
        draw = random.Random(0)
        order = [(own, number) for own in worlds for number in range(len(own.worlds))]
        turns: list[list[Pair]] = [[] for _ in worlds]
        for repeat in range(repeats):
            say(f"measuring, {repeat + 1} of {repeats}")
            for part in range(PARTS):
                draw.shuffle(order)
                for own, number in order:
                    own.run(number, steps * (part + 1) // PARTS - steps * part // PARTS)
            for own, pairs in zip(worlds, turns, strict=True):
                pairs.append(own.end_turn())
            _check_equal(worlds)
    rows = [_row(own, pairs, turns[0]) for own, pairs in zip(worlds, turns, strict=True)]
    return _report(first, rows, after_s, repeats)


def _report(
    first: Simulation, rows: list[dict[str, Any]], after_s: int, repeats: int
) -> BenchmarkReport:
    agents, dt_s = first.config.population.agents, first.config.clock.sim_dt_s
    notes = [
        f"{row['zones']} zones, ns per vehicle and tick: "
        + ", ".join(f"{name} {ns:,.1f}" for name, ns in row["phases"].items())
        + f"; sum {row['timed_ns']:,.1f}, without stopwatches {row['plain_ns']:,.1f}"
        for row in rows
    ]
    return BenchmarkReport(
        f"{first.network.name}, {rows[0]['vehicles']:,.0f} vehicles, {agents} of them agents, halo "
        f"{rows[0]['halo_m']:.0f} m\none core, {repeats} turns after {after_s} s, ticks of "
        f"{dt_s:g} s; states of all worlds are equal",
        {
            "zones": "zones",
            "zone\nside, m": "side_m:,.0f",
            "ghosts": "ghosts:,.0f",
            "max /\nmean": "imbalance:.2f",
            "fullest": "largest_share:.0%",
            "moves\nper tick": "migrations:.2f",
            "µs per\nmove": "migration_us:.2f",
            "cost": "ratio:.2f",
            "with the\nmonitor": "checked_ratio:.2f",
        },
        rows,
        notes=notes,
        facts={
            "map_name": first.network.name,
            "dt_s": dt_s,
            "after_s": after_s,
            "repeats": repeats,
            "agents": agents,
            "state_hash": first.state_hash(),
        },
    )


def check_numbers(zones: Sequence[int], after_s: int, repeats: int) -> None:
    """Refuse invalid numbers before worlds are created."""
    check_range(after=(after_s, 1, 3600), repeats=(repeats, 1, 100))
    if not zones:
        raise ConfigError("zones: give at least one number of zones, such as 1,4,9")
    for count in zones:
        check_range(zones=(count, 1, MAX_ZONES))


def _check_equal(worlds: Sequence[TwinWorlds]) -> None:
    """Refuse to compare worlds with different states."""
    first = worlds[0].plain.simulation
    expected = first.state_hash()
    for own in worlds:
        for world in own.worlds:
            found = world.simulation.state_hash()
            if found != expected:
                raise EvaluationError(
                    f"'{first.network.name}' after {int(first.ticks()[0])} ticks: {own.zones} "
                    f"zones have the state {found}, the undivided world has {expected}; times of "
                    "different worlds are not compared"
                )


def _row(own: TwinWorlds, turns: list[Pair], undivided: list[Pair]) -> dict[str, Any]:
    """Return means of the loads and medians of the times over all turns.

    `largest_share` is the number of rows of the fullest zone, including ghosts, divided by the
    number of all vehicles. With one worker per zone, it is a lower bound of the time relative to
    the undivided tick.
    """
    simulation = own.plain.simulation
    min_x, min_y, max_x, max_y = simulation.network.extent_m
    loads: Mapping[str, float] = {
        name: sum(getattr(turn.plain, name) for turn in turns)
        for name in ("steps", "vehicles", "ghosts", "imbalance", "largest")
    }
    steps = loads["steps"]
    moves = sum(sum(turn.plain.moves) for turn in turns)
    # Use the phases of a single turn, because medians of phases would not add up to a tick.
    middle_ns = median_low([turn.timed_ns for turn in turns])
    middle = next(turn for turn in turns if turn.timed_ns == middle_ns)
    pairs = zip(turns, undivided, strict=True)
    checked = [turn.checked_ns / turn.plain_ns for turn in turns if turn.checked_ns is not None]
    return {
        "zones": own.zones,
        "side_m": math.sqrt((max_x - min_x) * (max_y - min_y) / own.zones),
        "halo_m": simulation.zones.loads().halo_m,
        "vehicles": loads["vehicles"] / steps,
        "ghosts": loads["ghosts"] / steps,
        "imbalance": loads["imbalance"] / steps,
        "largest_share": loads["largest"] / loads["vehicles"],
        "phases": middle.phases,
        "calls": middle.calls,
        "timed_ns": middle.timed_ns,
        "plain_ns": median(turn.plain_ns for turn in turns),
        "timed_ratio": median(turn.timed_ns / turn.plain_ns for turn in turns),
        "ratio": median(turn.plain_ns / other.plain_ns for turn, other in pairs),
        "migrations": moves / (steps * simulation.config.clock.ticks_per_step),
        "migration_us": _migration_us([turn.timed for turn in turns]),
        "checked_ratio": median(checked) if checked else None,
    }


def _migration_us(turns: Sequence[Turn]) -> float | None:
    """Return the time of `migrate` per vehicle that changes its zone, by regression over steps."""
    moves = [number for turn in turns for number in turn.moves]
    if len(set(moves)) < 2:
        return None
    times = [ns for turn in turns for ns in turn.move_ns]
    return linear_regression(moves, times).slope / 1000.0


if __name__ == "__main__":
    run(measure)
