"""`Peers`: the other processes that hold zones of the same worlds.

Where zones live in several processes, each runs the same ticks on its own zones. What all of them
have to know goes between them at fixed points of a tick, so that departures, signals and outputs
are worked out everywhere alike.
"""

from __future__ import annotations

from contextlib import AbstractContextManager, nullcontext
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.records.arrays import DepartureQueue, Outputs, Worlds
from cavmarl.handoff.division import ZonedShards


class Peers(Protocol):
    """Each method returns when all processes have called it in the same place of the tick.

    Attributes:
        are_none: whether this process runs all zones.
    """

    are_none: bool

    def keep_own(self, chosen: NDArray[np.bool_]) -> None:
        """After a reset of the chosen worlds (W,), of which all have made all vehicles."""
        ...

    def take_up(self, departures: DepartureQueue, side: int) -> None:
        """Zones have their vehicles of another tick, on `side`."""
        ...

    def everybody(self, departures: DepartureQueue, side: int) -> AbstractContextManager[None]:
        """The time in which the owned rows of all zones, on `side`, are in each process.

        What is changed of rows stays where they are owned. What is counted in `departures.counts`
        meanwhile is counted everywhere alike.
        """
        ...

    def share_rows(self, departures: DepartureQueue, side: int) -> None:
        """Ghosts of the next rows, which are on `side`, and vehicles that leave.

        Those of all zones stand in `departures.passing` then, and how often vehicles took another
        way in `departures.counts`.
        """
        ...

    def running(self) -> NDArray[np.int64]:
        """(W,) vehicles of each world, in all zones, after `share_rows`."""
        ...

    def clear_ranks(self, departures: DepartureQueue) -> None:
        """Before zones rank the lanes where departures may enter."""
        ...

    def share_ranks(self, departures: DepartureQueue) -> None:
        """`departures.ranks` and `departures.last_s`, as the zones wrote them."""
        ...

    def share_proposals(self, departures: DepartureQueue) -> None:
        """Departures that found a gap: `departures.passing` and `departures.places`."""
        ...

    def share_leavers(self, departures: DepartureQueue) -> None:
        """Agents' vehicles whose trip has ended, in `departures.passing`."""
        ...

    def share_detections(self, worlds: Worlds) -> None:
        """`worlds.detected_s`: when detectors have seen a vehicle last."""
        ...

    def share_outputs(self, outputs: Outputs, chosen: NDArray[np.bool_]) -> None:
        """What the agents of the chosen worlds (W,) have got, but for their observations."""
        ...


class NoPeers:
    """All zones are in this process, so nothing has to be shared."""

    are_none = True

    def __init__(self, division: ZonedShards) -> None:
        self._division = division

    def keep_own(self, chosen: NDArray[np.bool_]) -> None:
        """All vehicles are of this process."""

    def take_up(self, departures: DepartureQueue, side: int) -> None:
        """There is no other process to tell."""

    def everybody(self, departures: DepartureQueue, side: int) -> AbstractContextManager[None]:
        """Return at once: the rows of all zones are always here."""
        return nullcontext()

    def share_rows(self, departures: DepartureQueue, side: int) -> None:
        """All ghosts are here."""

    def running(self) -> NDArray[np.int64]:
        """Return (W,) vehicles of each world, in all zones."""
        return self._division.running()

    def clear_ranks(self, departures: DepartureQueue) -> None:
        """The zones of this process write all ranks."""

    def share_ranks(self, departures: DepartureQueue) -> None:
        """All ranks are here."""

    def share_proposals(self, departures: DepartureQueue) -> None:
        """All proposals are here."""

    def share_leavers(self, departures: DepartureQueue) -> None:
        """All vehicles that leave are here."""

    def share_detections(self, worlds: Worlds) -> None:
        """All detectors are here."""

    def share_outputs(self, outputs: Outputs, chosen: NDArray[np.bool_]) -> None:
        """All outputs are here."""
