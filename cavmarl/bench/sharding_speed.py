"""What it costs to divide a world, by phases of the tick, beside the same world undivided.

All zones run in this process on one core, so the whole of the work is seen. Every number of zones
has two worlds, one with a stopwatch on every phase. All worlds are advanced by turns, each of them
a part of its turn at a time and in an order that is drawn anew for every part, and ratios are taken
within a turn: what else the machine does, and what a world before has pushed out of the caches,
falls on all of them.
"""

from __future__ import annotations

import math
import random
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from statistics import linear_regression, median, median_low
from typing import Any

from cavmarl.bench.sharding_turns import Turn, TwinWorlds
from cavmarl.bench.step_speed import one_core
from cavmarl.config.env import MAX_ZONES
from cavmarl.core.errors import ConfigError, EvaluationError
from cavmarl.engine.simulation import Simulation

__all__ = ["TURN_S", "ShardingSpeed", "ZoneCost", "check_numbers", "measure_sharding"]

TURN_S = 10
PARTS = 5  # of a turn, of all worlds in between
LIMITS = {"after": 3600, "repeats": 100}


@dataclass(frozen=True)
class ZoneCost:
    """A world in some number of zones; means over all ticks of all turns, times in ns.

    Attributes:
        zones: how many.
        side_m: of a square as large as the map over the number of zones.
        halo_m: how far zones see over their borders.
        vehicles: in the world.
        ghosts: in all zones together.
        imbalance: maximum over mean of the vehicles that zones own.
        largest_share: rows of the zone with most, ghosts among them, over the world's vehicles: the
            least time that a worker for each zone could leave of the undivided tick.
        phases: ns a vehicle and tick by the names of `PHASES`, of the median turn.
        calls: the same by the names of the runtime's calls, without the Python between them.
        timed_ns: their sum: a tick with a stopwatch on every phase, less its own time.
        plain_ns: a tick without one, median.
        timed_ratio: a tick with one over that without, median of the turns.
        ratio: a tick without one over that of the undivided world, median of the turns.
        migrations: vehicles that changed their zone, a tick.
        migration_us: by how many µs each of them makes `migrate` longer, by linear regression over
            steps; None: all steps have the same number. The rest of `migrate` finds them.
        checked_ratio: a tick with the monitor of invariants over that without, median of the turns;
            None: it was not measured.
    """

    zones: int
    side_m: float
    halo_m: float
    vehicles: float
    ghosts: float
    imbalance: float
    largest_share: float
    phases: dict[str, float]
    calls: dict[str, float]
    timed_ns: float
    plain_ns: float
    timed_ratio: float
    ratio: float
    migrations: float
    migration_us: float | None
    checked_ratio: float | None = None


@dataclass(frozen=True)
class ShardingSpeed:
    """Result of `measure_sharding`.

    Attributes:
        map_name: the map's name.
        dt_s: seconds a tick.
        after_s: simulated seconds before the first turn.
        repeats: turns of each world.
        agents: in the world's seats.
        state_hash: of all worlds, after the last turn.
        rows: one a number of zones, rising from 1.
    """

    map_name: str
    dt_s: float
    after_s: int
    repeats: int
    agents: int
    state_hash: str
    rows: tuple[ZoneCost, ...]

    def to_dict(self) -> dict[str, Any]:
        """Plain values, for JSON."""
        return asdict(self)


def measure_sharding(
    make: Callable[[int], Simulation],
    zones: Sequence[int],
    *,
    after_s: int = 120,
    repeats: int = 5,
    make_checked: Callable[[int], Simulation] | None = None,
    progress: Callable[[str], None] = lambda text: None,
) -> ShardingSpeed:
    """Measure by turns on one core.

    Args:
        make: the same world in k zones, at the start of an episode.
        zones: numbers of zones; the undivided world is measured in any case.
        after_s: simulated seconds before the first turn.
        repeats: turns of each world, of `TURN_S` simulated seconds.
        make_checked: as `make`, with `zones.check`; None: what the monitor costs is not measured.
        progress: told what is going on.

    Raises:
        ConfigError: a number out of range; nobody drives; more zones than the map can hold.
        EvaluationError: a divided world is not the undivided one.
    """
    check_numbers(zones, after_s, repeats)
    counts = sorted({1, *zones})
    with one_core():
        progress("making the worlds")
        worlds = [TwinWorlds(make, count, make_checked) for count in counts]
        first = worlds[0].plain.simulation
        clock = first.config.clock
        for count, own in zip(counts, worlds, strict=True):
            progress(f"the first {after_s} s in {count} zones")
            for number in range(len(own.worlds)):
                own.run(number, round(after_s / clock.ctrl_dt_s))
            own.end_turn()
        _check_equal(worlds)
        steps = round(TURN_S / clock.ctrl_dt_s)
        draw = random.Random(0)
        order = [(own, number) for own in worlds for number in range(len(own.worlds))]
        for repeat in range(repeats):
            progress(f"measuring, {repeat + 1} of {repeats}")
            for part in range(PARTS):
                draw.shuffle(order)
                for own, number in order:
                    own.run(number, steps * (part + 1) // PARTS - steps * part // PARTS)
            for own in worlds:
                own.turns.append(own.end_turn())
            _check_equal(worlds)
    return ShardingSpeed(
        map_name=first.network.name,
        dt_s=clock.sim_dt_s,
        after_s=after_s,
        repeats=repeats,
        agents=first.config.population.agents,
        state_hash=first.state_hash(),
        rows=tuple(_cost(own, worlds[0]) for own in worlds),
    )


def check_numbers(zones: Sequence[int], after_s: int, repeats: int) -> None:
    """Refuse what cannot be measured before a world is made for it.

    Raises:
        ConfigError: a number out of range, or none.
    """
    for name, value in (("after", after_s), ("repeats", repeats)):
        if not 1 <= value <= LIMITS[name]:
            raise ConfigError(f"{name} = {value}: must be from 1 to {LIMITS[name]}")
    if not zones:
        raise ConfigError("zones: name at least one number of zones, as in 1,4,9")
    for count in zones:
        if not 1 <= count <= MAX_ZONES:
            raise ConfigError(f"zones = {count}: must be from 1 to {MAX_ZONES}")


def _check_equal(worlds: Sequence[TwinWorlds]) -> None:
    """Refuse to compare what is not the same world.

    Raises:
        EvaluationError: states differ.
    """
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


def _cost(own: TwinWorlds, undivided: TwinWorlds) -> ZoneCost:
    """Means of the loads and medians of the times over all turns."""
    simulation, turns = own.plain.simulation, own.turns
    min_x, min_y, max_x, max_y = simulation.network.extent_m
    loads = [turn.plain for turn in turns]
    steps = sum(turn.steps for turn in loads)
    vehicles = sum(turn.vehicles for turn in loads)
    migrations = sum(sum(turn.moves) for turn in loads)
    # The phases of one turn: medians of each would not add up to a tick.
    middle_ns = median_low([turn.timed_ns for turn in turns])
    middle = next(turn for turn in turns if turn.timed_ns == middle_ns)
    ratios = (
        turn.plain_ns / other.plain_ns for turn, other in zip(turns, undivided.turns, strict=True)
    )
    checked = [turn.checked_ns / turn.plain_ns for turn in turns if turn.checked_ns is not None]
    return ZoneCost(
        zones=own.zones,
        side_m=math.sqrt((max_x - min_x) * (max_y - min_y) / own.zones),
        halo_m=simulation.zone_loads().halo_m,
        vehicles=vehicles / steps,
        ghosts=sum(turn.ghosts for turn in loads) / steps,
        imbalance=sum(turn.imbalance for turn in loads) / steps,
        largest_share=sum(turn.largest for turn in loads) / vehicles,
        phases=middle.phases,
        calls=middle.calls,
        timed_ns=middle.timed_ns,
        plain_ns=median(turn.plain_ns for turn in turns),
        timed_ratio=median(turn.timed_ns / turn.plain_ns for turn in turns),
        ratio=median(ratios),
        migrations=migrations / (steps * simulation.config.clock.ticks_per_step),
        migration_us=_migration_us([turn.timed for turn in turns]),
        checked_ratio=median(checked) if checked else None,
    )


def _migration_us(turns: Sequence[Turn]) -> float | None:
    moves = [number for turn in turns for number in turn.moves]
    if len(set(moves)) < 2:
        return None
    times = [ns for turn in turns for ns in turn.move_ns]
    return linear_regression(moves, times).slope / 1000.0
