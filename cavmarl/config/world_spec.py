"""`WorldSpec`: the arguments that select a world, in one object."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, TypedDict, Unpack

from cavmarl.config.driver_form import (
    common_form,
    differing_keys,
    forms_in,
    with_form,
    with_sensors_of,
)
from cavmarl.config.registry import load_config, load_plugins_of
from cavmarl.core.seeds import check_seed


class WorldKeys(TypedDict, total=False):
    """Keyword arguments that select a world: the fields of `WorldSpec`, and `sensors_of`."""

    agents: int | None
    background: int | None
    max_cycles: int | None
    seed: int
    overrides: Mapping[str, Any] | None
    sensors_of: str | Path | None  # a trained driver; its sensors and actions become overrides


@dataclass(frozen=True, kw_only=True)
class WorldSpec:
    """The world to make: `make_vec(spec.env, **spec.keywords)` makes copies of it."""

    env: str  # name, folder or map file of an environment
    agents: int | None = None  # sets population.agents
    background: int | None = None  # sets population.background
    max_cycles: int | None = None  # sets horizon_s, in steps
    seed: int = 0  # seed of all random numbers
    overrides: Mapping[str, Any] = field(default_factory=dict)  # values of any other keys

    def __post_init__(self) -> None:
        object.__setattr__(self, "seed", check_seed(self.seed))

    @classmethod
    def of(cls, env: str | Path | WorldSpec, **keys: Unpack[WorldKeys]) -> WorldSpec:
        """Return the spec for a function's arguments: a spec, or an environment and keywords.

        Raises:
            ConfigError, PolicyError: `sensors_of` contradicts the overrides, or is not a trained
                driver.
        """
        if isinstance(env, WorldSpec):
            return env
        driver = keys.pop("sensors_of", None)
        if driver is not None:
            load_plugins_of(env, keys.get("overrides"))  # the driver may use sensors of the plugins
        overrides = with_sensors_of(keys.get("overrides"), driver)
        given: dict[str, Any] = {**keys, "overrides": dict(overrides or {})}
        return cls(env=str(env), **given)

    @property
    def keywords(self) -> dict[str, Any]:
        """Arguments for `load_world`, `make_vec` and `parallel_env`; without the seed."""
        return {
            "agents": self.agents,
            "background": self.background,
            "max_cycles": self.max_cycles,
            "overrides": self.overrides,
        }


def with_sensors_of_drivers(spec: WorldSpec, policies: Iterable[str | Path]) -> WorldSpec:
    """Return the world with the sensors and actions of the trained drivers in `policies`.

    A world that already has them is unchanged. A change is reported on standard error.

    Raises:
        ConfigError: an override of the world contradicts the drivers.
        PolicyError: a driver cannot be found or read, or two drivers need different forms.
    """
    load_plugins_of(spec.env, spec.overrides)  # the drivers may use sensors of the plugins
    forms = forms_in(policies)
    if not forms:
        return spec
    form, names = common_form(forms), ", ".join(forms)
    differing = differing_keys(form, load_config(spec.env, **spec.keywords)[0])
    if not differing:
        return spec
    needed = {key: value for key, (value, _) in differing.items()}
    fitted = replace(spec, overrides=with_form(spec.overrides, needed, names))
    print(
        f"cavmarl: {spec.env} gets the sensors and actions of {names} ({len(needed)} keys, as with "
        f"--sensors-of {next(iter(forms))})",
        file=sys.stderr,
        flush=True,
    )
    return fitted
