"""`RowChecks`: vehicles that other processes have sent, before kernels index tables by them."""

from __future__ import annotations

from collections.abc import Sequence
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
NUM_DRIVERS = 4
MOST_IDS = 1 << 62  # of vehicles in a run


class RowChecks:
    """Those of the worlds of a process.

    Attributes:
        of_rows: bounds of the indices in a row.
        of_ghosts: of those in a row, its step and the place of that.
    """

    def __init__(self, simulation: Simulation) -> None:
        shard = simulation.shards[0]
        travel, roads = shard.travel, shard.roads
        lanes, links, steps = len(roads.lanes), len(roads.links), len(travel.steps)
        goals = max(len(shard.plans), len(travel.scripts.frames), steps // max(lanes, 1))
        agents = simulation.outputs.present.shape[1]
        self.of_rows = _bounds(
            [
                (VEHICLE, "id", 0, 0, MOST_IDS),
                (VEHICLE, "lane", 0, 0, lanes),
                (VEHICLE, "side_lane", 0, -1, lanes),
                (VEHICLE, "target_lane", 0, -1, lanes),
                (VEHICLE, "link", 0, -1, links),
                (VEHICLE, "stopped_at", 0, -1, links),
                (VEHICLE, "vtype", 0, 0, len(travel.types)),
                (VEHICLE, "driver", 0, 0, NUM_DRIVERS),
                (VEHICLE, "agent", 0, -1, agents),
                (VEHICLE, "goal", 0, -1, goals),
                (VEHICLE, "stop", 0, -1, 1 + len(travel.stops)),
                (VEHICLE, "stops_end", 0, -1, 1 + len(travel.stops)),
            ]
        )
        way = [_word(VEHICLE, "way"), WITH_LANE, 0, steps]
        self.of_rows = np.vstack([self.of_rows, np.array([way], dtype=np.int64)])
        of_steps = _bounds(
            [
                (PLAN, "next", ROW_WORDS, -1, lanes),
                (PLAN, "link", ROW_WORDS, -1, links),
            ]
        )
        step_at = [ROW_WORDS + PLAN.itemsize // 8, WHOLE, 0, 1 + steps]
        both = [self.of_rows, of_steps, np.array([step_at], dtype=np.int64)]
        self.of_ghosts = np.concatenate(both)
        self._are_bounded = specialized(are_bounded)

    def check(self, rows: NDArray[np.void]) -> None:
        """Refuse rows, (n,) VEHICLE, that point at what there is not. Raises MessageError."""
        words = np.ascontiguousarray(rows).view(np.int64).reshape(-1, ROW_WORDS)
        if not self._are_bounded(words, self.of_rows):
            raise MessageError("a vehicle is where nothing is, or of a kind that there is not")

    def check_state(self, record: bytes) -> None:
        """The same of a row as bytes."""
        self.check(np.frombuffer(bytearray(record), VEHICLE, 1))


def _word(dtype: np.dtype[Any], name: str) -> int:
    assert dtype.fields is not None
    return int(dtype.fields[name][1]) // 8


def _bounds(told: Sequence[tuple[np.dtype[Any], str, int, int, int]]) -> Bounds:
    """Bounds of fields of records that begin at a word, each from one value to before another."""
    rows = []
    for dtype, name, first, least, end in told:
        assert dtype.fields is not None
        kind, at = dtype.fields[name][:2]
        bit = WHOLE if kind.itemsize == 8 else 8 * (int(at) % 8)
        rows.append([first + int(at) // 8, bit, least, end])
    return np.array(rows, dtype=np.int64)
