"""`cavmarl bench v2x` measures every channel, and says when one of them takes too long."""

from __future__ import annotations

import json
from pathlib import Path

from typer.testing import CliRunner

from cavmarl.bench.v2x_speed import CHANNELS
from cavmarl.cli import app

WORDS = ["bench", "v2x", "grid4x4", "--vehicles", "40", "--ticks", "10", "--warmup", "10"]


def test_channels_are_measured_on_the_same_vehicles(tmp_path: Path) -> None:
    path = tmp_path / "v2x.json"
    result = CliRunner().invoke(app, [*WORDS, "--json", str(path), "--at-most", "1000"])
    assert result.exit_code == 0, result.output
    found = json.loads(path.read_text())
    rows = {row["name"]: row for row in found["rows"]}
    assert list(rows) == list(CHANNELS)
    assert all(len(row["tick_ms"]) == 10 and row["median_ms"] > 0.0 for row in rows.values())
    assert rows["ideal"]["reception_ratio"] == rows["range 300 m"]["reception_ratio"] == 1.0
    assert rows["path loss"]["reachable"] == rows["range 300 m"]["reachable"]
    assert rows["ideal"]["reachable"] > rows["path loss"]["reachable"] > 0.0
    assert 0.0 < rows["path loss, busy air"]["reception_ratio"] < 1.0


def test_a_channel_that_takes_too_long_ends_it_with_1() -> None:
    assert CliRunner().invoke(app, [*WORDS, "--at-most", "1e-9"]).exit_code == 1
