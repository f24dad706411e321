"""How much faster worlds of unequal cost are if they may change their worker."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cavmarl.bench.filling import write_filling_demand
from cavmarl.core.errors import ConfigError, EvaluationError
from cavmarl.engine.world_setup import load_world
from cavmarl.env.vector import CavVectorEnv, make_vec
from cavmarl.evaluate.provenance.machine import describe_hardware
from cavmarl.parallel.pooled_worlds import PooledWorlds
from cavmarl.zones.partition.zone_statistics import imbalance

__all__ = ["MovingRow", "MovingSpeed", "measure_moving"]

SETTLE_ROUNDS = 6  # before anything is timed


@dataclass(frozen=True)
class MovingRow:
    """The same worlds, placed once or again and again.

    Attributes:
        name: `fixed` or `moving`.
        step_ms: of each turn, ms a step.
        busiest_ms: processor time of the busiest worker, ms a step.
        imbalance: that over the mean of all workers.
        moves: of worlds in all, those before the turns among them.
        move_ms: what one has taken, with everybody waiting.
    """

    name: str
    step_ms: tuple[float, ...]
    busiest_ms: float
    imbalance: float
    moves: int
    move_ms: float | None


@dataclass(frozen=True)
class MovingSpeed:
    """What was measured.

    Attributes:
        env: on whose map.
        worlds: that were stepped together.
        workers: over which they were shared out.
        old: worlds that had been filling for long; the others had begun anew.
        vehicles: of each world at the end.
        rows: fixed, then moving.
        hardware: that it ran on.
    """

    env: str
    worlds: int
    workers: int
    old: int
    vehicles: tuple[int, ...]
    rows: tuple[MovingRow, MovingRow]
    hardware: dict[str, Any]

    @property
    def ratio(self) -> float:
        """How many times faster the moving ones are; median of the turns, one beside the other."""
        fixed, moving = self.rows
        return statistics.median(a / b for a, b in zip(fixed.step_ms, moving.step_ms, strict=True))

    @property
    def processor_ratio(self) -> float:
        """The same by processor time of the busiest worker: what free cores would lead to."""
        fixed, moving = self.rows
        return fixed.busiest_ms / moving.busiest_ms

    def to_dict(self) -> dict[str, Any]:
        """Plain values, for JSON."""
        return asdict(self) | {"ratio": self.ratio, "processor_ratio": self.processor_ratio}


def measure_moving(
    env: str | Path,
    *,
    worlds: int = 16,
    workers: int = 2,
    lead: int = 600,
    every: int = 10,
    period_s: float = 5.0,
    steps: int = 20,
    repeats: int = 7,
    seed: int = 0,
    overrides: Mapping[str, Any] | None = None,
    say: Callable[[str], None] = lambda text: None,
) -> MovingSpeed:
    """Let worlds fill, begin half of them anew, and step them, placed once and moving, by turns.

    Worlds are shared out evenly by number at first, so the first half of the workers then has the
    full ones. What agents decide is not timed.

    Args:
        env: on whose map; vehicles enter it at all its ends.
        worlds: stepped together.
        workers: over which they are shared out.
        lead: steps before half of the worlds begin anew.
        every: steps from round to round of the moving ones.
        period_s: between two vehicles of one road into the map.
        steps: of a turn.
        repeats: turns of each.
        seed: root of all random numbers.
        overrides: values for any other key.
        say: told what is being done.

    Raises:
        ConfigError: numbers that cannot be.
        EvaluationError: the worlds came out different.
        WorkerError: workers cannot be started.
    """
    if not 2 <= workers <= worlds or min(lead, every, steps, repeats) < 1 or not period_s > 0.0:
        raise ConfigError(
            f"{worlds} worlds over {workers} workers, {lead} steps before, a round every {every}, "
            f"{repeats} turns of {steps} steps, {period_s:g} s: at least 2 workers, no more than "
            "worlds, and all others above 0"
        )
    measured: list[_Measured] = []
    with TemporaryDirectory() as folder:
        path = Path(folder) / "filling.rou.xml"
        world = load_world(env, overrides=overrides)
        all_steps = lead + SETTLE_ROUNDS * every + repeats * steps + 1  # no episode ends
        seconds = all_steps * world.config.clock.ctrl_dt_s
        write_filling_demand(world.network, path, seconds=seconds, period_s=period_s)
        wanted = {
            "traffic.demand": [str(path)],
            "traffic.on_bad_route": "skip",
            "population.mode": "seats",
            "horizon_s": seconds,
            **(overrides or {}),
        }
        try:
            for name, balance_steps in (("fixed", 0), ("moving", every)):
                say(f"{name}: {lead} steps")
                vec = make_vec(
                    env,
                    num_envs=worlds,
                    workers=workers,
                    agents=1,
                    background=0,
                    overrides={**wanted, "workers.balance_steps": balance_steps},
                )
                measured.append(_Measured(name, vec))
                measured[-1].lead(seed, lead, SETTLE_ROUNDS * every)
            for n in range(repeats):
                say(f"turn {n + 1} of {repeats}")
                for one in measured:
                    one.turn(steps)
            hashes, vehicles = zip(*(one.state() for one in measured), strict=True)
        finally:
            for one in measured:
                one.vec.close()
    if hashes[0] != hashes[1]:
        raise EvaluationError(f"{env}: worlds that move are not those that do not")
    fixed, moving = (one.row(repeats * steps) for one in measured)
    half = worlds // 2
    return MovingSpeed(
        str(env), worlds, workers, half, vehicles[0], (fixed, moving), describe_hardware()
    )


class _Measured:
    """Worlds over workers, and what their turns have taken."""

    def __init__(self, name: str, vec: CavVectorEnv) -> None:
        assert isinstance(vec.worlds, PooledWorlds)
        self.vec = vec
        self._name = name
        self._worlds = vec.worlds
        self._step_ms: list[float] = []
        self._busy_s = np.zeros(len(vec.worlds.pool.pids))

    def lead(self, seed: int, steps: int, settle: int) -> None:
        """Fill the worlds, begin the second half anew, and let the moving ones move."""
        vec = self.vec
        vec.reset(seed=seed)
        self._drive(steps)
        vec.reset(options={"reset_mask": np.arange(vec.num_envs) >= vec.num_envs // 2})
        self._drive(settle)

    def turn(self, steps: int) -> None:
        """Some steps that count."""
        before = self._processor_s()
        self._step_ms.append(1e3 * self._drive(steps) / steps)
        self._busy_s += self._processor_s() - before

    def state(self) -> tuple[list[str], tuple[int, ...]]:
        """Hashes of all worlds, and their vehicles."""
        vec, worlds = self.vec, range(self.vec.num_envs)
        vehicles = tuple(int(vec.traffic_stats(w)["running"]) for w in worlds)
        return [vec.state_hash(w) for w in worlds], vehicles

    def row(self, steps: int) -> MovingRow:
        """What has been found in so many steps."""
        mover = self._worlds.mover
        moves = 0 if mover is None else mover.moves
        return MovingRow(
            self._name,
            tuple(self._step_ms),
            1e3 * float(self._busy_s.max()) / steps,
            imbalance(self._busy_s.tolist()),
            moves,
            1e3 * mover.moved_s / moves if mover is not None and moves else None,
        )

    def _drive(self, steps: int) -> float:
        """Seconds that the steps have taken; nobody steers."""
        actions = np.zeros_like(self.vec.action_space.sample())
        began = time.perf_counter()
        for _ in range(steps):
            self.vec.step(actions)
        return time.perf_counter() - began

    def _processor_s(self) -> NDArray[np.float64]:
        return np.array(self._worlds.pool.processor_s())
