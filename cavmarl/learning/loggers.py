"""Loggers of training runs: TensorBoard, Weights & Biases (offline) and MLflow (local files).

A logger writes into the folder of the run and contacts no host. TensorBoard's files are cut at the
checkpoint when a run is resumed. The files of the other loggers are written again from the rows of
the table.
"""

from __future__ import annotations

import math
import os
import shutil
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol

from cavmarl.core.errors import ConfigError, require, require_all

BOARD_FILES = "events.out.tfevents.*"
WANDB_FOLDER, MLFLOW_FOLDER = "wandb", "mlruns"
PROJECT = "cavmarl"  # project of Weights & Biases, experiment of MLflow

Row = Mapping[str, float]


class Logger(Protocol):
    """Writes the metrics of each update of a run."""

    def write(self, row: Row) -> None:
        """Write the metrics of an update; the x axis is `agent_steps`."""
        ...

    def flush(self) -> None:
        """Write all buffered rows to the files."""
        ...

    def close(self) -> None:
        """End the log."""
        ...


class TensorBoardLogger:
    """Writes files for TensorBoard."""

    def __init__(self, folder: Path, settings: Mapping[str, Any], rows: Sequence[Row]) -> None:
        board = require("torch.utils.tensorboard", "train")
        self._board = board.SummaryWriter(str(folder))

    def write(self, row: Row) -> None:
        for name, value in row.items():
            self._board.add_scalar(name, value, int(row["agent_steps"]))

    def flush(self) -> None:
        self._board.flush()

    def close(self) -> None:
        self._board.close()


class WandbLogger:
    """Writes an offline run of Weights & Biases, which `wandb sync` can upload."""

    def __init__(self, folder: Path, settings: Mapping[str, Any], rows: Sequence[Row]) -> None:
        wandb = require("wandb", "trackers")
        shutil.rmtree(folder / WANDB_FOLDER, ignore_errors=True)
        quiet = wandb.Settings(
            console="off",
            silent=True,
            disable_code=True,
            disable_git=True,
            x_disable_stats=True,
            x_disable_meta=True,
        )
        self._run = wandb.init(
            mode="offline",
            dir=str(folder),
            project=PROJECT,
            name=folder.name,
            config=dict(settings),
            settings=quiet,
        )
        for row in rows:
            self.write(row)

    def write(self, row: Row) -> None:
        self._run.log(dict(row), step=int(row["agent_steps"]))

    def flush(self) -> None:
        pass  # another process writes the rows as they arrive

    def close(self) -> None:
        self._run.finish()


class MlflowLogger:
    """Writes a run of MLflow into local files."""

    def __init__(self, folder: Path, settings: Mapping[str, Any], rows: Sequence[Row]) -> None:
        # Later versions of MLflow ask for this before they write files; a database needs a server
        # or more packages.
        os.environ.setdefault("MLFLOW_ALLOW_FILE_STORE", "true")
        self._entities = require("mlflow.entities", "trackers")
        client = require("mlflow.tracking", "trackers").MlflowClient
        place = folder / MLFLOW_FOLDER
        for earlier in place.glob("*"):
            if earlier.name not in ("0", ".trash"):  # MLflow's own folders
                shutil.rmtree(earlier)
        self._client = client(tracking_uri=place.resolve().as_uri())
        experiment = self._client.create_experiment(PROJECT)
        self._run = self._client.create_run(experiment, run_name=folder.name).info.run_id
        params = [self._entities.Param(name, str(value)) for name, value in settings.items()]
        self._client.log_batch(self._run, params=params)
        for row in rows:
            self.write(row)

    def write(self, row: Row) -> None:
        now_ms, step = round(time.time() * 1000), int(row["agent_steps"])
        metrics = [
            self._entities.Metric(name, float(value), now_ms, step)
            for name, value in row.items()
            if not math.isnan(value)  # no trip has ended yet
        ]
        self._client.log_batch(self._run, metrics=metrics)

    def flush(self) -> None:
        pass  # `log_batch` has written the files

    def close(self) -> None:
        self._client.set_terminated(self._run)


Maker = Callable[[Path, Mapping[str, Any], Sequence[Row]], Logger]
"""Makes a logger from the folder of the run, its settings, and the rows that were logged before."""
LOGGERS: dict[str, Maker] = {
    "tensorboard": TensorBoardLogger,
    "wandb": WandbLogger,
    "mlflow": MlflowLogger,
}
_MODULES = {
    "tensorboard": {"tensorboard": "train"},
    "wandb": {"wandb": "trackers"},
    "mlflow": {"mlflow": "trackers"},
}


def logger_names(text: str) -> tuple[str, ...]:
    """Return the names in a comma-separated list, each once.

    Raises:
        ConfigError: there is no logger of that name.
        MissingExtraError: the library of a logger is not installed.
    """
    names = tuple(dict.fromkeys(name.strip() for name in text.split(",") if name.strip()))
    for name in names:
        if name not in LOGGERS:
            raise ConfigError(
                f"--loggers {name}: no such logger; give some of {', '.join(LOGGERS)}, separated "
                "by commas"
            )
    require_all({module: extra for name in names for module, extra in _MODULES[name].items()})
    return names


def make_loggers(
    names: Iterable[str], folder: Path, settings: Mapping[str, Any], rows: Sequence[Row]
) -> list[Logger]:
    """Return the loggers of a run; `rows`: the rows of the run so far."""
    return [LOGGERS[name](folder, settings, rows) for name in names]
