"""LoadScore: ranks workers by load, and excludes overloaded ones.

    LoadScore_i = 0.6 CPU_i + 0.2 RAM_i + 0.2 GPU_i       eq. (1)
    worker*     = arg min LoadScore_i over the admissible   eq. (2)

after "Distributed CARLA architecture for multi-agent CAV simulation: design and preliminary
multi-GPU evaluation", section 3.5. A worker that uses one resource above its threshold (CPU 0.85,
RAM 0.90, GPU 0.95) is excluded before scoring, so that free resources cannot
hide a critical one. All utilisations are shares from 0 to 1.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

from cavmarl.core.errors import ConfigError, NoAdmissibleWorkerError

RESOURCES = ("cpu", "ram", "gpu")
WEIGHTS = (0.6, 0.2, 0.2)  # empirical in the paper; the processor carries nearly everything
THRESHOLDS = (0.85, 0.90, 0.95)
UNAVAILABLE = "unavailable"
SUM_ERROR = 1e-9  # of weights that are decimal fractions

Outcome = Literal[
    "lowest score",
    "preferred",
    "preferred excluded",
    "preferred unavailable",
    "preferred above margin",
]


def _check_share(name: str, value: float) -> None:
    if not 0.0 <= value <= 1.0:  # NaN is not, either
        cure = f"; percent? use {value / 100.0:g}" if 1.0 < value <= 100.0 else ""
        raise ConfigError(f"{name} = {value}: must be a share from 0 to 1{cure}")


@dataclass(frozen=True)
class Utilisation:
    """How much of each resource is in use, as shares of it.

    Raises:
        ConfigError: a value outside of [0, 1], or none.
    """

    cpu: float  # of the processors
    ram: float  # of the memory
    gpu: float = 0.0  # of the GPU; 0 where there is none

    def __post_init__(self) -> None:
        for name in RESOURCES:
            _check_share(f"utilisation {name}", getattr(self, name))


@dataclass(frozen=True)
class LoadRule:
    """How workers are scored and which ones are excluded."""

    # of CPU, RAM and GPU in the score; they add up to 1
    weights: tuple[float, float, float] = WEIGHTS
    # a worker that uses more is excluded; one that uses as much is not
    thresholds: tuple[float, float, float] = THRESHOLDS
    # a preferred worker is kept while its score is at most this above the best one
    margin: float = 0.05

    def __post_init__(self) -> None:
        for name, weight in zip(RESOURCES, self.weights, strict=True):
            if not (math.isfinite(weight) and weight >= 0.0):
                raise ConfigError(f"weight {name} = {weight}: must be a number from 0 to 1")
        total = math.fsum(self.weights)
        if abs(total - 1.0) > SUM_ERROR:
            raise ConfigError(f"weights {self.weights} sum to {total:g}: they must sum to 1")
        for name, threshold in zip(RESOURCES, self.thresholds, strict=True):
            _check_share(f"threshold {name}", threshold)
        if load_score(Utilisation(*self.thresholds), self.weights) >= 1.0:
            raise ConfigError(
                f"thresholds {self.thresholds}: a worker may be used up and still be admissible; "
                "lower one that has a weight"
            )
        if not (math.isfinite(self.margin) and self.margin >= 0.0):
            raise ConfigError(f"margin = {self.margin}: must be a number from 0 up")


def load_score(use: Utilisation, weights: tuple[float, float, float] = WEIGHTS) -> float:
    """Eq. (1): from 0, where all is free, to 1, where all is used."""
    pairs = zip(weights, (use.cpu, use.ram, use.gpu), strict=True)
    return math.fsum(weight * share for weight, share in pairs)


DEFAULT_RULE = LoadRule()


@dataclass(frozen=True)
class Candidate:
    """A worker that could be chosen."""

    worker: int
    use: Utilisation  # what is used of its resources
    # how many shards it has; of two with the same score the one with fewer is chosen
    hosted: int = 0
    available: bool = True  # whether it answers, and what is known of it is recent


class Rejection(NamedTuple):
    """Why a worker is not asked."""

    worker: int
    resource: str  # `cpu`, `ram`, `gpu` or `unavailable`
    value: float | None  # the share in use; None: it is not available
    threshold: float | None  # what the value is above; None: it is not available

    def __str__(self) -> str:
        if self.value is None:
            return f"worker {self.worker} is {self.resource}"
        return f"worker {self.worker}: {self.resource} {self.value!r} > {self.threshold!r}"


@dataclass(frozen=True)
class Selection:
    """The worker that `select` chose and why."""

    worker: int
    preferred: int | None  # the one asked for, if any
    outcome: Outcome  # why it is this one
    scores: tuple[tuple[int, float], ...]  # (worker, LoadScore) of all admissible ones, by worker
    # of the others, by worker; one for each resource that is too busy
    rejections: tuple[Rejection, ...]

    @property
    def redirected(self) -> bool:
        """Whether another one was asked for."""
        return self.preferred not in (None, self.worker)


def find_rejections(
    candidates: Iterable[Candidate], rule: LoadRule = DEFAULT_RULE
) -> tuple[Rejection, ...]:
    """Why which workers are excluded, by worker; a value at its threshold is no reason."""
    found: list[Rejection] = []
    for candidate in sorted(candidates, key=lambda one: one.worker):
        if not candidate.available:
            found.append(Rejection(candidate.worker, UNAVAILABLE, None, None))
            continue
        for resource, threshold in zip(RESOURCES, rule.thresholds, strict=True):
            value = getattr(candidate.use, resource)
            if value > threshold:
                found.append(Rejection(candidate.worker, resource, value, threshold))
    return tuple(found)


def admissible(
    candidates: Sequence[Candidate], rejections: Sequence[Rejection]
) -> tuple[Candidate, ...]:
    """Those without a reason against them, by worker."""
    numbers = [candidate.worker for candidate in candidates]
    if len(set(numbers)) != len(numbers):
        raise ConfigError(f"workers {sorted(numbers)}: one of them is named twice")
    out = {rejection.worker for rejection in rejections}
    left = [candidate for candidate in candidates if candidate.worker not in out]
    if not left:
        said = "; ".join(map(str, rejections)) or "there are no workers"
        raise NoAdmissibleWorkerError(
            f"no admissible worker: {said}. Wait until they are less busy, add workers, or raise "
            "the thresholds",
            tuple(rejections),
        )
    return tuple(sorted(left, key=lambda one: one.worker))


def select(
    candidates: Sequence[Candidate],  # all workers
    # weights, thresholds, and how much worse a preferred worker may be
    rule: LoadRule = DEFAULT_RULE,
    preferred: int | None = None,  # a worker kept while it is admissible and within the margin
) -> Selection:
    """The admissible worker of the lowest score, or the preferred one if it is about as good.

    Of equal scores the one that hosts fewer shards wins, then the lower number: the order of
    `candidates` never counts.

    Raises:
        NoAdmissibleWorkerError: all are excluded; the error holds every reason.
    """
    known = {candidate.worker for candidate in candidates}
    if preferred is not None and preferred not in known:
        raise ConfigError(f"preferred worker {preferred}: there are {sorted(known)}")
    rejections = find_rejections(candidates, rule)
    left = admissible(candidates, rejections)
    scores = {candidate.worker: load_score(candidate.use, rule.weights) for candidate in left}
    best = min(left, key=lambda one: (scores[one.worker], one.hosted, one.worker)).worker
    outcome = _judge(preferred, best, scores, rejections, rule)
    chosen = preferred if outcome == "preferred" and preferred is not None else best
    return Selection(chosen, preferred, outcome, tuple(scores.items()), rejections)


def _judge(
    preferred: int | None,
    best: int,
    scores: dict[int, float],
    rejections: Sequence[Rejection],
    rule: LoadRule,
) -> Outcome:
    if preferred is None:
        return "lowest score"
    if preferred in scores:
        near = scores[preferred] <= scores[best] + rule.margin
        return "preferred" if near else "preferred above margin"
    gone = Rejection(preferred, UNAVAILABLE, None, None) in rejections
    return "preferred unavailable" if gone else "preferred excluded"
