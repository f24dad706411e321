"""Types: from vehicle types and their distributions to VTYPE records."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cavmarl.driving.vehicle_types import DEFAULT_TYPES, VTYPE
from cavmarl.traffic.demand.demand_records import Options
from cavmarl.traffic.demand.demand_report import DemandReport
from cavmarl.traffic.demand.distributions import MAX_WEIGHT, listed, weighted
from cavmarl.traffic.demand.element import Element, near
from cavmarl.traffic.demand.vehicle_type_reader import vtype_record


class TypeTable:
    """VTYPE rows of all types that files define, and of SUMO's own that they use.

    Attributes:
        names: id by row.
    """

    def __init__(self, named: dict[str, dict[str, Element]], report: DemandReport) -> None:
        self.names: list[str] = []
        self._types = dict(named.get("vType", {}))
        self._distributions = named.get("vTypeDistribution", {})
        self._rows: list[NDArray[np.void]] = []
        self._row: dict[str, int] = {}
        self._report = report
        # Wrong types are refused whether vehicles use them or not.
        for name, element in self._types.items():
            self._resolve(name, element)
        for name, vclass in DEFAULT_TYPES.items():
            self._types.setdefault(name, Element("vType", {"id": name, "vClass": vclass}, "", 0))

    def options(self, name: str, user: Element) -> Options | None:
        """The types to choose from under a name; None if vehicles of it drive on no road.

        `name`: of a type or a distribution. `user`: the element that names it.

        Raises:
            DemandError: there is neither, or nothing to choose from.
        """
        if name in self._distributions:
            return self._distribution(self._distributions[name])
        if name not in self._types:
            known = [*self._types, *self._distributions]
            raise user.error(f"names the unknown type '{name}'", near(name, known))
        row = self._resolve(name, self._types[name])
        return None if row < 0 else Options((row,), (1.0,))

    def records(self) -> NDArray[np.void]:
        """VTYPE (num_types,)."""
        records = np.zeros(len(self._rows), dtype=VTYPE)
        for row, record in enumerate(self._rows):
            records[row] = record
        return records

    def permissions(self, row: int) -> int:
        return int(self._rows[row]["permissions"])

    def _resolve(self, name: str, element: Element) -> int:
        if name not in self._row:
            record = vtype_record(element, self._report)
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
            self._report.tolerate("type of no road class in a distribution", source.place)
            if not found:
                return None
        return weighted(source, found)


def _weight(element: Element) -> float:
    return element.number("probability", 1.0, least=0.0, most=MAX_WEIGHT)
