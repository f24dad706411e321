"""How evenly zones share out vehicles if they become others while a world runs, and its price."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.errors import ConfigError, EvaluationError
from cavmarl.env.vector import CavVectorEnv, make_vec
from cavmarl.evaluate.provenance.machine import describe_hardware
from cavmarl.evaluate.statistics import Interval, mean_interval

__all__ = ["RecutRow", "RecutSpeed", "measure_recutting"]

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class RecutRow:
    """Worlds of several seeds with zones of one kind.

    Attributes:
        name: `static` or `re-cut`.
        imbalance: of each seed, mean over the steps of the fullest zone's vehicles over the mean.
        step_ms: of each seed, median step.
        recuts: in all.
        moved: vehicles that were in a zone of another number then.
        recut_ms: what one has taken; None: there was none.
    """

    name: str
    imbalance: tuple[float, ...]
    step_ms: tuple[float, ...]
    recuts: int
    moved: int
    recut_ms: float | None

    @property
    def imbalance95(self) -> Interval | None:
        """Of the mean over seeds."""
        return mean_interval(np.array(self.imbalance))


@dataclass(frozen=True)
class RecutSpeed:
    """What was measured.

    Attributes:
        env: which environment.
        zones: how many.
        vehicles: of a world, mean at the end.
        rows: static, then re-cut.
        hardware: that it ran on.
    """

    env: str
    zones: int
    vehicles: float
    rows: tuple[RecutRow, RecutRow]
    hardware: dict[str, Any]

    @property
    def ratios(self) -> Floats:
        """(seeds,) imbalance of the re-cut world over that of the static one."""
        static, recut = self.rows
        return np.asarray(np.array(recut.imbalance) / np.array(static.imbalance))

    def to_dict(self) -> dict[str, Any]:
        """Plain values, for JSON."""
        interval = mean_interval(self.ratios)
        return asdict(self) | {
            "ratio": float(self.ratios.mean()),
            "ratio95": None if interval is None else asdict(interval),
        }


def measure_recutting(
    env: str | Path,
    *,
    zones: int = 4,
    every: int = 20,
    steps: int = 300,
    seeds: int = 5,
    overrides: Mapping[str, Any] | None = None,
    say: Callable[[str], None] = lambda _: None,
) -> RecutSpeed:
    """Step a world whose zones stay beside one whose zones become others, seed by seed.

    Args:
        env: an entry, a folder or a map.
        zones: of each.
        every: steps from one look at the zones to the next.
        steps: of each seed.
        seeds: how many; an interval needs two.
        overrides: other keys.
        say: is told what goes on.

    Raises:
        ConfigError: numbers that cannot work.
        EvaluationError: the two worlds are not equal.
    """
    for name, number, least in (("zones", zones, 2), ("every", every, 1), ("steps", steps, 1),
                                ("seeds", seeds, 1)):  # fmt: skip
        if number < least:
            raise ConfigError(f"{name} = {number}: must be at least {least}")
    common = {"zones.count": zones, **(overrides or {})}
    static, recut = (
        make_vec(env, overrides={**common, "zones.recut_steps": often}) for often in (0, every)
    )
    runs: list[tuple[list[float], list[float]]] = [([], []), ([], [])]
    vehicles = []
    for seed in range(seeds):
        say(f"seed {seed + 1} of {seeds}")
        for (uneven, taken), found in zip(
            runs, _run_beside((static, recut), seed, steps), strict=True
        ):
            uneven.append(float(found[0].mean()))
            taken.append(float(np.median(found[1])))
        if static.state_hash() != recut.state_hash():
            raise EvaluationError(f"seed {seed}: the world that was cut anew is another one")
        vehicles.append(int(static.simulation.running()[0]))
    rows = [
        _row(name, vec, *run)
        for name, vec, run in zip(("static", "re-cut"), (static, recut), runs, strict=True)
    ]
    return RecutSpeed(
        static.config.name, zones, statistics.fmean(vehicles), (rows[0], rows[1]),
        describe_hardware(),
    )  # fmt: skip


def _run_beside(
    pair: tuple[CavVectorEnv, CavVectorEnv], seed: int, steps: int
) -> list[tuple[Floats, Floats]]:
    """(imbalance, ms) of each step, of both."""
    found = [(np.zeros(steps), np.zeros(steps)) for _ in pair]
    for vec in pair:
        vec.reset(seed=seed)
    for step in range(steps):
        for vec, (uneven, taken) in zip(pair, found, strict=True):
            actions = vec.suggest_actions()
            began = time.perf_counter()
            vec.step(actions)
            taken[step] = 1e3 * (time.perf_counter() - began)
            uneven[step] = vec.simulation.zone_loads().imbalance()[0]
    return found


def _row(name: str, vec: CavVectorEnv, uneven: list[float], taken: list[float]) -> RecutRow:
    recuts = vec.simulation.recuts
    return RecutRow(
        name,
        tuple(uneven),
        tuple(taken),
        len(recuts),
        sum(recut.moved for recut in recuts),
        statistics.median(recut.ms for recut in recuts) if recuts else None,
    )
