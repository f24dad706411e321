"""Trained drivers (the zoo) are verified by a repeated evaluation; changed files are refused."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from cavmarl import make_vec
from cavmarl.config.registry import agent_entries, load_config
from cavmarl.core.errors import ConfigError, ManifestError, PolicyError
from cavmarl.evaluate.evaluation import run_seeds
from cavmarl.evaluate.zoo import TABLES, cross, verify_entry, zoo_entries
from cavmarl.policies.loading import load_policy, policy_files
from tests.golden.zoo import OTHER, SAME, record

pytestmark = pytest.mark.integration  # a manifest reads the commit from git


FILES = ["README.md", "config.json", "manifest.json", "model.safetensors", "result"]


@pytest.fixture
def entry(tmp_path: Path) -> Path:
    return Path(shutil.copytree(agent_entries()["merge_ippo"], tmp_path / "merge_ippo"))


@pytest.mark.parametrize("found", zoo_entries(), ids=lambda entry: entry.name)
def test_each_entry_equals_its_recorded_result(found) -> None:  # type: ignore[no-untyped-def]
    assert found.weights_bytes <= 1_000_000
    assert found.trips >= 50
    config, *_ = load_config(found.environment.rpartition("-")[0])
    if config.traffic.endless:  # no vehicle arrives in endless traffic
        assert found.shares["collision"] == 0.0
    else:
        assert 0.5 < found.shares["success"] <= 1.0
    again = verify_entry(found.name)
    assert list(again.expected) == list(TABLES)
    assert not again.differing


def test_files_with_a_changed_byte_are_refused(entry: Path) -> None:
    weights = entry / "model.safetensors"
    whole = bytearray(weights.read_bytes())
    whole[-1] ^= 1
    weights.write_bytes(whole)
    with pytest.raises(ManifestError, match=r"model\.safetensors: is not the file"):
        verify_entry(entry)


def test_results_that_were_changed_are_refused(entry: Path) -> None:
    trips = entry / "result" / "trips.csv"
    trips.write_text(trips.read_text().replace("True", "False", 1))
    with pytest.raises(ManifestError, match=r"trips\.csv: is not the file"):
        verify_entry(entry)


def test_an_entry_of_a_different_world_is_refused(entry: Path) -> None:
    path = entry / "result" / "manifest.json"
    document = json.loads(path.read_text())
    document["world"]["config"]["clock"]["sim_dt_s"] = 0.1
    path.write_text(json.dumps(document))
    with pytest.raises(
        ManifestError, match=r"config\.clock\.sim_dt_s has another value in this version"
    ):
        verify_entry(entry)


def test_the_tables_that_differ_are_reported(entry: Path) -> None:
    path = entry / "result" / "manifest.json"
    document = json.loads(path.read_text())
    document["job"] |= {"episodes": 1, "seed": 3}
    document |= {"episodes": 1, "seeds": run_seeds(3, len(document["seeds"]))}
    path.write_text(json.dumps(document))
    assert set(verify_entry(entry).differing) == set(TABLES)


def test_a_result_is_recorded_again(entry: Path) -> None:
    path = entry / "result" / "manifest.json"
    document = json.loads(path.read_text())
    document["job"] |= {"episodes": 1, "seed": 3}
    document |= {"episodes": 1, "seeds": run_seeds(3, len(document["seeds"]))}
    path.write_text(json.dumps(document))
    assert record(entry) == OTHER
    assert not verify_entry(entry).differing
    assert record(entry) == SAME
    assert sorted(found.name for found in entry.iterdir()) == FILES


def test_the_old_result_is_kept_if_recording_fails(entry: Path) -> None:
    path = entry / "result" / "manifest.json"
    document = json.loads(path.read_text())
    document["job"]["overrides"] = {"sensors.neighbors.range_m": 30.0}
    path.write_text(json.dumps(document))
    before = {found.name: found.read_bytes() for found in path.parent.iterdir()}
    with pytest.raises(ConfigError, match=r"range_m is 30\.0 in the overrides"):
        record(entry)
    assert {found.name: found.read_bytes() for found in path.parent.iterdir()} == before
    assert sorted(found.name for found in entry.iterdir()) == FILES


def test_unknown_entries_are_refused(entry: Path, tmp_path: Path) -> None:
    with pytest.raises(PolicyError, match="is a script"):
        verify_entry("idm")
    shutil.rmtree(entry / "result")
    with pytest.raises(ManifestError, match="origin of these results is unknown"):
        verify_entry(entry)


def test_a_matrix_has_the_trips_of_each_driver_among_vehicles_of_each_driver() -> None:
    found = cross("merge", ["idm", "random_actions"], episodes=1, seed=2)
    assert found.drivers == ("idm", "random_actions")
    for driver in found.drivers:
        for others in found.drivers:
            trips = found.tables[driver][others]
            assert len(trips)
            assert not (trips["agent"] % 2).any()
    calm = found.share("idm", "idm", "success")
    wild = found.share("random_actions", "idm", "success")
    assert calm is not None
    assert wild == 0.0 < calm


def test_a_matrix_needs_several_agents_and_different_drivers() -> None:
    with pytest.raises(ConfigError, match="has one agent"):
        cross("merge", ["idm"], agents=1)
    with pytest.raises(PolicyError, match="is listed twice"):
        cross("merge", ["idm", "idm"])


def test_two_drivers_of_one_policy_drive_alternate_agents() -> None:
    vec = make_vec("ring", num_envs=2)
    observations, infos = vec.reset(seed=1)
    together = load_policy("idm+random_actions", vec)
    alone = [load_policy(name, vec) for name in ("idm", "random_actions")]
    for driver in (together, *alone):
        driver.reset(5)
    mask = infos["mask"]
    found = together.act_batch(observations, mask)
    even = np.arange(mask.shape[1]) % 2 == 0
    idm = alone[0].act_batch(observations, mask & even)
    other = alone[1].act_batch(observations, mask & ~even)
    np.testing.assert_array_equal(found[:, even], idm[:, even])
    np.testing.assert_array_equal(found[:, ~even], other[:, ~even])
    assert len(policy_files("idm+random_actions")) == 2
    vec.close()
