"""`VTYPE`: the properties of a vehicle type, and SUMO's default values by vehicle class.

The numbers are from SUMO 1.28 (Vehicle_Type_Parameter_Defaults in its documentation). The tests
compare them with a running SUMO.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cavmarl.config.fleet import OwnType
from cavmarl.config.population import PopulationConfig
from cavmarl.core.records.codes import CLASS_PEDESTRIAN, MODEL_IDM
from cavmarl.driving.kernels.models.following import MODELS
from cavmarl.driving.kernels.models.idm import (
    ACCEL_LIMIT,
    ACCEL_MAX,
    DECEL_COMFORT,
    JAM_DISTANCE_M,
    TIME_HEADWAY_S,
)
from cavmarl.driving.kernels.motion.motion import MAX_SPEED_MPS
from cavmarl.roads.network import CARS, VEHICLE_CLASSES

# A vehicle of SUMO's class "ignoring" may use every lane.
ALL_PERMISSIONS = (1 << 32) - 1

VTYPE = np.dtype(
    [
        ("vclass", np.int32),  # index in VEHICLE_CLASSES
        ("permissions", np.uint32),  # LANE["permissions"] of a usable lane has one of these bits
        ("model", np.int32),  # MODEL_*; written by `set_model`
        # 1 + position of the network in `TrafficConfig.networks` that drives background vehicles of
        # this type; 0: the driver model drives them
        ("network", np.int32),
        ("as_sumo", np.bool_),  # look ahead, yield, queue and resolve deadlocks as SUMO does
        ("length", np.float64),  # m
        ("width", np.float64),  # m
        ("height", np.float64),  # m
        ("accel", np.float64),  # m/s², largest acceleration
        ("decel", np.float64),  # m/s², comfortable deceleration, positive
        ("emergency_decel", np.float64),  # m/s², largest deceleration, at least decel
        ("tau", np.float64),  # s, desired time gap
        ("min_gap", np.float64),  # m, between bumpers at rest
        ("max_speed", np.float64),  # m/s, technical limit of the vehicle
        ("desired_max_speed", np.float64),  # m/s, limit of the driver, before the speed factor
        ("sigma", np.float64),  # imperfection of the driver in Krauss's model, in [0, 1]
        # desired speed divided by the speed limit: mean, standard deviation and range
        ("speed_factor", np.float64),
        ("speed_dev", np.float64),
        ("min_speed_factor", np.float64),
        ("max_speed_factor", np.float64),
        ("reroute", np.float64),  # probability that a vehicle searches for a route; -1: not stated
        ("reroute_period_ms", np.int64),  # time between two searches; 0: one search, -1: not stated
        # the next fields: only for types of agents' vehicles, else 0
        ("wheelbase", np.float64),  # m, twice the distance from the centre to each axle
        ("most_steering", np.float64),  # rad, largest angle of the front wheels
        ("most_accel", np.float64),  # m/s², largest acceleration of a policy
        ("most_decel", np.float64),  # m/s², largest deceleration of a policy, positive
    ],
    align=True,
)

# The fields that define a type; the other fields are derived from them.
STATED_FIELDS = [name for name in VTYPE.names or () if name not in ("as_sumo", "network")]


class ClassDefaults(NamedTuple):
    """Default values of a vehicle class; names and units as in `VTYPE`."""

    length: float
    width: float
    height: float
    min_gap: float
    accel: float
    decel: float
    emergency_decel: float
    max_speed: float
    sigma: float
    speed_dev: float
    desired_max_speed: float = 10000.0 / 3.6


_KMH = 1.0 / 3.6
_CAR = ClassDefaults(5.0, 1.8, 1.5, 2.5, 2.6, 4.5, 9.0, 200.0 * _KMH, 0.5, 0.1)
_VAN = _CAR._replace(length=6.5, width=2.16, height=2.86, speed_dev=0.05)
_OFFICIAL = _CAR._replace(speed_dev=0.0)

CLASS_DEFAULTS = {
    "passenger": _CAR,
    "private": _CAR,
    "hov": _CAR,
    "vip": _CAR,
    "evehicle": _CAR,
    "custom1": _CAR,
    "custom2": _CAR,
    "ignoring": _OFFICIAL,
    "authority": _OFFICIAL,
    "army": _OFFICIAL,
    "taxi": _CAR._replace(speed_dev=0.05),
    "delivery": _VAN,
    "emergency": _VAN._replace(speed_dev=0.0),
    "bus": ClassDefaults(12.0, 2.5, 3.4, 2.5, 1.2, 4.0, 7.0, 100.0 * _KMH, 0.5, 0.0),
    "coach": ClassDefaults(14.0, 2.6, 4.0, 2.5, 2.0, 4.0, 7.0, 100.0 * _KMH, 0.5, 0.05),
    "truck": ClassDefaults(7.1, 2.4, 2.4, 2.5, 1.3, 4.0, 7.0, 130.0 * _KMH, 0.5, 0.05),
    "trailer": ClassDefaults(16.5, 2.55, 4.0, 2.5, 1.1, 4.0, 7.0, 130.0 * _KMH, 0.5, 0.05),
    "tram": ClassDefaults(22.0, 2.4, 3.2, 2.5, 1.0, 3.0, 7.0, 80.0 * _KMH, 0.0, 0.0),
    "motorcycle": ClassDefaults(2.2, 0.9, 1.5, 2.5, 6.0, 10.0, 10.0, 200.0 * _KMH, 0.5, 0.1),
    "moped": ClassDefaults(2.1, 0.78, 1.7, 2.5, 1.1, 7.0, 10.0, 60.0 * _KMH, 0.5, 0.1),
    "bicycle": ClassDefaults(
        1.6, 0.65, 1.7, 0.5, 1.2, 3.0, 7.0, 50.0 * _KMH, 0.5, 0.1, desired_max_speed=20.0 * _KMH
    ),
    "scooter": ClassDefaults(1.2, 0.5, 1.7, 0.5, 1.2, 3.0, 7.0, 25.0 * _KMH, 0.5, 0.1),
}

# For each class of SUMO, the class of the road network whose permissions apply.
NEAREST_CLASS = {name: name for name in VEHICLE_CLASSES} | {
    "private": "passenger",
    "hov": "passenger",
    "vip": "passenger",
    "evehicle": "passenger",
    "custom1": "passenger",
    "custom2": "passenger",
    "ignoring": "passenger",
    "authority": "passenger",
    "army": "passenger",
    "coach": "bus",
    "trailer": "truck",
    "moped": "motorcycle",
    "scooter": "bicycle",
}

# Classes of SUMO that do not use roads: their vehicles are skipped.
NO_ROAD_CLASSES = frozenset(
    "pedestrian wheelchair rail_urban rail rail_electric rail_fast subway ship container cable_car "
    "aircraft drone".split()
)

# Types that SUMO predefines, with their classes.
DEFAULT_TYPES = {
    "DEFAULT_VEHTYPE": "passenger",
    "DEFAULT_TAXITYPE": "taxi",
    "DEFAULT_BIKETYPE": "bicycle",
    "DEFAULT_PEDTYPE": "pedestrian",
    "DEFAULT_CONTAINERTYPE": "container",
    "DEFAULT_RAILTYPE": "rail",
}


class AgentType(NamedTuple):
    """A type that agents or the caller may use besides the car; units as in `VTYPE`."""

    vclass: str
    length: float
    width: float
    height: float
    accel: float
    decel: float
    emergency_decel: float
    min_gap: float
    max_speed: float
    wheelbase: float
    most_steering: float


# A truck of two axles limited to 90 km/h, and a city bus limited to 100 km/h.
AGENT_TYPES = {
    "truck": AgentType("truck", 8.0, 2.5, 3.6, 1.5, 4.0, 6.0, 3.0, 25.0, 4.8, 0.7),
    "bus": AgentType("bus", 12.0, 2.55, 3.2, 1.2, 3.5, 5.5, 3.0, 27.8, 6.0, 0.75),
}
# Types of vehicles, besides the car, that the caller poses or drives.
EXTERNAL_TYPES = AGENT_TYPES | {
    "pedestrian": AgentType("pedestrian", 0.5, 0.5, 1.75, 1.5, 2.0, 4.0, 0.5, 5.0, 0.5, 0.7),
    "cyclist": AgentType("bicycle", 1.6, 0.65, 1.7, 1.2, 3.0, 7.0, 0.5, 13.9, 1.1, 0.7),
    # A pole with antennas and sensors; in camera pictures, it has the class of a car.
    "roadside_unit": AgentType("passenger", 0.4, 0.4, 3.0, 1.0, 1.0, 1.0, 0.5, 1.0, 0.4, 0.7),
}
# For each key of an environment's vehicle type, the fields of VTYPE that it sets.
_OWN_FIELDS = {
    "length_m": ["length"],
    "width_m": ["width"],
    "height_m": ["height"],
    "wheelbase_m": ["wheelbase"],
    "most_steering_rad": ["most_steering"],
    "accel_mps2": ["accel", "most_accel"],
    "decel_mps2": ["decel"],
    "emergency_decel_mps2": ["emergency_decel", "most_decel"],
    "min_gap_m": ["min_gap"],
    "max_speed_mps": ["max_speed", "desired_max_speed"],
}
NO_OWN_TYPES: Mapping[str, OwnType] = MappingProxyType({})
CAR_WHEELBASE_M = 5.0  # the axles of highway-env's car are at its bumpers
NO_LIMIT = 1e9  # the type does not limit a policy; the setting `action` does


def set_model(types: NDArray[np.void] | np.void, model: int) -> None:
    """Set the car-following model (MODEL_*) of VTYPE rows or of one row."""
    types["model"] = model
    types["as_sumo"] = any(known.as_sumo for known in MODELS if known.code == model)


def agent_types(
    names: Iterable[str], model: int = MODEL_IDM, own: Mapping[str, OwnType] = NO_OWN_TYPES
) -> NDArray[np.void]:
    """Return the VTYPE records (n,) of types by name.

    Args:
        names: `car`, or keys of `EXTERNAL_TYPES` or `own`.
        model: car-following model (MODEL_*) of the types.
        own: types of the environment, by name.
    """
    chosen = list(names)
    types = generated_types(model).repeat(len(chosen))
    for record, name in zip(types, chosen, strict=True):
        if name in own:
            _write_own(record, own[name], model)
            continue
        if name == "car":
            continue
        kind = EXTERNAL_TYPES[name]
        for field, value in kind._asdict().items():
            if field != "vclass":
                record[field] = value
        if kind.vclass == "pedestrian":
            record["vclass"], record["permissions"] = CLASS_PEDESTRIAN, 0
        else:
            record["vclass"] = VEHICLE_CLASSES.index(kind.vclass)
            record["permissions"] |= 1 << int(record["vclass"])  # in addition to the lanes of cars
        record["desired_max_speed"] = kind.max_speed
        record["most_accel"], record["most_decel"] = kind.accel, kind.emergency_decel
    types.setflags(write=False)
    return types


def names_beside_car(population: PopulationConfig, has_external: bool) -> list[str]:
    """Return the names of the types of agents' and of the caller's vehicles, without the car.

    `has_external`: whether the caller poses or drives vehicles.
    """
    names = [*population.agent_types, *(EXTERNAL_TYPES if has_external else ())]
    return [name for name in dict.fromkeys(names) if name != "car"]


def _write_own(record: np.void, own: OwnType, model: int) -> None:
    """Write a type of an environment to its VTYPE record."""
    like = agent_types([own.like], model)[0]
    for name in VTYPE.names or ():
        record[name] = like[name]
    for key, names in _OWN_FIELDS.items():
        value = getattr(own, key)
        if value is not None:
            for name in names:
                record[name] = value
    # Defaults of keys that are not given may contradict the given keys.
    record["wheelbase"] = min(record["wheelbase"], record["length"])
    record["decel"] = min(record["decel"], record["emergency_decel"])


def generated_types(model: int = MODEL_IDM) -> NDArray[np.void]:
    """Return VTYPE (1,): the passenger car of generated traffic and of agents.

    The car has the IDM parameters and the size (5 m × 2 m) of highway-env's car.
    """
    types = np.zeros(1, dtype=VTYPE)
    car = types[0]
    car["vclass"] = VEHICLE_CLASSES.index("passenger")
    car["permissions"] = CARS
    set_model(types, model)
    car["length"], car["width"], car["height"] = 5.0, 2.0, 1.6
    car["accel"] = ACCEL_MAX
    car["decel"] = DECEL_COMFORT
    car["emergency_decel"] = ACCEL_LIMIT
    car["tau"] = TIME_HEADWAY_S
    car["min_gap"] = JAM_DISTANCE_M - car["length"]
    car["max_speed"] = car["desired_max_speed"] = MAX_SPEED_MPS
    car["speed_factor"] = 1.0
    car["wheelbase"] = CAR_WHEELBASE_M
    car["most_steering"] = car["most_accel"] = car["most_decel"] = NO_LIMIT
    types.setflags(write=False)
    return types
