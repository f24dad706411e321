"""How far the clock of a follower in another process drifts from its master's: Table II.

The table is that of the co-simulation paper. Both clocks are read where they are: the master's
here, the follower's in its own process, from what it is sent.
"""

from __future__ import annotations

import csv
import json
import math
import subprocess
from dataclasses import asdict, dataclass
from fractions import Fraction
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Unpack

from cavmarl.bench.harness import check_range
from cavmarl.config.world_spec import WorldKeys, WorldSpec
from cavmarl.core.errors import EvaluationError
from cavmarl.core.processes import start_python
from cavmarl.cosim.followers.followed_world import FollowedWorld
from cavmarl.cosim.time_master import OwnTicks, Pacer, RealTime, Unpaced
from cavmarl.env.parallel import parallel_env

PROGRAM = "benchmarks.clock_reader"
ENDS_S = 30.0  # for the follower to end by itself
JOINS_S = 60.0  # for it to start
TIMEOUT_S = 60.0
BEFORE = 20  # steps that the world has gone on before the follower joins


@dataclass(frozen=True)
class DriftRow:
    """The two clocks after a step; times are simulated."""

    step: int  # steps since the follower has joined
    master_s: float  # the master's time since then
    follower_s: float  # the world's time as the follower has it
    normalised_s: float  # the same since it has joined
    delta_s: float  # by how much that is ahead of the master's
    ratio: float  # of the two
    # by how much the clock of the follower's own process, by which it does not go, is ahead of the
    # master's; None: steps are not paced by a clock
    own_delta_s: float | None


@dataclass(frozen=True)
class ClockDrift:
    """What was measured."""

    environment: str  # on which
    dt_s: float  # seconds a tick, which is a step here
    rogue: float  # the share of steps in which the follower ticked by itself
    answer: OwnTicks  # what the master did about that
    pace: (
        float | None
    )  # simulated seconds a second of the master's process; None: as fast as it goes
    rows: tuple[DriftRow, ...]  # at steps 100, 500, 1000, 5000 and so on, and the last one
    own_ticks: int  # how often it did, by its own count
    counted: int  # the same by the master's
    drift_events: int  # how often the master has noticed that the world had gone on without it
    noticed_ticks: int | None  # of the master, from the first such tick on; None: it did not

    @property
    def holds(self) -> bool:
        """The clocks are equal; or, where own ticks are obeyed, that was noticed in time."""
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
    """Run a world as master, with a follower in a process of its own that reads its clock.

    With `pace` the master's steps wait for the wall clock, and the table says how far a follower
    would be off that went by the clock of its own process instead of the master's.
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
    own, drifts = (
        [event.tick for event in master.events if event.kind == kind]
        for kind in ("own_tick", "drift")
    )
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
        noticed_ticks=drifts[0] - own[0] if own and drifts else None,
    )


class _FromJoining:
    """Paces steps from when the follower has joined on."""

    def __init__(self, then: Pacer) -> None:
        self._then = then
        self.has_joined = False

    def wait(self, elapsed_s: float) -> None:
        if self.has_joined:
            self._then.wait(elapsed_s)


def _followed(
    world: FollowedWorld, pacer: _FromJoining, steps: int, rogue: float
) -> tuple[list[int], dict[str, Any]]:
    """The master's ticks after each step since the follower has joined, and what that has read."""
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
            told, _ = process.communicate(timeout=ENDS_S)
        finally:
            process.kill()
    if process.returncode:
        raise EvaluationError(f"{PROGRAM} ended with {process.returncode}; see its own words")
    return clock, json.loads(told)


def own_s(seconds: list[float], pace: float | None) -> list[float] | None:
    """What a clock of the follower's own says in simulated seconds, where there is one."""
    return None if pace is None else [pace * since_s for since_s in seconds]


def rows_of(
    master: list[int], follower: list[int], dt_s: float, own_s: list[float] | None = None
) -> tuple[DriftRow, ...]:
    """Table II of two series of ticks, from when the follower has joined on.

    Args:
        master: its tick after each step.
        follower: the tick that the follower has then.
        dt_s: seconds a tick.
        own_s: what a clock of the follower's own says after each step.
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
