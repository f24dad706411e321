"""The numbers of every update: as a table, for TensorBoard, and in words."""

from __future__ import annotations

import csv
from collections.abc import Collection
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

from cavmarl.core.errors import require

CSV_FILE = "progress.csv"


WINDOW = 400  # trips that a row's means are of


def curve_row(
    updates: int,
    agent_steps: int,
    seconds: float,
    trips: int,
    last: Collection[tuple[float, float]],
) -> dict[str, float]:
    """What all programs log of an update: `last` are (return, arrived) of the last trips."""
    trip_return, success = np.array(list(last)).mean(axis=0).tolist() if last else (np.nan, np.nan)
    return {
        "updates": updates,
        "agent_steps": agent_steps,
        "seconds": seconds,
        "trips": trips,
        "trip_return": trip_return,
        "success": success,
    }


class Log:
    """Writes the numbers of every update to CSV, and to TensorBoard where asked for."""

    def __init__(self, folder: Path, goes_on: bool = False, tensorboard: bool = False) -> None:
        self._file = (folder / CSV_FILE).open("a" if goes_on else "w", encoding="utf-8", newline="")
        self._writer: csv.DictWriter[str] | None = None
        self._with_header = not goes_on
        self._board: Any = None
        if tensorboard:
            board = require("torch.utils.tensorboard", "torch")
            self._board = board.SummaryWriter(str(folder))

    def write(self, row: dict[str, float]) -> None:
        if self._writer is None:
            self._writer = csv.DictWriter(self._file, list(row))
            if self._with_header:
                self._writer.writeheader()
        self._writer.writerow({name: f"{value:.6g}" for name, value in row.items()})
        self._file.flush()
        if self._board is not None:
            for name, value in row.items():
                self._board.add_scalar(name, value, int(row["agent_steps"]))

    def close(self) -> None:
        self._file.close()
        if self._board is not None:
            self._board.close()


def progress_bar(console: Console) -> Progress:
    """A bar over the run, with the numbers that say whether it learns."""
    return Progress(
        TextColumn("{task.percentage:3.0f} %"),
        BarColumn(bar_width=10),
        TimeElapsedColumn(),
        TextColumn("{task.description}"),
        console=console,
    )


def describe(row: dict[str, float]) -> str:
    """What a person wants to see of an update: agent-steps, their rate, and the last trips."""
    return (
        f"{row['agent_steps'] / 1e6:.2f} M at {row['agent_steps_per_s'] / 1e3:.0f} k/s · "
        f"return {row['trip_return']:.1f} · success {row['success']:.0%} · "
        f"hit {row['collision']:.0%} · off {row['off_road']:.0%}"
    )
