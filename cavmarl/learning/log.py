"""The metrics of every update: as a CSV table, for experiment trackers, and as text."""

from __future__ import annotations

import csv
import os
from collections import deque
from collections.abc import Collection, Iterable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from cavmarl.config.terms import TERMS
from cavmarl.core.errors import TrainingError
from cavmarl.evaluate.provenance.training_record import CSV_FILE
from cavmarl.learning.checkpoint import Parts, writing
from cavmarl.learning.loggers import BOARD_FILES, make_loggers

WINDOW = 1000  # number of last trips that a row averages

ENDS = ("arrival", "collision", "off_road", "red_light")
COLUMNS = [TERMS.index(name) for name in ENDS]


def curve_row(
    updates: int,
    agent_steps: int,
    seconds: float,
    trips: int,
    last: Collection[tuple[float, float]],
) -> dict[str, float]:
    """Return the metrics that all programs log; `last`: (return, arrived) of the last trips."""
    trip_return, success = np.array(list(last)).mean(axis=0).tolist() if last else (np.nan, np.nan)
    return {
        "updates": updates,
        "agent_steps": agent_steps,
        "seconds": seconds,
        "trips": trips,
        "trip_return": trip_return,
        "success": success,
    }


class Trips:
    """The returns and ends of the last `WINDOW` trips, and current trips of (W, A) agents."""

    def __init__(self, num_envs: int, num_agents: int) -> None:
        self._sums = np.zeros((num_envs, num_agents, 2))  # return, red lights run
        self._ended: deque[list[float]] = deque(maxlen=WINDOW)
        self._count = 0

    def add(
        self, rewards: NDArray[Any], done: NDArray[Any], cut: NDArray[Any], terms: NDArray[Any]
    ) -> None:
        """Add one step; `done` (W, A) marks trips that end, `cut` (W, A) trips to discard."""
        self._sums[..., 0] += rewards
        self._sums[..., 1] += terms[..., COLUMNS[3]]
        if (gone := done | cut).any():
            ran_red = self._sums[done][:, 1:] > 0.0
            rows = [self._sums[done][:, :1], terms[done][:, COLUMNS[:3]], ran_red]
            self._ended.extend(np.concatenate(rows, axis=1, dtype=np.float64).tolist())
            self._count += int(done.sum())
            self._sums[gone] = 0.0

    def save(self) -> Parts:
        return {"sums": torch.from_numpy(self._sums), "ended": list(self._ended), "n": self._count}

    def load(self, saved: Parts) -> None:
        self._sums[:] = saved["sums"].numpy()
        self._ended.extend(saved["ended"])
        self._count = saved["n"]

    def means(self) -> dict[str, float]:
        """Return the means of the last trips, and the number of all trips."""
        names = ("trip_return", "success", *ENDS[1:])
        columns = np.array(self._ended).mean(axis=0) if self._ended else np.full(5, np.nan)
        return {"trips": self._count, **dict(zip(names, columns.tolist(), strict=True))}


def mean_of_ranks(found: Sequence[dict[str, float]]) -> dict[str, float]:
    """Return `Trips.means` over all processes, weighted by the numbers of averaged trips."""
    if len(found) == 1:
        return found[0]
    weights = [min(row["trips"], WINDOW) for row in found]
    counted = [row for row, weight in zip(found, weights, strict=True) if weight]
    columns = np.array([list(row.values()) for row in counted or found])
    means = np.average(columns, axis=0, weights=[each for each in weights if each] or None)
    return {
        **dict(zip(found[0], means.tolist(), strict=True)),
        "trips": sum(row["trips"] for row in found),
    }


class Log:
    """Writes the metrics of every update to a CSV table and to other loggers.

    Args:
        folder: folder of the run.
        loggers: names of `LOGGERS`.
        settings: settings of the run, for loggers that show them.
    """

    def __init__(
        self, folder: Path, loggers: Iterable[str] = (), settings: Mapping[str, Any] | None = None
    ) -> None:
        self._path = folder / CSV_FILE
        self._writer: csv.DictWriter[str] | None = None
        with writing(self._path):
            self._file = self._path.open("a", encoding="utf-8", newline="")
            self._loggers = make_loggers(loggers, folder, settings or {}, read_rows(folder))

    def write(self, row: dict[str, float]) -> None:
        with writing(self._path):
            if self._writer is None:
                self._writer = csv.DictWriter(self._file, list(row))
                if not self._path.stat().st_size:
                    self._writer.writeheader()
            self._writer.writerow({name: f"{value:.6g}" for name, value in row.items()})
            self._file.flush()
            for logger in self._loggers:
                logger.write(row)

    def sync(self) -> dict[str, int]:
        """Flush everything to the disk and return the size of each file in bytes."""
        sizes = {}
        with writing(self._path):
            for logger in self._loggers:
                logger.flush()
            for path in _files(self._path.parent):
                with path.open("rb") as file:
                    os.fsync(file.fileno())
                    sizes[path.name] = os.fstat(file.fileno()).st_size
        return sizes

    def close(self) -> None:
        """Close the files and ignore errors; rows that a full disk has refused are lost."""
        with suppress(OSError):
            self._file.close()
        for logger in self._loggers:
            with suppress(OSError):
                logger.close()


def cut_logs(folder: Path, sizes: Mapping[str, int]) -> None:
    """Truncate the logs to the sizes that `Log.sync` returned.

    Raises:
        TrainingError: rows are missing.
    """
    for path in _files(folder):
        if path.name not in sizes:
            path.unlink()
        elif path.stat().st_size > sizes[path.name]:
            os.truncate(path, sizes[path.name])
    table = folder / CSV_FILE
    if not table.is_file() or table.stat().st_size < sizes[CSV_FILE]:
        raise TrainingError(
            f"{table}: rows written before the checkpoint are missing; restore a copy of it, or "
            "train again under another --name"
        )


def read_rows(folder: Path) -> list[dict[str, float]]:
    """Return the rows of a run's table, to six significant digits; empty without a table."""
    path = folder / CSV_FILE
    if not path.is_file():
        return []
    with path.open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    try:
        return [{name: float(value) for name, value in row.items()} for row in rows]
    except (TypeError, ValueError) as error:
        raise TrainingError(
            f"{path}: is damaged ({error}); restore a copy of it, or train again under another "
            "--name"
        ) from error


def _files(folder: Path) -> list[Path]:
    return [*folder.glob(CSV_FILE), *folder.glob(BOARD_FILES)]


def progress_bar(console: Console) -> Progress:
    """Return a progress bar with the metrics that show learning."""
    return Progress(
        TextColumn("{task.percentage:3.0f} %"),
        BarColumn(bar_width=10),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
        TextColumn("{task.description}"),
        console=console,
    )


def describe(row: dict[str, float]) -> str:
    """Return a summary of an update: agent steps, their rate, and the last trips."""
    return (
        f"{row['agent_steps'] / 1e6:.2f} M at {row['agent_steps_per_s'] / 1e3:.0f} k/s · "
        f"return {row['trip_return']:.1f} · success {row['success']:.0%} · "
        f"hit {row['collision']:.0%} · off {row['off_road']:.0%}"
    )
