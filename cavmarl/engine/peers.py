"""`Peers`: the other processes that hold zones of the same worlds.

If zones are in several processes, each process runs the same ticks on its own zones. The processes
exchange shared data at fixed points of a tick, so that all of them compute the same departures,
signals and outputs.
"""

from __future__ import annotations

from contextlib import AbstractContextManager, nullcontext

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.records.arrays import DepartureQueue, Outputs, Worlds
from cavmarl.handoff.division import ZonedShards


class Peers:
    """Collective operations: each call returns when all processes have called it in the same tick.

    By default, there are no other processes: this process has all zones and exchanges nothing.
    Rows have two buffers (`Shard.sides`); `side` is the index of the buffer in question.

    Attributes:
        are_none: whether this process runs all zones.
    """

    are_none = True

    def __init__(self, division: ZonedShards) -> None:
        self._division = division

    def drop_foreign_rows(self, chosen: NDArray[np.bool_]) -> None:
        """Drop other processes' vehicles, which a reset of the chosen worlds (W,) has made."""

    def resume_from(self, departures: DepartureQueue, side: int) -> None:
        """Resume from the restored rows of the zones, which are on `side`."""

    def all_zones(self, departures: DepartureQueue, side: int) -> AbstractContextManager[None]:
        """Return a context in which each process has the owned rows of all zones, on `side`.

        Changes of rows are kept in the process that owns them. Within the
        context, all processes must add the same numbers to `departures.counts`.
        """
        return nullcontext()

    def share_rows(self, departures: DepartureQueue, side: int) -> None:
        """Exchange ghosts of the next rows, which are on `side`, and vehicles that leave.

        Afterwards, `departures.passing` has the leaving vehicles of all zones, and
        `departures.counts` their changes of route.
        """

    def running(self) -> NDArray[np.int64]:
        """Return the number of vehicles of each world (W,) in all zones, after `share_rows`."""
        return self._division.running()

    def clear_ranks(self, departures: DepartureQueue) -> None:
        """Clear `departures.ranks`, the crowding of lanes for departures, before zones write it."""

    def share_ranks(self, departures: DepartureQueue) -> None:
        """Exchange `departures.ranks` and `departures.last_s`, as the zones wrote them."""

    def share_proposals(self, departures: DepartureQueue) -> None:
        """Exchange departures that found a gap: `departures.passing` and `departures.places`."""

    def share_leavers(self, departures: DepartureQueue) -> None:
        """Exchange agents' vehicles whose trip has ended, in `departures.passing`."""

    def share_detections(self, worlds: Worlds) -> None:
        """Exchange `worlds.detected_s`, the times of the latest detections of vehicles."""

    def share_outputs(self, outputs: Outputs, chosen: NDArray[np.bool_]) -> None:
        """Exchange the outputs of agents in the chosen worlds (W,), except observations."""
