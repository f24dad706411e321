"""SUMO's rerouting device: which vehicles have it, how often they look, what they know."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

from cavmarl.traffic.demand.element import Element

_PREFIX = "device.rerouting."


def device(element: Element) -> tuple[float, int]:
    """What the parameters of a vehicle or a type say of the device.

    Args:
        element: a <vType>, <vehicle>, <trip> or <flow> with its <param> children.

    Returns:
        The chance of having it and the period in ms of looking for a way; -1 where nothing is said.

    Raises:
        DemandError: a chance outside [0, 1], a time that is none.
    """
    params = element.params()
    said = {key: value for key, value in params.items() if key.startswith(_PREFIX)}
    values = element.saying(**said)
    chance = values.number(f"{_PREFIX}probability", -1.0, least=0.0, most=1.0)
    if "has.rerouting.device" in params:
        has = element.saying(**{"has.rerouting.device": params["has.rerouting.device"]})
        chance = float(has.flag("has.rerouting.device", False))
    return chance, values.time_ms(f"{_PREFIX}period", -1)


class DeviceOptions(NamedTuple):
    """What a `.sumocfg` says of the device for all vehicles; the defaults are SUMO's."""

    chance: float = 0.0  # of having it, where vehicle and type say nothing
    period_ms: int = 0  # between searches, likewise; 0: once
    adaptation_steps: int = 180  # how many samples of the edges' speeds are averaged
    adaptation_interval_ms: int = 1000  # between samples

    @classmethod
    def of(cls, options: Mapping[str, Element]) -> DeviceOptions:
        """From the options of a configuration, each an element with a `value`.

        Raises DemandError: values that cannot be, or an average that is not kept here.
        """
        own = {
            key.removeprefix(_PREFIX): element.saying(**{key: element.attrs["value"]})
            for key, element in options.items()
            if key.startswith(_PREFIX)
        }
        if "adaptation-weight" in own:
            element = own["adaptation-weight"]
            if element.number(f"{_PREFIX}adaptation-weight", 0.0) > 0.0:
                raise element.error(
                    "asks for an exponential average",
                    "leave it out and name device.rerouting.adaptation-steps",
                )
        found = cls()
        if "probability" in own:
            # SUMO's default is -1: no vehicle.
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
                raise element.error("is not made here", "write whole seconds, 1 at least")
            found = found._replace(adaptation_interval_ms=interval_ms)
        return found
