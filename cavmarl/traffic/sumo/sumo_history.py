"""`ToldLog`: what SUMO has received (see `MOVED`), tick by tick.

Files, seed and this log determine SUMO's state. A SUMO that is restarted and receives the same log
reaches the same state, so a process that replaces a dead process needs nothing else.

`SEEN` and `MOVED` are the records that a world and its SUMO exchange.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.errors import SumoError

# A vehicle of SUMO in SUMO's conventions: the middle of the front bumper, degrees clockwise from
# north, and the position relative to the lane's length attribute. If SUMO only orders departures,
# all fields from `x` on are 0, except `pos`. For a person, `number` is -1 - slot, `pos` the length
# and `lat` the width.
SEEN = np.dtype(
    [
        ("number", np.int32),  # in the order of entering
        ("vtype", np.int32),  # VTYPE row
        ("lane", np.int32),  # LANE row of the front
        ("route", np.int32),  # number of the route; in this package, number of the path
        ("at", np.int32),  # index of the present edge in the route
        ("signals", np.int32),  # SUMO's bits: 1 right, 2 left, 8 brake
        ("x", np.float64),  # m
        ("y", np.float64),
        ("z", np.float64),
        ("angle", np.float64),  # degrees
        ("speed", np.float64),  # m/s
        ("pos", np.float64),  # m, position of the front on the lane
        ("lat", np.float64),  # m to the left of the lane's centre
    ]
)

# A record that SUMO receives, of one of three kinds:
# 1. a vehicle of this package, in SUMO's conventions (the comments below are about this kind);
# 2. a lane that changes: `kind` is `LANE_CHANGE`, `edge` is the LANE row, `id` has the bits of the
#    classes to which the lane is closed, and `x` is its limit in m/s;
# 3. if SUMO only orders departures, a vehicle that asks for a route: `id` is its VEHICLE["order"].
MOVED = np.dtype(
    [
        ("id", np.int64),  # VEHICLE["id"]
        ("x", np.float64),  # m, position of the front bumper
        ("y", np.float64),
        ("angle", np.float64),  # degrees
        ("length", np.float32),  # m
        ("width", np.float32),
        ("edge", np.int32),  # EDGE row outside junctions, near the vehicle
        ("kind", np.int32),  # VTYPE row
    ]
)
LANE_CHANGE = -1


_TICKS, _SIZE, _IS_CUT, _HEAD = 0, 1, 2, 3  # words: ticks, used words, whether the log was cut
_WORD = 8
_RECORD = MOVED.itemsize // _WORD  # number of words per record


class ToldLog:
    """The log of a world in an episode.

    Args:
        most_bytes: maximum size; if an episode needs more, its log is discarded.

    Attributes:
        episode: number of episodes begun by this process.
        HEAD: number of words at the start that change; later words are only appended.
    """

    HEAD: Final = _HEAD

    def __init__(self, most_bytes: int) -> None:
        self.episode = 0
        self._most = most_bytes // _WORD
        self.begin()

    def begin(self) -> None:
        """Clear the log; arrays returned earlier do not change."""
        self.episode += 1
        self._words = np.zeros(_HEAD, dtype=np.int64)
        self._words[_SIZE] = _HEAD

    @property
    def words(self) -> NDArray[np.int64]:
        """(n,) The whole log, as a view."""
        return self._words[: self._words.item(_SIZE)]

    def note(self, moved: NDArray[np.void]) -> None:
        """Record what SUMO receives for the next tick.

        Args:
            moved: MOVED (n,).
        """
        if self._words[_IS_CUT]:
            return
        size = self._words.item(_SIZE)
        end = size + 1 + _RECORD * len(moved)
        if end > len(self._words):
            if end > self._most:
                self.begin()
                self._words[_IS_CUT] = 1
                return
            grown = np.zeros(min(2 * end, self._most), dtype=np.int64)
            grown[:size] = self._words[:size]
            self._words = grown
        self._words[size] = len(moved)
        self._words[size + 1 : end] = moved.view(np.int64)
        self._words[_TICKS] += 1
        self._words[_SIZE] = end

    def take_up(self, words: NDArray[np.int64]) -> None:
        """Continue from the `words` of another log."""
        self.begin()
        self._words = np.array(words, dtype=np.int64)

    def ticks(self, count: int) -> Iterator[NDArray[np.void]]:
        """Return what SUMO received in each of the first `count` ticks: MOVED (n,).

        Args:
            count: number of ticks since the reset.

        Raises:
            SumoError: the log has fewer ticks.
        """
        words = self._words
        if words[_IS_CUT]:
            raise SumoError(
                f"the log of the places that SUMO received in {count} ticks exceeds "
                f"{self._most * _WORD / 2**20:g} MiB, so it was not kept, and no other process can "
                "replace this SUMO; reset the worlds, and raise sumo.replay_mib for the next time"
            )
        if words[_TICKS] < count:
            raise SumoError(
                f"the log of a SUMO process has {words.item(_TICKS)} of {count} ticks, so no other "
                "process can replace it; reset the worlds"
            )
        return _read(words, count)


def _read(words: NDArray[np.int64], count: int) -> Iterator[NDArray[np.void]]:
    at = _HEAD
    for _ in range(count):
        begin = at + 1
        at = begin + _RECORD * words.item(at)
        yield words[begin:at].view(MOVED)
