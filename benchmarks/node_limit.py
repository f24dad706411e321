"""Upper bound of the speedup by two nodes, measured with two independent half worlds.

Both nodes of a divided world do at least this work, and also exchange ghosts and leases. If the
halves are slow, the machine is the limit, because programs share a cache, memory or a core.
"""

from __future__ import annotations

import tempfile
from contextlib import ExitStack, closing
from pathlib import Path
from statistics import median
from typing import Annotated, Any

from benchmarks.program import run
from benchmarks.world_processes import PER_JUNCTION, WorldProcess, make_city
from cavmarl.bench.harness import BenchmarkReport, Say, check_positive, silent
from cavmarl.cli.output import about
from cavmarl.core.errors import ConfigError


def measure(
    vehicles: Annotated[int, about("Number of vehicles.")] = 10_000,
    steps: Annotated[int, about("Steps per turn.")] = 40,
    repeats: Annotated[int, about("Turns of each side.")] = 7,
    say: Say = silent,
) -> BenchmarkReport:
    """Time in turn a city, half of the city alone, and two halves at the same time."""
    check_positive("--steps", steps)
    check_positive("--repeats", repeats)
    if vehicles < PER_JUNCTION * 32:
        raise ConfigError(f"--vehicles {vehicles}: must be at least {PER_JUNCTION * 32}")
    with tempfile.TemporaryDirectory() as folder:
        whole, half = (make_city(Path(folder), n) for n in (vehicles, vehicles // 2))
        say("creating three worlds")
        cities = ((whole, vehicles), (half, vehicles // 2), (half, vehicles // 2))
        with ExitStack() as stack:
            worlds = [
                stack.enter_context(closing(WorldProcess(net, number))) for net, number in cities
            ]
            sides = {
                f"{vehicles:,} vehicles": worlds[:1],
                f"{vehicles // 2:,} vehicles": worlds[1:2],
                f"2 worlds of {vehicles // 2:,} at once": worlds[1:],
            }
            found: dict[str, list[tuple[float, float]]] = {name: [] for name in sides}
            for number in range(repeats):
                say(f"turn {number + 1} of {repeats}")
                for name, some in sides.items():
                    found[name].append(_turn(some, steps))
    base_s = median(wall_s for wall_s, _ in next(iter(found.values())))
    rows = [_row(name, turns, base_s) for name, turns in found.items()]
    return BenchmarkReport(
        "upper bound of the speedup of two nodes",
        {"world": "world", "ms": "wall_ms:.3g", "cpu ms": "cpu_ms:.3g", "faster": "faster:.2f"},
        rows,
        notes=["ms: wall time per tick; cpu ms: processor time per tick and process; medians"],
    )


def _row(name: str, turns: list[tuple[float, float]], base_s: float) -> dict[str, Any]:
    wall_s, cpu_s = (median(values) for values in zip(*turns, strict=True))
    return {
        "world": name,
        "wall_ms": 1e3 * wall_s,
        "cpu_ms": 1e3 * cpu_s,
        "faster": base_s / wall_s,
    }


def _turn(worlds: list[WorldProcess], steps: int) -> tuple[float, float]:
    """Return wall time and processor time per tick of the slower world, s."""
    for world in worlds:
        world.go(steps)
    found = [world.read() for world in worlds]
    return max(turn.tick_s for turn in found), max(turn.node_s for turn in found)


if __name__ == "__main__":
    run(measure)
