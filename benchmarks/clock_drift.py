"""Drift between a time master's clock and that of a follower in another process (Table II).

The table is that of paper B (`docs/explanation/papers.md`). Each clock is read in its own process;
the follower's clock is derived from the messages it gets.
"""

from __future__ import annotations

import csv
import json
import math
import subprocess
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from fractions import Fraction
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Unpack

from cavmarl.bench.harness import BenchmarkReport, check_range
from cavmarl.config.world_spec import WorldKeys, WorldSpec
from cavmarl.core.errors import EvaluationError
from cavmarl.core.processes import start_python
from cavmarl.cosim.carla.carla_session import OtherTicks
from cavmarl.cosim.followers.followed_world import FollowedWorld
from cavmarl.cosim.time_master import OwnTicks, Pacer, RealTime, TimeMaster, Unpaced
from cavmarl.env.parallel import parallel_env

PROGRAM = "benchmarks.clock_reader"
ENDS_S = 30.0  # time for the follower to exit
JOINS_S = 60.0  # time for the follower to start
TIMEOUT_S = 60.0
BEFORE = 20  # steps of the world before the follower joins


@dataclass(frozen=True)
class DriftRow:
    """The two clocks after a step; times are simulated."""

    step: int  # steps since the follower joined
    master_s: float  # master's time since the follower joined
    follower_s: float  # world time that the follower knows
    normalised_s: float  # this time since the follower joined
    delta_s: float  # follower's lead over the master
    ratio: float  # follower's time / master's time
    # lead of the follower's process clock, which is not used; None: steps are not paced
    own_delta_s: float | None


@dataclass(frozen=True)
class ClockDrift:
    """Result of `measure_drift`."""

    environment: str  # name of the environment
    dt_s: float  # seconds per tick; a step is one tick
    rogue: float  # share of steps in which the follower ticked on its own
    answer: OwnTicks | OtherTicks  # the master's reaction to the follower's ticks
    pace: float | None  # simulated seconds per second of the master; None: unpaced
    rows: tuple[DriftRow, ...]  # at steps 100, 500, 1000, 5000, …, and the last one
    own_ticks: int  # number of the follower's own ticks, counted by the follower
    counted: int  # number of the follower's own ticks, counted by the master
    drift_events: int  # how often the master noticed that the world had advanced without its tick
    noticed_ticks: int | None  # ticks of the master until it first noticed; None: never

    @property
    def holds(self) -> bool:
        """Return whether the clocks agree, or the master noticed the follower's ticks in time."""
        if self.answer == "obey" and self.own_ticks:
            return self.noticed_ticks is not None and self.noticed_ticks <= 1
        return all(row.delta_s == 0.0 and row.ratio == 1.0 for row in self.rows)


def measure_drift(
    env: str | Path | WorldSpec,
    *,
    steps: int,
    rogue: float = 0.0,
    answer: OwnTicks = "obey",
    pace: float | None = None,
    **keys: Unpack[WorldKeys],
) -> ClockDrift:
    """Run a world as time master, with a follower in its own process that reads the clock.

    With `pace`, the master's steps wait for the wall clock. The table then also has the error of a
    follower that would use its own process clock.
    """
    pacer = _FromJoining(Unpaced() if pace is None else RealTime(pace))
    check_range(steps=(steps, 1, math.inf), rogue=(rogue, 0.0, 1.0))
    spec = WorldSpec.of(env, **keys)
    settings = {"population.mode": "respawn", **spec.overrides}
    made = parallel_env(spec.env, overrides=settings)
    dt_s = made.config.clock.sim_dt_s
    settings |= {"clock.ctrl_dt_s": dt_s, "horizon_s": dt_s * (BEFORE + 2 * steps + 1)}
    with (
        TemporaryDirectory() as folder,
        FollowedWorld(
            parallel_env(spec.env, overrides=settings),
            Path(folder) / "clock.sock",
            timeout_s=TIMEOUT_S,
            own_ticks=answer,
            on_drift="record",
            pacer=pacer,
        ) as world,
    ):
        world.reset(spec.seed)
        for _ in range(BEFORE):
            world.step()
        clock, read = _followed(world, pacer, steps, rogue)
        master = world.master
    return ClockDrift(
        environment=made.metadata["name"],
        dt_s=dt_s,
        rogue=rogue,
        answer=answer,
        pace=pace,
        rows=rows_of(clock, read["ticks"], dt_s, own_s(read["own_s"], pace)),
        own_ticks=read["own_ticks"],
        counted=master.own_ticks,
        drift_events=master.drifts,
        noticed_ticks=noticed_after(master),
    )


def noticed_after(master: TimeMaster) -> int | None:
    """Return the ticks from the first own tick of a follower until the master noticed a drift."""
    own, drifts = (
        [event.tick for event in master.events if event.kind == kind]
        for kind in ("own_tick", "drift")
    )
    return drifts[0] - own[0] if own and drifts else None


def drift_report(
    found: ClockDrift,
    title: str,
    clocks: tuple[str, str],
    notes: Sequence[str],
    facts: Mapping[str, Any] | None = None,
) -> BenchmarkReport:
    """Return Table II as a report.

    `clocks`: names of the two clocks. `facts`: additional figures.
    """
    master, follower = clocks
    columns = {
        "step": "step",
        f"{master}, s": "master_s:.1f",
        f"{follower}, s": "follower_s:.1f",
        "normalised, s": "normalised_s:.1f",
        "Δ, s": "delta_s:.1f",
        "ratio": "ratio:.2f",
    }
    if found.pace is not None:
        columns["own clock, Δ, s"] = "own_delta_s:+.4f"
    return BenchmarkReport(
        title,
        columns,
        [asdict(row) for row in found.rows],
        notes=list(notes),
        facts={**asdict(found), **(facts or {}), "holds": found.holds},
        holds=found.holds,
    )


class _FromJoining:
    """Paces steps from the moment when the follower has joined."""

    def __init__(self, then: Pacer) -> None:
        self._then = then
        self.has_joined = False

    def wait(self, elapsed_s: float) -> None:
        if self.has_joined:
            self._then.wait(elapsed_s)


def _followed(
    world: FollowedWorld, pacer: _FromJoining, steps: int, rogue: float
) -> tuple[list[int], dict[str, Any]]:
    """Return the master's tick after each step since the follower joined, and its output."""
    words = ["-m", PROGRAM, str(world.address), str(rogue)]
    with start_python(words, stdout=subprocess.PIPE, text=True) as process:
        try:
            world.wait_for(1, JOINS_S)
            joined, pacer.has_joined = world.master.tick, True
            clock = [0]
            for _ in range(steps):
                world.step()
                clock.append(world.master.tick - joined)
            world.master.look_for_drift()
            world.close()
            output, _ = process.communicate(timeout=ENDS_S)
        finally:
            process.kill()
    if process.returncode:
        raise EvaluationError(f"{PROGRAM} ended with {process.returncode}; see its output")
    return clock, json.loads(output)


def own_s(seconds: list[float], pace: float | None) -> list[float] | None:
    """Return the follower's own clock in simulated seconds, if steps are paced."""
    return None if pace is None else [pace * since_s for since_s in seconds]


def rows_of(
    master: list[int], follower: list[int], dt_s: float, own_s: list[float] | None = None
) -> tuple[DriftRow, ...]:
    """Build Table II from two series of ticks that begin when the follower joined.

    Args:
        master: the master's tick after each step.
        follower: the follower's tick after each step.
        dt_s: seconds per tick.
        own_s: the follower's own clock after each step.
    """
    last = len(master) - 1
    marks = [mark for n in range(2, 9) for mark in (10**n, 5 * 10**n) if mark < last]
    rows = []
    for step in [*marks, last]:
        elapsed, seen = master[step], follower[step] - follower[0]
        rows.append(
            DriftRow(
                step=step,
                master_s=elapsed * dt_s,
                follower_s=follower[step] * dt_s,
                normalised_s=seen * dt_s,
                delta_s=(seen - elapsed) * dt_s,
                ratio=float(Fraction(seen, elapsed)),
                own_delta_s=None if own_s is None else own_s[step] - elapsed * dt_s,
            )
        )
    return tuple(rows)


def write_rows(path: Path, rows: tuple[DriftRow, ...]) -> None:
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, list(asdict(rows[0])))
        writer.writeheader()
        writer.writerows(asdict(row) for row in rows)
