"""The car-following models by name: of the package, of SUMO, and registered from outside.

A model of the package is a code, a branch in `driving/kernels/models/following.py` and a line in
`MODELS`; with a line in `AS_SUMO` of `vehicle_types`, its drivers also look ahead and yield as
SUMO's do.
"""

from __future__ import annotations

from collections.abc import Callable

from cavmarl.core.compiled import IS_PLAIN
from cavmarl.core.errors import ConfigError, require
from cavmarl.core.extensions import REGISTERED_MODELS
from cavmarl.core.records.codes import MODEL_ACC, MODEL_IDM, MODEL_KRAUSS
from cavmarl.driving.kernels.models.registered_models import (
    FIRST_REGISTERED,
    MAX_REGISTERED,
    put_model,
)

# Code by name, the name being that of SUMO's carFollowModel.
MODELS = {"IDM": MODEL_IDM, "Krauss": MODEL_KRAUSS, "ACC": MODEL_ACC}

# SUMO's other models by the one of ours whose equations are nearest.
NEAREST_MODEL = {
    "KraussOrig1": "Krauss",
    "KraussPS": "Krauss",
    "KraussX": "Krauss",
    "SmartSK": "Krauss",
    "Daniel1": "Krauss",
    "PWagner2009": "Krauss",
    "BKerner": "Krauss",
    "Wiedemann": "Krauss",
    "W99": "Krauss",
    "Rail": "Krauss",
    "IDMM": "IDM",
    "EIDM": "IDM",
    "CACC": "IDM",
    "CC": "IDM",
}


def model_names() -> tuple[str, ...]:
    """The models that drive as they are named, in `traffic.model` and in `carFollowModel`."""
    return (*MODELS, *REGISTERED_MODELS.names)


def model_code(name: str, key: str = "traffic.model") -> int:
    if name in MODELS:
        return MODELS[name]
    if name in REGISTERED_MODELS:
        return REGISTERED_MODELS[name]
    known = ", ".join(model_names())
    raise ConfigError(
        f"{key} = {name!r}: no such driver model; there are {known}, or register one with "
        "cavmarl.register_driver_model"
    )


def register_driver_model(name: str, model: Callable[..., float]) -> None:
    """Add a car-following model, which `traffic.model` and a type's `carFollowModel` can name.

    It is asked once for the free road (with an infinite gap and the leader as fast as is allowed)
    and once for each leader; the least answer counts, from minus the type's emergencyDecel to its
    accel. Before stop lines drivers brake as in Krauss's model.

    Args:
        name: of the model; none of cavmarl's or SUMO's.
        model: (speed, allowed, gap, front_speed, min_gap, tau, accel, decel) → acceleration, all
            floats in SI units, gap between bumpers, decel positive. Numba compiles it, so it takes
            numbers, `math` and other compiled functions.

    Raises:
        ConfigError: the name is taken, there are too many, or Numba cannot compile it.
        MissingExtraError: Numba is not installed.
    """
    if not IS_PLAIN:
        require("numba", "compile")
    code = REGISTERED_MODELS[name] if name in REGISTERED_MODELS else None
    if code is None:
        code = FIRST_REGISTERED + len(REGISTERED_MODELS.names)
    if code >= FIRST_REGISTERED + MAX_REGISTERED:
        raise ConfigError(f"driver model '{name}': there are {MAX_REGISTERED} already")
    REGISTERED_MODELS.add(name, code, model, (*MODELS, *NEAREST_MODEL))
    try:
        put_model(code, model)
    except Exception as error:
        REGISTERED_MODELS.remove(name)
        raise ConfigError(f"driver model '{name}': Numba cannot compile it: {error}") from error
