"""`ToldLog`: where SUMO was told that our vehicles are, tick by tick since its reset.

What SUMO does follows from its files, its seed and that. So a SUMO that is started anew and told
the same comes to the same: the successor of a dead process needs no more.

`SEEN` and `MOVED` are what goes between a world and its SUMO: fixed records, no objects.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.errors import SumoError

# A vehicle of SUMO's, in its own conventions: the middle of the front bumper, degrees clockwise
# from north, the place on the lane in the lane's own length. Where SUMO moves no vehicles here,
# what follows `signals` is 0 but for `pos`.
SEEN = np.dtype(
    [
        ("number", np.int32),  # in the order in which they have come
        ("vtype", np.int32),  # VTYPE row
        ("lane", np.int32),  # LANE row of the front
        ("route", np.int32),  # number of its route; of a path, once it is known here
        ("at", np.int32),  # which edge of its route it is on
        ("signals", np.int32),  # SUMO's bits: 1 right, 2 left, 8 brake
        ("x", np.float64),  # m
        ("y", np.float64),
        ("z", np.float64),
        ("angle", np.float64),  # degrees
        ("speed", np.float64),  # m/s
        ("pos", np.float64),  # m, of the front
        ("lat", np.float64),  # m to the left of the lane's centre
    ]
)

# A vehicle of ours, in SUMO's conventions.
MOVED = np.dtype(
    [
        ("id", np.int64),  # VEHICLE["id"]
        ("x", np.float64),  # m, of the front
        ("y", np.float64),
        ("angle", np.float64),  # degrees
        ("edge", np.int32),  # EDGE row outside junctions, near it
        ("kind", np.int32),  # VTYPE row
    ]
)


_TICKS, _SIZE, _IS_CUT, _HEAD = 0, 1, 2, 3  # words: ticks on record, words in use, given up
_WORD = 8
_RECORD = MOVED.itemsize // _WORD  # words


class ToldLog:
    """Of one world, in one episode.

    Args:
        most_bytes: that it may take; where an episode needs more, nothing is kept of it.

    Attributes:
        episode: counts how often it has been begun, by this process.
        HEAD: so many words change; those behind are only ever added to.
    """

    HEAD: Final = _HEAD

    def __init__(self, most_bytes: int) -> None:
        self.episode = 0
        self._most = most_bytes // _WORD
        self.begin()

    def begin(self) -> None:
        """Forget what there was; arrays that were given stay as they are."""
        self.episode += 1
        self._words = np.zeros(_HEAD, dtype=np.int64)
        self._words[_SIZE] = _HEAD

    @property
    def words(self) -> NDArray[np.int64]:
        """(n,) All of it, a view."""
        return self._words[: self._words.item(_SIZE)]

    def note(self, moved: NDArray[np.void]) -> None:
        """Write down what SUMO is told of one more tick.

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
        """Go on from what another one's `words` were."""
        self.begin()
        self._words = np.array(words, dtype=np.int64)

    def ticks(self, count: int) -> Iterator[NDArray[np.void]]:
        """What SUMO was told in each of the first ticks: MOVED (n,).

        Args:
            count: of the ticks since its reset.

        Raises:
            SumoError: so many are not on record.
        """
        words = self._words
        if words[_IS_CUT]:
            raise SumoError(
                f"the record of what SUMO was told in {count} ticks takes more than "
                f"{self._most * _WORD / 2**20:g} MiB, so it was not kept, and no other process can "
                "take up this SUMO: reset the worlds, and raise sumo.replay_mib for the next time"
            )
        if words[_TICKS] < count:
            raise SumoError(
                f"of {count} ticks of a SUMO {words.item(_TICKS)} are on record: no other process "
                "can take it up; reset the worlds"
            )
        return _read(words, count)


def _read(words: NDArray[np.int64], count: int) -> Iterator[NDArray[np.void]]:
    at = _HEAD
    for _ in range(count):
        begin = at + 1
        at = begin + _RECORD * words.item(at)
        yield words[begin:at].view(MOVED)
