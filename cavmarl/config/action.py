"""`ActionConfig`: the actions of an agent."""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise, product
from typing import Annotated, Literal

from cavmarl.config.checks import Section, Within
from cavmarl.core.records.codes import ACTION_IDLE, ACTION_SLOWER

MAX_GRID = 1024  # choices


@dataclass(frozen=True)
class ActionConfig(Section, key="action"):
    """The actions of an agent.

    Attributes:
        kind: `continuous`: (throttle, steering) in [-1, 1]; `discrete`: highway-env's five
            meta-actions LANE_LEFT, IDLE, LANE_RIGHT, FASTER, SLOWER; `grid`: an index into all
            pairs of `grid_throttle` and `grid_steering`.
        acceleration_mps2: acceleration at throttle ±1.
        steering_rad: steering angle of the front wheels at steering ±1, left positive.
        target_speeds_mps: `discrete`: the speeds that FASTER and SLOWER step through.
        grid_throttle: `grid`: increasing throttles in [-1, 1], including 0.
        grid_steering: `grid`: increasing steerings in [-1, 1], including 0. With n steerings,
            choice k is throttle k // n and steering k % n.
        out_of_range: continuous values beyond ±1: `error`, or `clip` (`traffic_stats` counts them).
        missing_action: live agents without an action: `error`, or `hold` the last one (counted).
        late_actions: if an agent that has left gets an action: `error`, or `ignore` (counted).
    """

    kind: Literal["continuous", "discrete", "grid"] = "continuous"
    acceleration_mps2: Annotated[float, Within(0.1, 20.0)] = 5.0
    steering_rad: Annotated[float, Within(0.01, 1.2)] = 0.7853981633974483
    target_speeds_mps: tuple[float, ...] = (0.0, 3.0, 6.0, 9.0, 12.0, 15.0, 20.0, 25.0, 30.0)
    grid_throttle: tuple[float, ...] = (-1.0, -0.4, 0.0, 0.2, 0.5)
    grid_steering: tuple[float, ...] = (-1.0, -0.3, -0.06, 0.0, 0.06, 0.3, 1.0)
    out_of_range: Literal["error", "clip"] = "error"
    missing_action: Literal["error", "hold"] = "error"
    late_actions: Literal["error", "ignore"] = "error"

    def __post_init__(self) -> None:
        super().__post_init__()
        speeds = self.target_speeds_mps
        self.need(
            "target_speeds_mps",
            len(speeds) >= 2 and _rises(speeds, 0.0, 60.0),
            "must be at least two increasing speeds from 0 to 60",
        )
        for key in ("grid_throttle", "grid_steering"):
            shares = getattr(self, key)
            self.need(
                key,
                _rises(shares, -1.0, 1.0) and 0.0 in shares,
                "must be increasing numbers from -1 to 1, including 0",
            )
        size = len(self.grid_throttle) * len(self.grid_steering)
        self.need(
            "grid_steering", size <= MAX_GRID, f"makes {size} pairs; the maximum is {MAX_GRID}"
        )

    @property
    def choices(self) -> int:
        """Number of actions to choose from; 0: actions are continuous."""
        if self.kind == "grid":
            return len(self.grid_throttle) * len(self.grid_steering)
        return ACTION_SLOWER + 1 if self.kind == "discrete" else 0

    @property
    def idle_choice(self) -> int:
        """The action that changes nothing."""
        if self.kind != "grid":
            return ACTION_IDLE
        steering = self.grid_steering
        return self.grid_throttle.index(0.0) * len(steering) + steering.index(0.0)

    @property
    def pairs(self) -> list[tuple[float, float]]:
        """The pair (throttle, steering) in [-1, 1] of each choice of a grid."""
        return list(product(self.grid_throttle, self.grid_steering))


def _rises(values: tuple[float, ...], low: float, high: float) -> bool:
    """Return whether `values` is not empty, within the bounds and strictly increasing."""
    return (
        bool(values)
        and all(math.isfinite(v) and low <= v <= high for v in values)
        and all(a < b for a, b in pairwise(values))
    )
