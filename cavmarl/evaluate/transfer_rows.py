"""Ownership transfers of the episodes of a run, as records."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import NDArray

from cavmarl.evaluate.tables import TRANSFER
from cavmarl.ownership.transfers import Transfer, TransferLog


class TransferRecorder:
    """Records the transfers of worlds through one episode each."""

    def __init__(self, logs: Sequence[TransferLog]) -> None:
        self.counts: Counter[str] = Counter()  # counts of the logs, summed over the episodes
        self._logs = tuple(logs)
        self._before = [Counter(log.counts) for log in logs]
        self._episodes = [log.episode for log in logs]
        self._rows: list[tuple[int, Transfer]] = []
        for log in logs:
            log.take()

    def collect(self, worlds: Iterable[int], over: NDArray[np.bool_]) -> None:
        """Add the rows of a step of running worlds; episodes of `over` (W,) have ended."""
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
        """Return TRANSFER (n,) sorted by world; `episode` is the world."""
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
