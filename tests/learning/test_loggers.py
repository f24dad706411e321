"""Loggers of training runs get all rows of the table, also after a run is resumed."""

from __future__ import annotations

import math
import time
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("torch")

from cavmarl.core.errors import ConfigError, MissingExtraError, TrainingError
from cavmarl.learning import loggers
from cavmarl.learning.log import Log, cut_logs, read_rows
from cavmarl.learning.loggers import LOGGERS, logger_names

NAMES = ("updates", "agent_steps", "trip_return", "success")
ROWS = [
    dict(zip(NAMES, row, strict=True)) for row in ((1, 8, math.nan, math.nan), (2, 16, 0.25, 0.5))
]


class StoringLogger:
    """A logger that stores its arguments."""

    made: list[StoringLogger] = []  # noqa: RUF012 - emptied by each test

    def __init__(self, folder: Path, settings: Any, rows: Any) -> None:
        self.folder, self.settings, self.before = folder, dict(settings), list(rows)
        self.rows: list[dict[str, float]] = []
        self.calls: list[str] = []
        self.made.append(self)

    def write(self, row: Any) -> None:
        self.rows.append(dict(row))

    def flush(self) -> None:
        self.calls.append("flush")

    def close(self) -> None:
        self.calls.append("close")


@pytest.fixture
def notes(monkeypatch: pytest.MonkeyPatch) -> list[StoringLogger]:
    monkeypatch.setitem(LOGGERS, "notes", StoringLogger)
    monkeypatch.setattr(StoringLogger, "made", [])
    return StoringLogger.made


def test_a_logger_gets_settings_and_rows(notes: list[StoringLogger], tmp_path: Path) -> None:
    log = Log(tmp_path, ["notes"], {"seed": 3})
    for row in ROWS:
        log.write(row)
    sizes = log.sync()
    log.close()
    (logger,) = StoringLogger.made
    assert (logger.folder, logger.settings, logger.before) == (tmp_path, {"seed": 3}, [])
    assert [row["agent_steps"] for row in logger.rows] == [8, 16]
    assert logger.calls == ["flush", "close"]
    assert sizes == {"progress.csv": (tmp_path / "progress.csv").stat().st_size}


def test_a_resumed_run_gives_a_logger_the_rows_before_the_checkpoint(
    notes: list[StoringLogger], tmp_path: Path
) -> None:
    log = Log(tmp_path, ["notes"])
    log.write(ROWS[0])
    sizes = log.sync()
    log.write(ROWS[1])  # after the checkpoint, so it is removed
    log.close()
    cut_logs(tmp_path, sizes)
    Log(tmp_path, ["notes"]).close()
    before = StoringLogger.made[1].before
    assert [row["agent_steps"] for row in before] == [8.0]
    assert math.isnan(before[0]["success"])


def test_a_damaged_table_is_refused(tmp_path: Path) -> None:
    (tmp_path / "progress.csv").write_text("updates,agent_steps\n1\n")
    with pytest.raises(TrainingError, match=r"progress\.csv: is damaged .*; restore a copy"):
        read_rows(tmp_path)


def test_unknown_and_uninstalled_loggers_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    assert logger_names("") == ()
    assert logger_names(" tensorboard, tensorboard") == ("tensorboard",)
    with pytest.raises(ConfigError, match="no such logger; give some of tensorboard, wandb, ml"):
        logger_names("wandbb")
    monkeypatch.setitem(loggers.LOGGERS, "wandb", StoringLogger)
    monkeypatch.setattr("cavmarl.core.errors.find_spec", lambda module: None)
    with pytest.raises(MissingExtraError, match=r"'wandb' .* not installed: .*\[trackers\]"):
        logger_names("wandb")


@pytest.mark.filterwarnings("ignore")  # the library warns about its own code
def test_mlflow_reads_the_rows_of_a_resumed_run(tmp_path: Path) -> None:
    tracking = pytest.importorskip("mlflow.tracking")
    for rows in (ROWS[:1], ROWS[1:]):
        log = Log(tmp_path, ["mlflow"], {"seed": 3})
        for row in rows:
            log.write(row)
        log.close()
    client = tracking.MlflowClient(tracking_uri=(tmp_path / "mlruns").resolve().as_uri())
    experiment = client.get_experiment_by_name("cavmarl")
    (run,) = client.search_runs([experiment.experiment_id])
    assert run.data.params == {"seed": "3"}
    assert run.info.status == "FINISHED"
    history = client.get_metric_history(run.info.run_id, "agent_steps")
    assert [(point.step, point.value) for point in history] == [(8, 8.0), (16, 16.0)]
    assert [point.value for point in client.get_metric_history(run.info.run_id, "success")] == [0.5]


@pytest.mark.integration  # the library starts a process
@pytest.mark.filterwarnings("ignore")  # the library warns about its own code
def test_wandb_writes_an_offline_run(tmp_path: Path) -> None:
    pytest.importorskip("wandb")
    for rows in (ROWS[:1], ROWS[1:]):
        log = Log(tmp_path, ["wandb"], {"seed": 3})
        for row in rows:
            log.write(row)
        log.close()
    (file,) = tmp_path.glob("wandb/offline-run-*/run-*.wandb")
    until = time.monotonic() + 60.0
    while file.read_bytes().count(b"trip_return") < 2:  # another process writes the file
        assert time.monotonic() < until
        time.sleep(0.1)
