"""Evaluations of divided worlds record all transfers between zones."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cavmarl.core.errors import JournalError
from cavmarl.engine.world_setup import load_world
from cavmarl.evaluate import EvaluationReport, evaluate, load_report
from cavmarl.evaluate.evaluation import EPISODES_FILE, TRANSFERS_FILE
from cavmarl.evaluate.tables import EPISODE, TRANSFER, read_table
from cavmarl.evaluate.transfer_rows import transfers_of
from cavmarl.handoff.coordinator.journal_summary import summarize
from cavmarl.zones.partition.zone_file import write_zones
from cavmarl.zones.partition.zone_partition import ZonePartition
from cavmarl.zones.reach import longest_move_m
from tests.support.traffic import network, travel

SMALL: dict[str, Any] = {"episodes": 3, "agents": 4, "background": 40, "max_cycles": 40}
ZONES = {"zones.count": 4}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("divided")
    evaluate("grid4x4", "idm", seed=2, repeats=2, out=folder, overrides=ZONES, **SMALL)
    return folder


def test_each_transfer_has_a_row(folder: Path) -> None:
    rows = read_table(folder / TRANSFERS_FILE, TRANSFER)["idm"]
    assert len(rows) > 10
    assert set(rows["run"].tolist()) == {0, 1}
    assert set(rows["episode"].tolist()) == {0, 1, 2}
    assert (rows["source"] != rows["target"]).all()
    assert (rows["switch_depth_m"] > 2.0).all()  # the hysteresis is 2 m
    prepared = rows[rows["approached"] >= 0]
    assert (prepared["prepare_depth_m"] < prepared["switch_depth_m"]).all()
    staying = rows[~rows["removed"]]
    moved_m = staying["release_depth_m"] - staying["switch_depth_m"]
    assert (moved_m > -0.5).all()
    assert (moved_m < longest_move_m(network("grid4x4"), travel("grid4x4"), 0.1)).all()
    assert np.median(moved_m) > 0.0
    assert np.isnan(rows[rows["removed"]]["release_depth_m"]).all()
    assert (rows["ms"] > 0.0).all()


def test_the_report_has_the_summary_of_transfers(folder: Path) -> None:
    found = load_report(folder)["idm"].transfers
    assert found is not None
    rows = read_table(folder / TRANSFERS_FILE, TRANSFER)["idm"]
    assert found.transfers == len(rows)
    assert found.latency_ticks.max == max(row.ticks for row in transfers_of(rows))
    assert found.latency_ms.p50 is not None
    assert found.state_bytes.max is not None
    assert 0.0 <= (found.failure_rate or 0.0) < 0.2
    assert load_report(folder).to_dict()["policies"]["idm"]["transfers"]["transfers"] == len(rows)


def test_the_manifest_has_the_zones(folder: Path) -> None:
    world = load_report(folder).manifest["world"]
    partition = load_world("grid4x4", overrides=ZONES).partition
    assert world["zones"] == 4
    assert world["zones_content_sha256"] == partition.content_hash
    assert world["config"]["zones"]["hysteresis_m"] == 2.0


def test_zones_change_no_metric_but_the_imbalance_of_zones(folder: Path) -> None:
    whole = evaluate("grid4x4", "idm", seed=2, repeats=2, **SMALL)
    assert whole["idm"].transfers is None
    assert whole["idm"]["zone_imbalance"].mean is None
    assert [run.zone_time_imbalance for run in whole["idm"].speed] == [None, None]
    divided = load_report(folder)["idm"].metrics
    alike = [name for name in divided if name != "zone_imbalance"]
    assert [divided[name] for name in alike] == [whole["idm"][name] for name in alike]


def test_each_episode_has_the_imbalance_of_its_zones(folder: Path, tmp_path: Path) -> None:
    rows = read_table(folder / EPISODES_FILE, EPISODE)["idm"]
    assert len(rows) == 6
    assert ((rows["zone_imbalance"] > 1.0) & (rows["zone_imbalance"] < 2.0)).all()
    assert len(set(rows["zone_imbalance"].tolist())) == 6
    found = load_report(folder)["idm"]["zone_imbalance"].mean
    assert found == pytest.approx(rows["zone_imbalance"].mean())
    # This partition has three narrow zones at the edge of the map, and one zone with all vehicles.
    low_x, low_y, high_x, high_y = load_world("grid4x4").network.extent_m
    cuts = [low_x - 9.0, low_x - 8.0, low_x - 7.0, low_x - 6.0, high_x + 9.0]
    rects = [(a, low_y - 9.0, b, high_y + 9.0) for a, b in pairwise(cuts)]
    bounds = (cuts[0], low_y - 9.0, cuts[-1], high_y + 9.0)
    write_zones(tmp_path / "zones.json", ZonePartition(bounds, np.array(rects)))
    one = {"zones.count": 4, "zones.layout": str(tmp_path / "zones.json")}
    crowd = {**SMALL, "episodes": 1, "background": 150}
    crowded = evaluate("grid4x4", "idm", overrides=one, **crowd)
    assert crowded["idm"]["zone_imbalance"].mean == 4.0
    (speed,) = crowded["idm"].speed
    assert speed.zone_time_imbalance is not None
    assert 1.3 < speed.zone_time_imbalance <= 4.0


def test_an_undivided_world_writes_no_table_of_transfers(tmp_path: Path) -> None:
    report: EvaluationReport = evaluate("ring", "idm", out=tmp_path, **{**SMALL, "episodes": 1})
    assert not (tmp_path / TRANSFERS_FILE).exists()
    assert report.to_dict()["policies"]["idm"]["transfers"] is None


def test_the_duration_of_a_transfer_is_none_if_it_is_unknown() -> None:
    rows = np.zeros(2, TRANSFER)
    rows["ms"] = [1.5, np.nan]
    first, second = transfers_of(rows)
    assert (first.ms, second.ms) == (1.5, None)


def test_each_run_has_its_own_journals(tmp_path: Path) -> None:
    logged = ZONES | {"zones.journal": str(tmp_path / "run.jsonl")}
    few: dict[str, Any] = {**SMALL, "episodes": 2, "repeats": 2, "overrides": logged}
    found = evaluate("grid4x4", "idm", **few)["idm"].transfers
    assert found is not None
    names = {"run.0.jsonl", "run.1.jsonl", "run.run-1.0.jsonl", "run.run-1.1.jsonl"}
    assert {path.name for path in tmp_path.iterdir()} == names
    switches = sum(summarize(tmp_path / name)[0].switches for name in names)
    # The table may lack transfers of the last step of an episode, because a reset follows.
    assert switches >= found.transfers > 0
    (tmp_path / "run.0.jsonl").unlink()
    (tmp_path / "run.1.jsonl").unlink()
    out = tmp_path / "out"
    with pytest.raises(JournalError, match=r"run\.run-1\.0\.jsonl: exists; move it away"):
        evaluate("grid4x4", "idm", out=out, **few)
    assert not (out / "manifest.json").exists(), "the journal was refused after the first run"
