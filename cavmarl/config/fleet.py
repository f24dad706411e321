"""The keys `population.fleet` and `population.own_types`: the agents' types, drivers and sensors.

population:
  agents: 6
  own_types:
    van: {like: truck, length_m: 6.4, width_m: 2.1, height_m: 2.7, wheelbase_m: 3.7}
  fleet:
    - {type: car, rig: [roof, gnss], driver: cities_ippo, share: 2}
    - {type: van, rig: [gnss]}
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray

from cavmarl.config.checks import Within, check, check_ranges

KNOWN_TYPES = ("car", "truck", "bus")
RESERVED_TYPES = (*KNOWN_TYPES, "pedestrian", "cyclist", "roadside_unit")


@dataclass(frozen=True, kw_only=True)
class OwnType:
    """A vehicle type of an environment; missing values are taken from the type `like`.

    Attributes:
        like: the type that provides the missing values, the vehicle class and the permitted lanes.
        length_m: between the bumpers.
        width_m: without mirrors.
        height_m: above the ground.
        wheelbase_m: between the axles.
        most_steering_rad: largest angle of the front wheels.
        accel_mps2: largest acceleration.
        decel_mps2: comfortable deceleration of the built-in driver.
        emergency_decel_mps2: largest deceleration.
        min_gap_m: gap that the built-in driver keeps at rest.
        max_speed_mps: technical limit.
    """

    like: Literal["car", "truck", "bus"] = "car"
    length_m: Annotated[float, Within(1.0, 30.0)] | None = None
    width_m: Annotated[float, Within(0.4, 4.0)] | None = None
    height_m: Annotated[float, Within(0.4, 6.0)] | None = None
    wheelbase_m: Annotated[float, Within(0.5, 20.0)] | None = None
    most_steering_rad: Annotated[float, Within(0.05, 1.3)] | None = None
    accel_mps2: Annotated[float, Within(0.1, 15.0)] | None = None
    decel_mps2: Annotated[float, Within(0.1, 15.0)] | None = None
    emergency_decel_mps2: Annotated[float, Within(0.1, 15.0)] | None = None
    min_gap_m: Annotated[float, Within(0.1, 20.0)] | None = None
    max_speed_mps: Annotated[float, Within(1.0, 100.0)] | None = None


@dataclass(frozen=True, kw_only=True)
class FleetPart:
    """A part of the agents.

    Attributes:
        type: `car`, `truck`, `bus`, or one of `population.own_types`.
        rig: names of the sensors of `rig` that these vehicles carry; default: all.
        driver: driver of these agents for the policy `fleet`; default: the built-in driver `idm`.
        share: share of the agents, relative to the shares of the other parts.
    """

    type: str = "car"
    rig: tuple[str, ...] | None = None
    driver: str = "idm"
    share: Annotated[float, Within(0.001, 1000.0)] = 1.0


def check_fleet(own_types: Mapping[str, OwnType], fleet: Sequence[FleetPart]) -> None:
    """Check names and values. Raises ConfigError."""
    for name, own in own_types.items():
        key = f"population.own_types.{name}"
        expected = f"must be an identifier other than {', '.join(RESERVED_TYPES)}"
        free = name.isidentifier() and name not in RESERVED_TYPES
        check(free, "population.own_types", name, expected)
        check_ranges(key, own)
        if own.wheelbase_m is not None and own.length_m is not None:
            expected = f"must be at most the length of {own.length_m:g} m"
            check(own.wheelbase_m <= own.length_m, f"{key}.wheelbase_m", own.wheelbase_m, expected)
        if own.decel_mps2 is not None and own.emergency_decel_mps2 is not None:
            expected = f"must be at most emergency_decel_mps2 = {own.emergency_decel_mps2:g}"
            check(
                own.decel_mps2 <= own.emergency_decel_mps2,
                f"{key}.decel_mps2",
                own.decel_mps2,
                expected,
            )
    types = (*KNOWN_TYPES, *own_types)
    for k, part in enumerate(fleet):
        key = f"population.fleet.{k}"
        expected = f"must be one of {', '.join(types)}; define others under population.own_types"
        check(part.type in types, f"{key}.type", part.type, expected)
        check_ranges(key, part)


def parts_in_turn(fleet: Sequence[FleetPart], count: int) -> NDArray[np.int64]:
    """Return (count,) the part of each agent, so that each part always has about its share.

    Agent k belongs to the part that is farthest behind its share of k + 1 agents; ties go to the
    first part.
    """
    exact = [Fraction(part.share) for part in fleet]
    unit = math.lcm(*(share.denominator for share in exact))
    shares = [int(share * unit) for share in exact]  # whole numbers, for exact ties
    whole, behind = sum(shares), [0] * len(fleet)
    chosen = np.zeros(count, dtype=np.int64)
    for k in range(count):
        behind = [gap + share for gap, share in zip(behind, shares, strict=True)]
        part = behind.index(max(behind))
        behind[part] -= whole
        chosen[k] = part
    return chosen
