"""`IndexCheck`: refuses vehicles from other nodes if one of their indices is out of bounds."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.compiled import specialized
from cavmarl.core.errors import MessageError
from cavmarl.driving.vehicles import VEHICLE
from cavmarl.engine.simulation import Simulation
from cavmarl.roads.routing import PLAN
from cavmarl.zones.kernels.row_bounds import WHOLE, WITH_LANE, Bounds, are_bounded

ROW_WORDS = VEHICLE.itemsize // 8


class IndexCheck:
    """Compares the indices of vehicles with the sizes of the tables of this process.

    Attributes:
        of_rows: bounds of the indices in a row.
        of_ghosts: bounds of the indices in a ghost: in its row, its PLAN, and its `step_at`.
    """

    def __init__(self, simulation: Simulation) -> None:
        indices, steps = simulation.division.row_check.indices, simulation.division.row_check.steps
        of_way = (_word(VEHICLE, "way"), WITH_LANE, 0, steps)
        of_row = [_bound(VEHICLE, name, 0, values) for name, values in indices.items()]
        of_step = [
            _bound(PLAN, "next", ROW_WORDS, range(-1, indices["lane"].stop)),
            _bound(PLAN, "link", ROW_WORDS, indices["link"]),
        ]
        step_at = (ROW_WORDS + PLAN.itemsize // 8, WHOLE, 0, 1 + steps)
        self.of_rows: Bounds = np.array([*of_row, of_way], dtype=np.int64)
        self.of_ghosts: Bounds = np.array([*of_row, of_way, *of_step, step_at], dtype=np.int64)
        self._are_bounded = specialized(are_bounded)

    def check(self, rows: NDArray[np.void]) -> None:
        """Refuse (n,) rows of VEHICLE with an index that is out of bounds. Raises MessageError."""
        words = np.ascontiguousarray(rows).view(np.int64).reshape(-1, ROW_WORDS)
        if not self._are_bounded(words, self.of_rows):
            raise MessageError("a vehicle has an index that is out of bounds")

    def check_state(self, record: bytes) -> None:
        """Refuse a row, given as bytes, with an index out of bounds. Raises MessageError."""
        self.check(np.frombuffer(bytearray(record), VEHICLE, 1))


def _word(dtype: np.dtype[Any], name: str) -> int:
    """Return the offset of a field in a record, in words of 8 bytes."""
    assert dtype.fields is not None
    return int(dtype.fields[name][1]) // 8


def _bound(dtype: np.dtype[Any], name: str, first: int, values: range) -> tuple[int, int, int, int]:
    """Return a row of `Bounds` for a field of a record that starts at word `first`."""
    assert dtype.fields is not None
    kind, at = dtype.fields[name][:2]
    bit = WHOLE if kind.itemsize == 8 else 8 * (int(at) % 8)
    return first + int(at) // 8, bit, values.start, values.stop
