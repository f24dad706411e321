"""Car following for all models: each function calls the same function of the vehicle's model.

`MODELS` lists the models of the package; `car_following_model` describes what a model defines.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeAlias

import numpy as np

from cavmarl.core.compiled import inlined_function, kernel
from cavmarl.driving.kernels.models.acc import ACC
from cavmarl.driving.kernels.models.idm import IDM
from cavmarl.driving.kernels.models.krauss import KRAUSS
from cavmarl.driving.kernels.models.registered_models import REGISTERED

# A driver's VTYPE["model"] is compared with the codes in this order, so frequent models come first.
MODELS = (KRAUSS, IDM, ACC)

# A function of a model; all arguments after the VTYPE row are in one tuple.
_Dispatcher: TypeAlias = Callable[[np.void, tuple[float, ...]], float]


def _by_model(name: str) -> _Dispatcher:
    """Return a function that calls the function `name` of the model in a VTYPE row."""
    function: Callable[..., float] = getattr(REGISTERED, name)

    @inlined_function
    def registered(kind: np.void, numbers: tuple[float, ...]) -> float:
        return function(kind, *numbers)

    dispatcher: _Dispatcher = registered
    for model in reversed(MODELS):
        dispatcher = _branch(model.code, getattr(model.functions, name), dispatcher)
    return dispatcher


def _branch(code: int, function: Callable[..., float], otherwise: _Dispatcher) -> _Dispatcher:
    """Return a function that calls `function` if the model has this code, else `otherwise`."""

    @inlined_function
    def branch(kind: np.void, numbers: tuple[float, ...]) -> float:
        if kind["model"] == code:
            return function(kind, *numbers)
        return otherwise(kind, numbers)

    return branch


_no_constraint = _by_model("no_constraint")
_behind = _by_model("behind")
_before_line = _by_model("before_line")
_wish = _by_model("wish")
_speed_behind = _by_model("speed_behind")
_response = _by_model("response")


@kernel
def no_constraint(kind: np.void) -> float:
    """Return the constraint on a free road."""
    return _no_constraint(kind, ())


@kernel
def behind(
    kind: np.void,  # VTYPE of the driver
    speed: float,  # speed of the driver, m/s
    gap: float,  # between the bumpers, m
    front_speed: float,  # speed of the leader, m/s
    front_decel: float,  # the leader's comfortable deceleration, m/s², positive
) -> float:
    """Return the constraint that a leader imposes."""
    return _behind(kind, (speed, gap, front_speed, front_decel))


@kernel
def before_line(kind: np.void, speed: float, gap: float, dt: float) -> float:
    """Return the constraint of a line that is `gap` m ahead of the front."""
    return _before_line(kind, (speed, gap, dt))


@kernel
def wish(kind: np.void, speed: float, allowed: float, constraint: float) -> float:
    """Return the desired acceleration of a driver in m/s²; lane changes are based on it."""
    return _wish(kind, (speed, allowed, constraint))


@kernel
def accel_behind(
    kind: np.void, speed: float, allowed: float, gap: float, front_speed: float, front_decel: float
) -> float:
    """Return `wish` behind one leader."""
    return wish(kind, speed, allowed, behind(kind, speed, gap, front_speed, front_decel))


@kernel
def speed_behind(kind: np.void, gap: float, front_speed: float, front_decel: float) -> float:
    """Return the speed in m/s at which a driver wants a gap of exactly `gap` m to its leader."""
    return _speed_behind(kind, (gap, front_speed, front_decel))


@kernel
def response(
    kind: np.void,  # VTYPE of the driver
    speed: float,  # m/s
    allowed: float,  # the speed allowed by speed limits and by the vehicle, m/s
    constraint: float,  # the binding constraint
    share: float,  # a random number in [0, 1), for models with imperfect driving
    dt: float,  # length of the tick, s
) -> float:
    """Return the acceleration in m/s² of the coming tick."""
    return _response(kind, (speed, allowed, constraint, share, dt))
