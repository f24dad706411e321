"""Names of car-following models: models of the package, of SUMO, and registered models."""

from __future__ import annotations

from collections.abc import Callable

from cavmarl.core.compiled import IS_PLAIN
from cavmarl.core.errors import ConfigError, require
from cavmarl.core.extensions import HOW, REGISTERED_MODELS
from cavmarl.driving.kernels.models.following import MODELS
from cavmarl.driving.kernels.models.registered_models import (
    FIRST_REGISTERED,
    MAX_REGISTERED,
    put_model,
)

_BY_CASE = {model.name.casefold(): model.code for model in MODELS}
_CODES = {model.name: model.code for model in MODELS}

# For SUMO's other models, the model of the package whose equations are most similar.
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
    """Return the model names that `traffic.model` and `carFollowModel` accept."""
    return (*_CODES, *REGISTERED_MODELS.names)


def has_model(name: str) -> bool:
    """Return whether `model_names` contains a name."""
    return name in _CODES or name in REGISTERED_MODELS


def model_code(name: str, key: str = "traffic.model") -> int:
    """Return the MODEL_* code of a name; for models of the package, case does not matter.

    Raises:
        ConfigError: there is no such model; the message names `key` as the place.
    """
    if name in _CODES:
        return _CODES[name]
    if name in REGISTERED_MODELS:
        return REGISTERED_MODELS[name]
    if name.casefold() in _BY_CASE:
        return _BY_CASE[name.casefold()]
    known = ", ".join(model_names())
    raise ConfigError(
        f"{key} = {name!r} is not a driver model; use one of {known}, or 'zoo:' and the name of "
        "a trained driver. If a module registers the model with cavmarl.register_driver_model, "
        f"{HOW}"
    )


def register_driver_model(name: str, model: Callable[..., float]) -> None:
    """Add a car-following model, which `traffic.model` and a type's `carFollowModel` can name.

    In each tick the model is called once for the free road (with an infinite gap and a leader at
    the allowed speed) and once for each leader. The lowest acceleration is applied, limited to the
    range from minus the type's emergencyDecel to its accel. Before stop lines, drivers brake as in
    Krauss's model.

    Args:
        name: the name of the model; names of cavmarl's and SUMO's models are not allowed.
        model: a function (speed, allowed, gap, front_speed, min_gap, tau, accel, decel) →
            acceleration. All values are floats in SI units, the gap is between bumpers, decel is
            positive. Numba compiles the function, so it can use numbers, `math` and other compiled
            functions.

    Raises:
        ConfigError: the name is taken, too many models are registered, or Numba cannot compile the
            model.
        MissingExtraError: Numba is not installed.
    """
    if not IS_PLAIN:
        require("numba", "compile")
    is_new = name not in REGISTERED_MODELS
    code = FIRST_REGISTERED + len(REGISTERED_MODELS) if is_new else REGISTERED_MODELS[name]
    if code >= FIRST_REGISTERED + MAX_REGISTERED:
        raise ConfigError(
            f"driver model '{name}': {MAX_REGISTERED} models are registered, which is the maximum; "
            "register fewer models"
        )
    REGISTERED_MODELS.add(name, code, model, (*_CODES, *NEAREST_MODEL))
    try:
        put_model(code, model)
    except Exception as error:
        REGISTERED_MODELS.remove(name)
        raise ConfigError(f"driver model '{name}': Numba cannot compile it: {error}") from error
