"""Vehicle types and their distributions converted to VTYPE records."""

from __future__ import annotations

import re
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from cavmarl.driving.driver_models import NEAREST_MODEL, has_model, model_code, model_names
from cavmarl.driving.kernels.models.following import MODELS
from cavmarl.driving.vehicle_types import (
    ALL_PERMISSIONS,
    CLASS_DEFAULTS,
    DEFAULT_TYPES,
    NEAREST_CLASS,
    NO_ROAD_CLASSES,
    VTYPE,
    set_model,
)
from cavmarl.roads.network import VEHICLE_CLASSES
from cavmarl.traffic.demand.demand_records import MAX_WEIGHT, Options, listed, weighted
from cavmarl.traffic.demand.element import DemandReport, Element, near
from cavmarl.traffic.demand.rerouting_device import device

MIN_SPEED_FACTOR = 0.2  # SUMO's bounds of speed factors
MAX_SPEED_FACTOR = 2.0

# (minimum, maximum) for a road vehicle in SI units, wide enough for unusual studies.
_LIMITS = {
    "length": (0.1, 100.0),
    "width": (0.1, 10.0),
    "height": (0.0, 20.0),
    "minGap": (0.0, 100.0),
    "accel": (0.01, 1000.0),
    "decel": (0.01, 1000.0),
    "emergencyDecel": (0.01, 1000.0),
    "maxSpeed": (0.01, 1e5),
    "desiredMaxSpeed": (0.01, 1e5),
    "tau": (0.001, 1000.0),
    "sigma": (0.0, 1.0),
    "probability": (0.0, MAX_WEIGHT),
}

_SPEED_FACTOR = re.compile(r"normc?\(([^()]*)\)")
_MODEL_PREFIX = "carFollowing-"

# Attributes that change how a vehicle moves in SUMO and are not modelled here.
_UNUSED = frozenset(
    "actionStepLength apparentDecel collisionMinGapFactor hasDriverState impatience "
    "laneChangeModel latAlignment maxAccelProfile desAccelProfile maxSpeedLat minGapLat sigmaStep "
    "speedFactorPremature startupDelay stepping timeToTeleport timeToTeleportBidi trainType delta "
    "adaptTime adaptFactor tauLast apProb scale".split()
)
_UNUSED_PREFIXES = ("lc", "jm", "cc")


def vehicle_class(element: Element) -> str:
    """Return SUMO's class of a type."""
    name = element.attrs.get("vClass", "passenger").strip()
    if name not in NEAREST_CLASS and name not in NO_ROAD_CLASSES:
        known = [*NEAREST_CLASS, *NO_ROAD_CLASSES]
        raise element.error(f"has the unknown vClass '{name}'", near(name, known))
    return name


def vtype_record(
    element: Element, report: DemandReport, defaults: Mapping[str, str] | None = None
) -> NDArray[np.void] | None:
    """Return the VTYPE record of a <vType>; None for a class that does not use roads.

    `defaults`: default attributes of types.

    Raises DemandError: a value is invalid.
    """
    attrs = dict(element.attrs)
    for child in element.children:
        if child.name.startswith(_MODEL_PREFIX):
            attrs = {**child.attrs, **attrs}
            attrs.setdefault("carFollowModel", child.name.removeprefix(_MODEL_PREFIX))
    for key, value in (defaults or {}).items():
        # The default speedDev must not replace the deviation in norm(…) or normc(…).
        if key != "speedDev" or not _SPEED_FACTOR.fullmatch(attrs.get("speedFactor", "").strip()):
            attrs.setdefault(key, value)
    element = Element(element.name, attrs, element.path, element.line, element.children)
    name = vehicle_class(element)
    if name in NO_ROAD_CLASSES:
        return None
    _report_unused(element, name, report)
    default = CLASS_DEFAULTS[name]
    record = np.zeros((), dtype=VTYPE)
    record["vclass"] = VEHICLE_CLASSES.index(NEAREST_CLASS[name])
    record["permissions"] = ALL_PERMISSIONS if name == "ignoring" else 1 << int(record["vclass"])
    model = _model(element, report)
    set_model(record, model)
    for key in ("length", "width", "height", "accel", "decel"):
        record[key] = _number(element, key, getattr(default, key))
    record["min_gap"] = _number(element, "minGap", default.min_gap)
    record["max_speed"] = _number(element, "maxSpeed", default.max_speed)
    record["desired_max_speed"] = _number(element, "desiredMaxSpeed", default.desired_max_speed)
    record["tau"] = _number(element, "tau", 1.0)
    sigma = _number(element, "sigma", default.sigma)
    record["sigma"] = sigma if any(k.uses_sigma for k in MODELS if k.code == model) else 0.0
    _number(element, "probability", 1.0)
    decel = float(record["decel"])
    record["emergency_decel"] = _number(
        element, "emergencyDecel", max(default.emergency_decel, decel)
    )
    if record["emergency_decel"] < decel:
        report.tolerate("emergencyDecel below decel is raised to it", element.place)
        record["emergency_decel"] = decel
    _set_speed_factor(record, element, default.speed_dev)
    record["reroute"], record["reroute_period_ms"] = device(element)
    return record


def _number(element: Element, key: str, default: float) -> float:
    least, most = _LIMITS[key]
    return element.number(key, default, least=least, most=most)


def _model(element: Element, report: DemandReport) -> int:
    name = element.attrs.get("carFollowModel", "Krauss").strip()
    # SUMO 0.x also used the form carFollowing-Krauss.
    name = name.removeprefix(_MODEL_PREFIX)
    if name not in NEAREST_MODEL and not has_model(name):
        known = (*model_names(), *NEAREST_MODEL)
        raise element.error(f"has the unknown carFollowModel '{name}'", near(name, known))
    nearest = NEAREST_MODEL.get(name, name)
    if nearest != name:
        report.tolerate(f"carFollowModel {name} is treated as {nearest}", element.place)
    return model_code(nearest)


def _report_unused(element: Element, name: str, report: DemandReport) -> None:
    if name != NEAREST_CLASS[name]:
        report.tolerate(
            f"vClass {name} has the permissions of "
            + ("all classes" if name == "ignoring" else NEAREST_CLASS[name]),
            element.place,
        )
    for key in element.attrs:
        if key in _UNUSED or (key.startswith(_UNUSED_PREFIXES) and key[2:3].isupper()):
            report.tolerate(f"attribute {key} of vType is not modelled", element.place)


def _set_speed_factor(record: NDArray[np.void], element: Element, deviation: float) -> None:
    """Set mean, deviation and bounds from "1.1", "norm(m,d)", "normc(m,d,min,max)" or speedDev."""
    numbers = {"speedFactor": "1", "speedDev": element.attrs.get("speedDev", str(deviation))}
    numbers["least"], numbers["most"] = str(MIN_SPEED_FACTOR), str(MAX_SPEED_FACTOR)
    text = element.attrs.get("speedFactor", "1").strip()
    drawn = _SPEED_FACTOR.fullmatch(text)
    parts = [part.strip() for part in drawn[1].split(",")] if drawn else [text]
    if len(parts) > 4 or (drawn and len(parts) < 2):
        raise element.error(f"has speedFactor='{text}'", "write 1.1 or normc(1,0.1,0.2,2)")
    if "speedDev" in element.attrs and len(parts) > 1:
        parts[1] = numbers["speedDev"]
    numbers.update(zip(("speedFactor", "speedDev", "least", "most"), parts, strict=False))
    values = element.with_attrs(**numbers)
    record["speed_factor"] = mean = values.number("speedFactor", 1.0, above=0.0)
    record["speed_dev"] = values.number("speedDev", deviation, least=0.0)
    record["min_speed_factor"] = least = values.number("least", MIN_SPEED_FACTOR, least=0.0)
    record["max_speed_factor"] = most = values.number("most", MAX_SPEED_FACTOR, above=0.0)
    # A fixed factor has no bounds; for a distribution, the mean must lie between the bounds.
    if record["speed_dev"] > 0.0 and not least <= mean <= most:
        raise element.error(
            f"has speedFactor='{text}', whose mean is not between {least:g} and {most:g}",
            "set speedDev='0' or write normc(mean,deviation,min,max)",
        )


class TypeTable:
    """VTYPE rows of all types that the files define, and of SUMO's default types in use.

    Attributes:
        names: id by row.
    """

    def __init__(
        self,
        named: dict[str, dict[str, Element]],
        report: DemandReport,
        defaults: Mapping[str, str],  # default attributes of types
    ) -> None:
        self.names: list[str] = []
        self._types = dict(named.get("vType", {}))
        self._distributions = named.get("vTypeDistribution", {})
        self._rows: list[NDArray[np.void]] = []
        self._row: dict[str, int] = {}
        self._report = report
        self._defaults = defaults
        # Invalid types are refused even if no vehicle uses them.
        for name, element in self._types.items():
            self._resolve(name, element)
        for name, vclass in DEFAULT_TYPES.items():
            self._types.setdefault(name, Element("vType", {"id": name, "vClass": vclass}, "", 0))

    def options(self, name: str, user: Element) -> Options | None:
        """Return the types that a name stands for, with weights; None if none of them uses roads.

        `name`: name of a type or a distribution. `user`: the element that contains the name.

        Raises DemandError: the name is unknown, or the choice is empty.
        """
        if name in self._distributions:
            return self._distribution(self._distributions[name])
        if name not in self._types:
            known = [*self._types, *self._distributions]
            raise user.error(f"names the unknown type '{name}'", near(name, known))
        row = self._resolve(name, self._types[name])
        return None if row < 0 else Options((row,), (1.0,))

    def records(self) -> NDArray[np.void]:
        """Return VTYPE (num_types,)."""
        records = np.zeros(len(self._rows), dtype=VTYPE)
        for row, record in enumerate(self._rows):
            records[row] = record
        return records

    def permissions(self, row: int) -> int:
        return int(self._rows[row]["permissions"])

    def _resolve(self, name: str, element: Element) -> int:
        if name not in self._row:
            record = vtype_record(element, self._report, self._defaults)
            self._row[name] = -1 if record is None else len(self._rows)
            if record is not None:
                self._rows.append(record)
                self.names.append(name)
        return self._row[name]

    def _distribution(self, source: Element) -> Options | None:
        members: list[tuple[str, float]] = []
        for child in source.children:
            if child.name == "vType":
                name = child.text("refId" if "refId" in child.attrs else "id")
                members.append((name, _weight(child)))
        for name, weight in listed(source, "vTypes"):
            if name not in self._types:
                raise source.error(f"names the unknown type '{name}'", near(name, self._types))
            members.append((name, _weight(self._types[name]) if weight is None else weight))
        found: list[tuple[int, float]] = []
        left_out = False
        for name, weight in members:
            if name not in self._types:
                raise source.error(f"names the unknown type '{name}'", near(name, self._types))
            row = self._resolve(name, self._types[name])
            left_out |= row < 0
            if row >= 0:
                found.append((row, weight))
        if left_out:
            what = "type that does not use roads is left out of a distribution"
            self._report.tolerate(what, source.place)
            if not found:
                return None
        return weighted(source, found)


def _weight(element: Element) -> float:
    return element.number("probability", 1.0, least=0.0, most=MAX_WEIGHT)
