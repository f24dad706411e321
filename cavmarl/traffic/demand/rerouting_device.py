"""SUMO's rerouting device: share of equipped vehicles, period, and measurement of speeds."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

from cavmarl.traffic.demand.element import Element

_PREFIX = "device.rerouting."


def device(element: Element) -> tuple[float, int]:
    """Return the settings of the device in the parameters of a vehicle or a type.

    Args:
        element: a <vType>, <vehicle>, <trip> or <flow> with its <param> children.

    Returns:
        The probability of having the device, and the period of searches in ms; -1 if not given.

    Raises:
        DemandError: a probability outside [0, 1], or an invalid time.
    """
    params = element.params()
    settings = {key: value for key, value in params.items() if key.startswith(_PREFIX)}
    values = element.with_attrs(**settings)
    chance = values.number(f"{_PREFIX}probability", -1.0, least=0.0, most=1.0)
    if "has.rerouting.device" in params:
        has = element.with_attrs(**{"has.rerouting.device": params["has.rerouting.device"]})
        chance = float(has.flag("has.rerouting.device", False))
    return chance, values.time_ms(f"{_PREFIX}period", -1)


class DeviceOptions(NamedTuple):
    """Settings of the device in a `.sumocfg` for all vehicles, with SUMO's defaults."""

    chance: float = 0.0  # probability of having the device, if neither vehicle nor type sets it
    period_ms: int = 0  # time between searches if neither vehicle nor type sets it; 0: one search
    adaptation_steps: int = 180  # number of samples in the averages of edge speeds
    adaptation_interval_ms: int = 1000  # time between samples

    @classmethod
    def of(cls, options: Mapping[str, Element]) -> DeviceOptions:
        """Read the settings from the options of a configuration, elements with a `value`.

        Raises DemandError: a value is invalid, or asks for an average that is not supported.
        """
        own = {
            key.removeprefix(_PREFIX): element.with_attrs(**{key: element.attrs["value"]})
            for key, element in options.items()
            if key.startswith(_PREFIX)
        }
        if "adaptation-weight" in own:
            element = own["adaptation-weight"]
            if element.number(f"{_PREFIX}adaptation-weight", 0.0) > 0.0:
                raise element.error(
                    "asks for an exponential average",
                    "remove it and set device.rerouting.adaptation-steps",
                )
        found = cls()
        if "probability" in own:
            # SUMO's default -1 means that no vehicle has the device.
            key = f"{_PREFIX}probability"
            chance = own["probability"].number(key, 0.0, least=-1.0, most=1.0)
            found = found._replace(chance=max(chance, 0.0))
        if "period" in own:
            found = found._replace(period_ms=own["period"].time_ms(f"{_PREFIX}period"))
        if "adaptation-steps" in own:
            steps = own["adaptation-steps"].whole(f"{_PREFIX}adaptation-steps", 180, least=1)
            found = found._replace(adaptation_steps=steps)
        if "adaptation-interval" in own:
            element = own["adaptation-interval"]
            interval_ms = element.time_ms(f"{_PREFIX}adaptation-interval")
            if interval_ms < 1000 or interval_ms % 1000:
                raise element.error("is not supported", "write whole seconds, at least 1")
            found = found._replace(adaptation_interval_ms=interval_ms)
        return found
