"""What two nodes can gain at most: two worlds of half the size side by side, that share nothing.

Both nodes of a divided world do at least that, and have to exchange ghosts and leases besides. If
the halves take long, the machine is the limit: cores that share a cache, memory, or a core's parts.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
import time
from pathlib import Path
from statistics import median
from typing import Annotated, Any

from benchmarks.harness import Report, Say, about, check_positive, run, silent
from benchmarks.nodes import PER_JUNCTION, WARM_STEPS, make_city
from cavmarl.config.registry import load_config
from cavmarl.core.errors import ConfigError
from cavmarl.core.processes import start_python
from cavmarl.engine.world_setup import make_world
from cavmarl.parallel.local_worlds import LocalWorlds
from cavmarl.shards.shard import Commands

GO = "go\n"  # one turn
SERVES = "import sys; from benchmarks.node_limit import serve; serve(*sys.argv[1:])"


def measure(
    vehicles: Annotated[int, about("Size of the city.")] = 10_000,
    steps: Annotated[int, about("Steps of each turn.")] = 40,
    repeats: Annotated[int, about("Turns of each side, one after the other.")] = 7,
    say: Say = silent,
) -> Report:
    """Time a city, half of it alone, and two halves at once, by turns."""
    check_positive("--steps", steps)
    check_positive("--repeats", repeats)
    if vehicles < PER_JUNCTION * 32:
        raise ConfigError(f"--vehicles {vehicles}: at least {PER_JUNCTION * 32}")
    with tempfile.TemporaryDirectory() as folder:
        whole, half = (make_city(Path(folder), n) for n in (vehicles, vehicles // 2))
        say("three worlds are made")
        told = ((whole, vehicles), (half, vehicles // 2), (half, vehicles // 2))
        worlds = [_World(net, number, steps) for net, number in told]
        try:
            sides = {
                f"{vehicles:,} vehicles": worlds[:1],
                f"{vehicles // 2:,} vehicles": worlds[1:2],
                f"twice {vehicles // 2:,} at once": worlds[1:],
            }
            found: dict[str, list[tuple[float, float]]] = {name: [] for name in sides}
            for number in range(repeats):
                say(f"turn {number + 1} of {repeats}")
                for name, some in sides.items():
                    found[name].append(_turn(some))
        finally:
            for world in worlds:
                world.close()
    base_s = median(wall_s for wall_s, _ in next(iter(found.values())))
    rows = [_row(name, turns, base_s) for name, turns in found.items()]
    return Report(
        "what two nodes can gain at most",
        {"world": "world", "ms": "wall_ms:.3g", "cpu ms": "cpu_ms:.3g", "faster": "faster:.2f"},
        rows,
        notes=["ms: a tick by the clock; cpu ms: a tick of each process's processor; medians"],
    )


def _row(name: str, turns: list[tuple[float, float]], base_s: float) -> dict[str, Any]:
    wall_s, cpu_s = (median(values) for values in zip(*turns, strict=True))
    return {
        "world": name,
        "wall_ms": 1e3 * wall_s,
        "cpu_ms": 1e3 * cpu_s,
        "faster": base_s / wall_s,
    }


class _World:
    """An undivided world in a process of its own."""

    def __init__(self, net: Path, vehicles: int, steps: int) -> None:
        told = [str(net), str(vehicles), str(steps)]
        self.process: subprocess.Popen[Any] = start_python(
            ["-c", SERVES, *told],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        self.read()

    def go(self) -> None:
        assert self.process.stdin is not None
        self.process.stdin.write(GO)
        self.process.stdin.flush()

    def read(self) -> list[float]:
        assert self.process.stdout is not None
        line = self.process.stdout.readline()
        if not line:
            raise ConfigError("a process of the benchmark has ended; see what it printed")
        return [float(word) for word in line.split()]

    def close(self) -> None:
        self.process.kill()
        self.process.communicate()


def _turn(worlds: list[_World]) -> tuple[float, float]:
    """Seconds of a tick of the slower one: by the clock, and of the processor."""
    for world in worlds:
        world.go()
    found = [world.read() for world in worlds]
    return max(wall_s for wall_s, _ in found), max(cpu_s for _, cpu_s in found)


def serve(net: str, vehicles: str, steps: str) -> None:
    """Step an undivided world, so many steps for each line that comes in; tell the times."""
    others = int(vehicles) - 1
    config, base_dir = load_config(net, agents=1, background=others, max_cycles=1_000_000)
    worlds = LocalWorlds(make_world(config, base_dir), 1, warm=True)
    worlds.arrays.chosen[:] = True
    worlds.reset(1, 0)
    commands = Commands(worlds.arrays.controls, worlds.arrays.meta_actions)
    for _ in range(WARM_STEPS):
        worlds.step(commands)
    print(0.0, 0.0, flush=True)
    ticks = int(steps) * config.clock.ticks_per_step
    while sys.stdin.readline() == GO:
        wall_s, cpu_s = time.perf_counter(), time.process_time()
        for _ in range(int(steps)):
            worlds.step(commands)
        wall_s, cpu_s = time.perf_counter() - wall_s, time.process_time() - cpu_s
        print(wall_s / ticks, cpu_s / ticks, flush=True)


if __name__ == "__main__":
    run(measure)
