"""The interface of a car-following model: six functions, which each model's file defines.

A leader or a line imposes a *constraint* on a driver; of several constraints the largest is
binding. Constraints are comparable only for one driver. The meaning of the number depends on the
model: for IDM the interaction that reduces the free acceleration (m/s²), for Krauss's model the
negated safe speed (m/s), for `acceleration_models` the negated acceleration (m/s²).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

LINE_MARGIN_M = 1.0  # distance between a line and the front of a driver that stops there


class FollowingFunctions(NamedTuple):
    """The compiled functions of a model; the functions of `following` document the arguments."""

    no_constraint: Callable[[np.void], float]
    behind: Callable[[np.void, float, float, float, float], float]
    before_line: Callable[[np.void, float, float, float], float]
    wish: Callable[[np.void, float, float, float], float]
    speed_behind: Callable[[np.void, float, float, float], float]
    response: Callable[[np.void, float, float, float, float, float], float]


class CarFollowingModel(NamedTuple):
    """A car-following model of the package."""

    name: str  # SUMO's name of the model, used in `traffic.model` and `carFollowModel`
    code: int  # MODEL_*
    functions: FollowingFunctions
    as_sumo: bool = False  # VTYPE["as_sumo"] of the types with this model
    uses_sigma: bool = False  # whether the model uses the imperfection that demand files set
