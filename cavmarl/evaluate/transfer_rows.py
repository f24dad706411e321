"""The transfers of the episodes of a run, as records."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import NDArray

from cavmarl.ownership.transfers import Transfer, TransferLog

TRANSFER = np.dtype(
    [
        ("run", np.int64),
        ("episode", np.int64),
        ("tick", np.int64),  # of the whole run of its world: resets do not turn it back
        ("vehicle", np.int64),
        ("source", np.int64),
        ("target", np.int64),
        ("epoch", np.int64),
        ("forced", np.bool_),  # the state rode along, since the target was not ready in time
        ("removed", np.bool_),  # it left the world in that tick
        ("approached", np.int64),  # tick of the first state at the target; -1: none
        ("waited", np.int64),  # ticks behind the border
        ("offers", np.int64),  # states that arrived
        ("state_bytes", np.int64),
        ("prepare_depth_m", np.float64),  # outside of the source's zone at the first state
        ("switch_depth_m", np.float64),  # at the switch
        ("release_depth_m", np.float64),  # when the switch was committed
        ("ms", np.float64),  # from the first state until the target had confirmed; not repeatable
    ]
)


class TransferRecorder:
    """Follows the worlds of an undivided or divided simulation through one episode of each.

    Args:
        logs: one a world; none where worlds are undivided.

    Attributes:
        counts: sums of the logs' counts over the episodes.
    """

    def __init__(self, logs: Sequence[TransferLog]) -> None:
        self.counts: Counter[str] = Counter()
        self._logs = tuple(logs)
        self._before = [Counter(log.counts) for log in logs]
        self._episodes = [log.episode for log in logs]
        self._rows: list[tuple[int, Transfer]] = []
        for log in logs:
            log.take()

    def collect(self, worlds: Iterable[int], over: NDArray[np.bool_]) -> None:
        """After a step: take the rows of worlds in their episode.

        Args:
            worlds: that were in it during the step.
            over: (W,) whose episode has ended with it.
        """
        if not self._logs:
            return
        for w in worlds:
            log = self._logs[w]
            if log.rows:
                kept = (row for row in log.take() if row.episode == self._episodes[w])
                self._rows.extend((w, row) for row in kept)
            if over[w]:
                self.counts.update(log.counts)
                self.counts.subtract(self._before[w])

    def records(self) -> NDArray[np.void]:
        """TRANSFER (n,) in the order of worlds; `episode` is the world."""
        rows = np.zeros(len(self._rows), TRANSFER)
        for n, (world, row) in enumerate(sorted(self._rows, key=lambda entry: entry[0])):
            values = row._replace(episode=world)
            rows[n] = (0, *(np.nan if value is None else value for value in values))
        return rows


def transfers_of(rows: NDArray[np.void]) -> list[Transfer]:
    return [
        Transfer._make(None if value != value else value for value in row[1:])
        for row in rows.tolist()
    ]
