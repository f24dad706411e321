"""The form of a trained driver: the keys of `env.yaml` for its observations and actions.

A driver's `config.json` contains its form. Reading it needs neither the weights nor torch.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from copy import deepcopy
from dataclasses import dataclass
from operator import attrgetter
from pathlib import Path
from typing import Any

from cavmarl.config.action import ActionConfig
from cavmarl.config.driver_names import drivers_in, find_driver, name_of_driver
from cavmarl.config.env import EnvConfig
from cavmarl.config.registry import agent_entries
from cavmarl.config.sensors import SensorsConfig
from cavmarl.core.errors import ConfigError, PolicyError

WEIGHTS_FILE = "model.safetensors"
CONFIG_FILE = "config.json"
# Keys of `action` that define the meaning of the actions, by kind.
SCALES = {
    "continuous": ("acceleration_mps2", "steering_rad"),
    "discrete": ("target_speeds_mps",),
    "grid": ("acceleration_mps2", "steering_rad", "grid_throttle", "grid_steering"),
}
_ABSENT = object()

Form = dict[str, Any]
"""Values of keys of `sensors` and `action`, by dotted key, usable as overrides."""


@dataclass(frozen=True)
class _FormFile:
    """The two parts of `config.json` that contain the form."""

    sensors: SensorsConfig
    action: ActionConfig


def form_of(sensors: SensorsConfig, action: ActionConfig) -> Form:
    """Return all keys that define the meaning of observations and actions, with their values.

    The keys of a sensor that is off have their defaults, so that forms are equal whenever
    observations and actions are.
    """
    from cavmarl.config.io import dotted_keys  # pydantic is slow to import

    names = ("kind", *SCALES[action.kind])
    actions = {f"action.{name}": getattr(action, name) for name in names}
    plain = sensors.plain()
    values = {f"sensors.{key}": attrgetter(key)(plain) for key in dotted_keys(SensorsConfig)}
    return actions | values


def read_form(folder: Path) -> Form:
    """Read the form of a trained driver from its folder.

    Raises:
        PolicyError: a file of the driver is missing, or `config.json` is invalid.
    """
    from cavmarl.config.io import validate

    for name in (WEIGHTS_FILE, CONFIG_FILE):
        if not (folder / name).is_file():
            raise PolicyError(f"no {name} in {folder}: is this the folder of a trained driver?")
    path = folder / CONFIG_FILE
    try:
        raw: Any = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:  # json raises RecursionError, too
        reason = error.strerror if isinstance(error, OSError) else None
        raise PolicyError(f"{path}: cannot be read ({reason or error})") from error
    if isinstance(raw, Mapping):
        raw = {name: raw[name] for name in ("sensors", "action") if name in raw}
    try:
        found = validate(_FormFile, raw, str(path))
    except ConfigError as error:
        raise PolicyError(str(error)) from error
    return form_of(found.sensors, found.action)


def forms_in(policies: Iterable[str | Path]) -> dict[str, Form]:
    """Return the form of each trained driver in `policies`, by name; files have no form.

    Raises:
        PolicyError: there is no driver of that name, or its `config.json` is invalid.
    """
    paths = [find_driver(one) for policy in policies for one in drivers_in(policy)]
    return {name_of_driver(path): read_form(path) for path in paths if path.is_dir()}


def common_form(forms: Mapping[str, Form]) -> Form:
    """Return the form that all these drivers share.

    Raises:
        PolicyError: two of the drivers have different forms; the message lists keys and values.
    """
    (first, form), *others = forms.items()
    lines = [
        f"{key} is {form.get(key)} for {first}, {other.get(key)} for {name}"
        for name, other in others
        for key in {**form, **other}
        if form.get(key) != other.get(key)
    ]
    if lines:
        raise PolicyError(
            f"The drivers {', '.join(forms)} need different sensors or actions: "
            f"{'; '.join(lines)}. All drivers of a run must have the same sensors and actions. Run "
            "each of these drivers in a separate run"
        )
    return form


def form_of_driver(policy: str | Path) -> Form:
    """Return the form of a trained driver, as overrides that make any environment fit the driver.

    Args:
        policy: see `load_policy`.

    Raises:
        PolicyError: there is no driver of that name, none of them is trained, or two of them have
            different forms.
    """
    forms = forms_in([policy])
    if not forms:
        trained = ", ".join(name for name, path in agent_entries().items() if path.is_dir())
        raise PolicyError(
            f"The driver '{policy}' is a script or a model file. Only the folder of a trained "
            "driver states sensors that an environment can copy. Name a trained "
            f"driver ({trained}), or leave sensors_of (--sensors-of) out"
        )
    return common_form(forms)


def with_sensors_of(
    overrides: Mapping[str, Any] | None, driver: str | Path | None
) -> Mapping[str, Any] | None:
    """Return the overrides with the form of a trained driver; without a driver, unchanged.

    Raises:
        ConfigError: an override sets a key of the form to another value.
        PolicyError: see `form_of_driver`.
    """
    if driver is None:
        return overrides
    return with_form(overrides, form_of_driver(driver), str(driver))


def with_form(overrides: Mapping[str, Any] | None, form: Form, driver: str) -> dict[str, Any]:
    """Return the overrides with the keys of a form.

    Raises:
        ConfigError: an override sets a key of the form to another value.
    """
    if not isinstance(overrides, Mapping | None):
        raise ConfigError(f"overrides = {overrides!r}: must map dotted keys to values")
    given = deepcopy(dict(overrides or {}))
    lines = [
        f"{key} is {value!r} in the overrides, {needed!r} for {driver}"
        for key, needed in form.items()
        for value in _values_at(given, key)
        if value is not _ABSENT and _plain(value) != _plain(needed)
    ]
    if lines:
        raise ConfigError(
            f"The overrides and the sensors of {driver} contradict each other: {'; '.join(lines)}. "
            "Leave out the overrides of these keys (overrides, --set, --sensors-of), or name "
            "another driver"
        )
    return given | form


def differing_keys(form: Form, config: EnvConfig) -> dict[str, tuple[Any, Any]]:
    """Return the keys with different values: (value in the form, value in the environment)."""
    here = form_of(config.sensors, config.action)
    pairs = {
        key: (needed, here[key] if key in here else attrgetter(key)(config))
        for key, needed in form.items()
    }
    return {key: (needed, here) for key, (needed, here) in pairs.items() if needed != here}


def _values_at(overrides: Mapping[str, Any], key: str) -> Iterable[Any]:
    """Yield each value that overrides set at a key, in a section around it, or at a part of it."""
    for name, value in overrides.items():
        if not isinstance(name, str):
            continue  # `load_config` raises an error for it
        if key == name:
            yield value
        elif key.startswith(f"{name}."):
            for part in key.removeprefix(f"{name}.").split("."):
                value = value.get(part, _ABSENT) if isinstance(value, Mapping) else _ABSENT
            yield value
        elif name.startswith(f"{key}."):
            yield {name.removeprefix(f"{key}."): value}


def _plain(value: Any) -> Any:
    """Return the value in its JSON form, in which lists and tuples are equal."""
    return json.loads(json.dumps(value, default=str))
