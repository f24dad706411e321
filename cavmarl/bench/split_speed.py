"""How much faster one world is in zones over several workers than undivided in one process."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from cavmarl.bench.worker_speed import WARM_STEPS, Measured
from cavmarl.config.registry import load_config
from cavmarl.core.errors import ConfigError, EvaluationError
from cavmarl.env.vector import make_vec

__all__ = ["SplitSpeed", "measure_splits", "split_line"]


@dataclass(frozen=True)
class SplitSpeed:
    """One world, undivided and in zones.

    Attributes:
        vehicles: that it has at the end.
        zones: of the divided worlds.
        workers: of the split one.
        undivided_ms: of each turn, ms a step of the world in one zone and the caller's process.
        whole_ms: in zones, on one worker.
        split_ms: in zones, over the workers.
    """

    vehicles: int
    zones: int
    workers: int
    undivided_ms: tuple[float, ...]
    whole_ms: tuple[float, ...]
    split_ms: tuple[float, ...]

    @property
    def ratio(self) -> float:
        """How many times faster the split world is than the undivided one; median of the turns."""
        turns = zip(self.undivided_ms, self.split_ms, strict=True)
        return statistics.median(a / b for a, b in turns)

    def to_dict(self) -> dict[str, Any]:
        """Plain values, for JSON."""
        return {**asdict(self), "ratio": self.ratio}


def split_line(splits: Sequence[SplitSpeed]) -> int | None:
    """The least number of vehicles from which on every split world was the faster one, if any."""
    line = None
    for split in sorted(splits, key=lambda split: split.vehicles, reverse=True):
        if split.ratio <= 1.0:
            break
        line = split.vehicles
    return line


def measure_splits(
    env: str | Path,
    vehicles: Sequence[int | None],
    *,
    zones: int | None = None,
    workers: int = 2,
    steps: int = 20,
    repeats: int = 7,
    seed: int = 0,
    agents: int | None = None,
    background: int | None = None,
    overrides: Mapping[str, Any] | None = None,
    say: Callable[[str], None] = lambda text: None,
) -> tuple[SplitSpeed, ...]:
    """Step one world undivided, in zones on one worker, and in zones over several, by turns.

    Args:
        env: as in `make_vec`.
        vehicles: in how many worlds of how many vehicles; None: as many as the environment has.
        zones: of the divided ones; default: one a worker.
        workers: of the split one.
        steps: of a turn.
        repeats: turns of each.
        seed: root of all random numbers.
        agents: shadows population.agents.
        background: shadows population.background, where `vehicles` says None.
        overrides: values for any other key.
        say: told what is being done.

    Raises:
        ConfigError: numbers that cannot be.
        EvaluationError: the worlds came out different.
        WorkerError: workers cannot be started.
    """
    zones = workers if zones is None else zones
    found = []
    for number in vehicles:
        say(f"splitting one world of {'its' if number is None else number} vehicles")
        others = background
        if number is not None:
            config, _ = load_config(env, agents=agents, overrides=overrides)
            others = number - config.population.agents
            if others < 0:
                raise ConfigError(f"{number} vehicles: agents alone are {config.population.agents}")
        wanted = {"agents": agents, "background": others, "overrides": overrides}
        found.append(_measure(env, zones, workers, steps, repeats, seed, wanted))
    return tuple(found)


def _measure(
    env: str | Path,
    zones: int,
    workers: int,
    steps: int,
    repeats: int,
    seed: int,
    wanted: Mapping[str, Any],
) -> SplitSpeed:
    measured: list[Measured] = []
    try:
        for count, parts in ((0, 1), (1, zones), (workers, zones)):
            began = time.perf_counter()
            vec = make_vec(env, zones=parts, workers=count, **wanted)
            measured.append(Measured(vec, count, time.perf_counter() - began))
            vec.reset(seed=seed)
            measured[-1].turn(WARM_STEPS)
        for _ in range(repeats):
            for one in measured:
                one.count_turn(steps)
        hashes = {one.vec.state_hash() for one in measured}
        running = int(measured[0].vec.traffic_stats()["running"])
    finally:
        for one in measured:
            one.vec.close()
    if len(hashes) > 1:
        raise EvaluationError(f"{env}: the worlds in {zones} zones are not the undivided one")
    rows = [one.row(repeats * steps).step_ms for one in measured]
    return SplitSpeed(running, zones, workers, *rows)
