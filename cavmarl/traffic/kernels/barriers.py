"""Barriers that close lanes: vehicles whose stop has no end until the lane is opened."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.compiled import kernel
from cavmarl.core.records.arrays import DepartureQueue, Worlds
from cavmarl.core.records.codes import INSERT_OPEN


@kernel
def drive_on(
    inserted: NDArray[np.float64],  # as in `Commands`
    first_stop: int,  # STOP row of the barrier on lane 0; the rows of other lanes follow
    worlds: Worlds,  # rows are written, including ghosts
) -> None:
    """End the stops of the barriers on lanes that are opened."""
    for w in range(inserted.shape[0]):
        for n in range(inserted.shape[1]):
            if inserted[w, n, 0] != INSERT_OPEN:
                continue
            stop = first_stop + int(inserted[w, n, 1])
            for i in range(worlds.num_rows[w]):
                row = worlds.rows[w, i]
                if row["stop"] == stop and row["stops_end"] == stop + 1:
                    row["stop"] = stop + 1
                    row["stopped_s"] = 0.0


@kernel
def withdraw(departures: DepartureQueue, w: int, stop: int) -> None:
    """Remove departures that would stand as the barrier of this stop from the queue."""
    kept = 0
    for q in range(departures.num_queue[w]):
        if departures.queue[w, q]["stop"] == stop:
            continue
        if kept < q:
            departures.queue[w, kept] = departures.queue[w, q]
        kept += 1
    departures.num_queue[w] = kept
