"""`RowStream`: the ghosts that two nodes send each other in each tick.

Both ends keep the ghosts of the previous frame, and forecast the ghosts of the next frame. A frame
has only the words that differ from the forecast.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.compiled import specialized
from cavmarl.core.errors import MessageError
from cavmarl.core.huge_pages import huge_zeros
from cavmarl.core.records.arrays import DepartureQueue, RoadArrays, ZoneState
from cavmarl.driving.vehicles import VEHICLE
from cavmarl.parallel.network.transport import Bytes
from cavmarl.roads.routing import PLAN
from cavmarl.zones.kernels.ghost_forecast import PLACES, Forecast
from cavmarl.zones.kernels.row_bounds import Bounds
from cavmarl.zones.kernels.row_frames import (
    AFTER,
    ID,
    MOST,
    NO_FRAME,
    ExchangeState,
    Ghosts,
    Passing,
    pack_frame,
    take_frame,
)

Array = NDArray[Any]


class _Room:
    """Ghosts of the previous frame, and a buffer for the ghosts of the current frame."""

    def __init__(self, words: int) -> None:  # `words` of a ghost
        self._before, self.now = (_ghosts(np.empty((0, words), dtype=np.int64)) for _ in range(2))
        self.before = self._before

    def make(self, num: int) -> None:
        """Make room for at least `num` ghosts."""
        if len(self.now.words) < num:
            size = self.now.words.shape[1]
            self.now = _ghosts(huge_zeros((num + num // 2, size), dtype=np.int64))

    def turn(self, num: int) -> None:
        """Make the `num` current ghosts the previous ghosts."""
        self._before, self.now = self.now, self._before
        self.before = _ghosts(self._before.words[:num])


def _ghosts(words: Array) -> Ghosts:
    return Ghosts(words, words.view(np.float64))


def forecast_of(
    roads: RoadArrays,
    dt: float,  # duration of a tick in s
    ticks_per_step: int,
    of_rows: Bounds,  # see `IndexCheck`
    of_ghosts: Bounds,  # see `IndexCheck`
) -> Forecast:
    """Return what kernels need to forecast ghosts, and to check them."""
    lanes, links = roads.lanes, roads.links
    beyond = np.zeros(len(lanes))
    inside = lanes["internal"]
    of_link = lanes[inside]
    beyond[inside] = links["length_m"][of_link["link"]] - of_link["link_offset_m"]
    words = np.zeros(MOST, dtype=np.int64)
    limits = lanes["speed_mps"].astype(np.float64)
    way_to_go = VEHICLE.itemsize // 8 + _word(PLAN, "to_go")
    assert all(_word(VEHICLE, name) == place for name, place in PLACES.items())
    return Forecast(
        dt, ticks_per_step, way_to_go, limits, beyond, of_rows, of_ghosts, words,
        words.view(np.float64),
    )  # fmt: skip


def _word(dtype: np.dtype[Any], name: str) -> int:
    """Return the offset of a field in a record, in words of 8 bytes."""
    assert dtype.fields is not None
    return int(dtype.fields[name][1]) // 8


class RowStream:
    """The stream of ghosts between this node and another node."""

    def __init__(
        self,
        zoned: ZoneState,
        zones: NDArray[np.int64],  # zones of this node
        others: NDArray[np.int64],  # zones of the other node
        running: NDArray[np.int64],  # (W,) see `ExchangeState`
        rerouted: NDArray[np.int64],  # (W,) see `ExchangeState`
        law: Forecast,
    ) -> None:
        rows, steps = words_of(zoned.rows), words_of(zoned.step)
        numbers = zoned.num_owned, zoned.num_rows, zoned.num_near
        self._both = ExchangeState(
            rows, steps, zoned.step_at, *numbers, zones, others, running, rerouted
        )
        self._row = rows.shape[-1]
        size = self._row + steps.shape[-1] + AFTER
        assert size < MOST
        self._law = law
        assert zoned.rows["id"].ctypes.data - zoned.rows.ctypes.data == 8 * ID
        self._sent, self._received = _Room(size), _Room(size)
        self._slots = np.empty(1, dtype=np.int32)
        self._make_frame(1 + (3 + 2 * len(others)) * running.size)
        self._pack = specialized(pack_frame, checks=False)
        self._unpack = specialized(take_frame, checks=False)

    def packed(self, side: int, passing: Passing) -> Bytes:
        """Return the next frame for the other node, valid until the next call.

        Args:
            side: buffer of the rows, 0 or 1, whose ghosts are sent.
            passing: vehicles that leave, in the arrays of the departure queue.
        """
        sent = self._sent
        before = len(sent.before.words)
        if self._slots.size < 2 * before:
            self._slots = np.empty(1 << (2 * before).bit_length(), dtype=np.int32)
        args = self._both, side, passing, self._law, sent.before, self._slots
        num = self._pack(*args, sent.now, self._frame)
        if num < 0:
            ghosts = -1 - num
            sent.make(ghosts)
            words = ghosts * (2 + sent.now.words.shape[1]) + int(passing.num.sum()) * self._row
            self._make_frame(self._frame.size + words + words // 2)
            num = self._pack(*args, sent.now, self._frame)
        if num or before:
            sent.turn(num)
        return self._bytes[: 8 * self._frame.item(0)]

    def _make_frame(self, words: int) -> None:
        """Make room for a frame."""
        self._frame = huge_zeros(words, dtype=np.int64)
        self._bytes = self._frame.view(np.uint8).data

    def read(self, data: memoryview, side: int, passing: Passing) -> None:
        """Read a frame of the other node.

        Raises:
            MessageError: the bytes are not a frame, or there is no room for its content.
        """
        received, num = self._received, NO_FRAME
        if data and not len(data) % 8:
            frame = np.frombuffer(data, np.int64)
            args = self._both, side, passing, self._law, received.before
            if frame[1 : 1 + 3 * self._both.running.size].min(initial=0) >= 0:  # numbers
                num = self._unpack(*args, received.now, frame)
            if NO_FRAME < num < 0:
                received.make(-1 - num)
                num = self._unpack(*args, received.now, frame)
        if num < 0:
            raise MessageError(f"{len(data)} bytes are not a frame of ghosts")
        if num or len(received.before.words):
            received.turn(num)


def passing_of(departures: DepartureQueue) -> Passing:
    """Return the vehicles that leave, from the arrays of a departure queue, as views."""
    return Passing(words_of(departures.passing), departures.num_passing, departures.counts)


def words_of(rows: Array) -> Array:
    """Return records as words of 8 bytes, (…, words), a view."""
    return rows.view(np.int64).reshape(*rows.shape, -1)
