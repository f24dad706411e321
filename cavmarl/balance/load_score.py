"""`LoadScore`: ranks workers by load, and excludes overloaded workers.

    LoadScore_i = 0.6 CPU_i + 0.2 RAM_i + 0.2 GPU_i       eq. (1)
    worker*     = arg min LoadScore_i over admissible workers eq. (2)

after "Distributed CARLA architecture for multi-agent CAV simulation: design and preliminary
multi-GPU evaluation", section 3.5. A worker that uses a resource above its threshold (CPU 0.85,
RAM 0.90, GPU 0.95) is excluded before scoring, so that free resources cannot hide a critical one.
All utilisations are shares from 0 to 1.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

from cavmarl.core.errors import ConfigError, NoAdmissibleWorkerError

RESOURCES = ("cpu", "ram", "gpu")
WEIGHTS = (0.6, 0.2, 0.2)  # empirical weights of the paper: the processor carries most of the load
THRESHOLDS = (0.85, 0.90, 0.95)
UNAVAILABLE = "unavailable"
SUM_ERROR = 1e-9  # tolerance for the sum of decimal weights

Outcome = Literal[
    "lowest score",
    "preferred",
    "preferred excluded",
    "preferred unavailable",
    "preferred above margin",
]


def _check_share(name: str, value: float) -> None:
    if not 0.0 <= value <= 1.0:  # NaN also fails this check
        cure = f"; if this is a percentage, use {value / 100.0:g}" if 1.0 < value <= 100.0 else ""
        raise ConfigError(f"{name} = {value}: must be a share from 0 to 1{cure}")


@dataclass(frozen=True)
class Utilisation:
    """The used share of each resource.

    Raises:
        ConfigError: a value is outside [0, 1].
    """

    cpu: float  # share of the processors
    ram: float  # share of the memory
    gpu: float = 0.0  # share of the GPU; 0 without a GPU

    def __post_init__(self) -> None:
        for name in RESOURCES:
            _check_share(f"utilisation {name}", getattr(self, name))


@dataclass(frozen=True)
class LoadRule:
    """The rule that scores and excludes workers."""

    # weights of CPU, RAM and GPU in the score; they add up to 1
    weights: tuple[float, float, float] = WEIGHTS
    # a worker that uses more than a threshold is excluded; equality is allowed
    thresholds: tuple[float, float, float] = THRESHOLDS
    # maximum excess of a preferred worker's score over the lowest score
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
                f"thresholds {self.thresholds}: a worker without free resources is admissible; "
                "lower a threshold that has a weight"
            )
        if not (math.isfinite(self.margin) and self.margin >= 0.0):
            raise ConfigError(f"margin = {self.margin}: must be a number of at least 0")


def load_score(use: Utilisation, weights: tuple[float, float, float] = WEIGHTS) -> float:
    """Return eq. (1), from 0 (all resources are free) to 1 (all are used)."""
    pairs = zip(weights, (use.cpu, use.ram, use.gpu), strict=True)
    return math.fsum(weight * share for weight, share in pairs)


DEFAULT_RULE = LoadRule()


@dataclass(frozen=True)
class Candidate:
    """A worker that could be chosen."""

    worker: int
    use: Utilisation  # used shares of its resources
    # number of its shards; on equal scores, the worker with fewer shards is chosen
    hosted: int = 0
    available: bool = True  # whether the worker answers and its data are recent


class Rejection(NamedTuple):
    """The reason why a worker is excluded."""

    worker: int
    resource: str  # `cpu`, `ram`, `gpu` or `unavailable`
    value: float | None  # the used share; None: the worker is not available
    threshold: float | None  # the threshold that is exceeded; None: the worker is not available

    def __str__(self) -> str:
        if self.value is None:
            return f"worker {self.worker} is {self.resource}"
        return f"worker {self.worker}: {self.resource} {self.value!r} > {self.threshold!r}"


@dataclass(frozen=True)
class Selection:
    """The worker chosen by `select`, and the reason."""

    worker: int
    preferred: int | None  # the requested worker, if any
    outcome: Outcome  # the reason for the choice
    scores: tuple[tuple[int, float], ...]  # (worker, LoadScore) of admissible workers, by worker
    # reasons for excluded workers, by worker; one for each resource above its threshold
    rejections: tuple[Rejection, ...]

    @property
    def redirected(self) -> bool:
        """Whether another worker was requested."""
        return self.preferred not in (None, self.worker)


def find_rejections(
    candidates: Iterable[Candidate], rule: LoadRule = DEFAULT_RULE
) -> tuple[Rejection, ...]:
    """Return the reasons why workers are excluded; a value at its threshold is allowed."""
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
    """Return the workers without a rejection, by worker."""
    numbers = [candidate.worker for candidate in candidates]
    if len(set(numbers)) != len(numbers):
        raise ConfigError(f"workers {sorted(numbers)}: each must be named once")
    out = {rejection.worker for rejection in rejections}
    left = [candidate for candidate in candidates if candidate.worker not in out]
    if not left:
        reasons = "; ".join(map(str, rejections)) or "there are no workers"
        raise NoAdmissibleWorkerError(
            f"no admissible worker: {reasons}. Wait until they are less busy, add workers, or "
            "raise the thresholds",
            tuple(rejections),
        )
    return tuple(sorted(left, key=lambda one: one.worker))


def select(
    candidates: Sequence[Candidate],  # all workers
    # weights, thresholds, and the margin of a preferred worker
    rule: LoadRule = DEFAULT_RULE,
    preferred: int | None = None,  # worker that is chosen if admissible and within the margin
) -> Selection:
    """Return the admissible worker with the lowest score, or the preferred one if it is close.

    On equal scores, the worker that hosts fewer shards is chosen, then the worker with the lower
    number. The order of `candidates` has no effect.

    Raises:
        NoAdmissibleWorkerError: all workers are excluded; the error contains all reasons.
    """
    known = {candidate.worker for candidate in candidates}
    if preferred is not None and preferred not in known:
        raise ConfigError(f"preferred worker {preferred}: must be one of {sorted(known)}")
    rejections = find_rejections(candidates, rule)
    left = admissible(candidates, rejections)
    scores = {candidate.worker: load_score(candidate.use, rule.weights) for candidate in left}
    best = min(left, key=lambda one: (scores[one.worker], one.hosted, one.worker)).worker
    outcome = _outcome_of(preferred, best, scores, rejections, rule)
    chosen = preferred if outcome == "preferred" and preferred is not None else best
    return Selection(chosen, preferred, outcome, tuple(scores.items()), rejections)


def _outcome_of(
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
