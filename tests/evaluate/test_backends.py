"""Results of an evaluation do not depend on the backend; the resources of processes are listed."""

from __future__ import annotations

import csv
import json
import socket
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from cavmarl.cli import app
from cavmarl.config.registry import load_config
from cavmarl.core.errors import ConfigError
from cavmarl.evaluate import EvaluationReport, evaluate
from cavmarl.evaluate.evaluation import load_resources
from cavmarl.parallel.network.code_stamp import code_stamp
from tests.support.sumo_worlds import tiny_file

WORLD: dict[str, Any] = {"agents": 4, "background": 30, "max_cycles": 30, "seed": 5}
FILES = ("trips.csv", "tracks.csv", "places.json")
OWNERSHIP = (
    "zone_imbalance"  # depends on the backend, because nodes change owners only between steps
)


def run(folder: Path, backend: str, **more: Any) -> EvaluationReport:
    keys = {**WORLD, "zones": 2, "episodes": 2, **more}
    return evaluate("grid4x4", ["idm", "random_actions"], out=folder, backend=backend, **keys)


def episodes_of(folder: Path) -> list[dict[str, str]]:
    with (folder / "episodes.csv").open(newline="", encoding="utf-8") as file:
        return [{k: v for k, v in row.items() if k != OWNERSHIP} for row in csv.DictReader(file)]


@pytest.fixture(scope="module")
def local(tmp_path_factory: pytest.TempPathFactory) -> dict[int, Path]:
    """Return folders of results with the backend `local`, by number of episodes."""
    folders = {episodes: tmp_path_factory.mktemp("local") for episodes in (1, 2)}
    for episodes, folder in folders.items():
        run(folder, "local", episodes=episodes, overrides={"v2x.enabled": True})
    return folders


# With one episode, two processes share the zones of one world; with two, each runs a world.
@pytest.mark.parametrize("backend", ["processes:2", "nodes:2"])
@pytest.mark.parametrize("episodes", [1, 2])
def test_results_do_not_depend_on_the_backend(
    local: dict[int, Path], episodes: int, backend: str, tmp_path: Path
) -> None:
    report = run(tmp_path, backend, episodes=episodes, overrides={"v2x.enabled": True})
    here = local[episodes]
    for name in FILES:
        assert (tmp_path / name).read_bytes() == (here / name).read_bytes()
    assert episodes_of(tmp_path) == episodes_of(here)
    assert float(episodes_of(here)[0]["v2x_reception_ratio"]) > 0.0
    assert (tmp_path / "transfers.csv").exists() == backend.startswith("nodes")
    processes = [row["process"] for row in report.resources["idm"]]
    assert processes == ["caller", 0, 1]
    assert all(row["memory_mb"] > 10.0 for row in report.resources["idm"])


def test_nodes_report_waits_bytes_and_ownership_changes(tmp_path: Path) -> None:
    report = run(tmp_path, "nodes:2", episodes=1)
    caller, *nodes = report.resources["random_actions"]
    changes = report["random_actions"].transfers
    assert changes is not None
    assert caller["migrations"] == changes.transfers > 0
    assert sum(row["straggler_share"] for row in nodes) >= 1.0
    assert all(row["bytes_per_tick"] > 0.0 and row["wait_share"] > 0.0 for row in nodes)
    rows = load_resources(tmp_path)["random_actions"]
    ticks_of_node = rows["ticks"][rows["process"] == 1]
    assert ticks_of_node.sum() == 30 * load_config("grid4x4")[0].clock.ticks_per_step


def test_the_manifest_describes_the_nodes_and_their_connections(tmp_path: Path) -> None:
    run(tmp_path, "nodes:2", episodes=1)
    network = json.loads((tmp_path / "manifest.json").read_text(encoding="utf-8"))["network"]
    assert network.keys() == {"idm", "random_actions"}
    for nodes in network.values():
        assert [one["node"] for one in nodes] == [0, 1]
        assert len({one["process"] for one in nodes}) == 2
        assert {one["code"] for one in nodes} == {code_stamp()}
        for node in nodes:
            assert node["machine"] == socket.gethostname()
            assert {link["to"] for link in node["links"]} == {"caller", 1 - node["node"]}
            for link in node["links"]:
                assert not link["is_encrypted"]  # connections within one machine are not encrypted
                assert 0.0 < link["least_rtt_ms"] <= 1e3
                assert link["rtt_ms"] > 0.0 < link["delivered_mbit_s"]


def test_the_local_backend_writes_no_table_of_resources(local: dict[int, Path]) -> None:
    assert not (local[1] / "resources.csv").exists()
    assert not load_resources(local[1])


def test_recordings_and_failed_trips_do_not_depend_on_the_backend(tmp_path: Path) -> None:
    pages = {}
    for backend in ("local", "processes:2"):
        out = tmp_path / backend[0]
        evaluate(
            "grid4x4", "random_actions", episodes=2, failures=3, out=out, backend=backend, **WORLD
        )
        pages[backend] = (out / "failures.html").read_bytes()
    assert pages["local"] == pages["processes:2"]


def test_each_run_has_its_own_processes(tmp_path: Path) -> None:
    one, two = tmp_path / "one", tmp_path / "two"
    few = {**WORLD, "max_cycles": 8}
    here = evaluate("grid4x4", "idm", episodes=1, repeats=2, out=one, **few)
    there = evaluate("grid4x4", "idm", episodes=1, repeats=2, out=two, backend="nodes:1", **few)
    assert (one / "trips.csv").read_bytes() == (two / "trips.csv").read_bytes()
    assert here["idm"].metrics == there["idm"].metrics
    assert set(load_resources(two)["idm"]["run"]) == {0, 1}


def test_worlds_whose_state_cannot_be_copied_are_refused(tmp_path: Path) -> None:
    sumo = {
        "traffic.source": "sumo-traffic",
        "traffic.demand": [str(tiny_file(tmp_path))],
        "sensors.signal.timing": False,
    }
    with pytest.raises(ConfigError, match=r"sumo-traffic.*use backend='local'"):
        evaluate("grid4x4", "idm", backend="processes:2", overrides=sumo)
    with pytest.raises(ConfigError, match="the number is missing"):
        evaluate("ring", "idm", backend="nodes", out=tmp_path / "none")
    assert not (tmp_path / "none").exists()


def test_commands_take_zones_and_a_backend(tmp_path: Path) -> None:
    shared = ["--zones", "2", "--backend", "nodes:2", "--out"]
    options = ["--agents", "2", "--background", "4", "--set", "horizon_s=4", "--episodes", "1"]
    shown = CliRunner().invoke(app, ["evaluate", "grid4x4", *options, *shared, str(tmp_path / "e")])
    assert shown.exit_code == 0, shown.output
    assert "processes of idm" in shown.output
    suite = tmp_path / "one.yaml"
    suite.write_text("maps: [ring]\nagents: [2]\nbackground: 0\nhorizon_s: 2.0\n", encoding="utf-8")
    few = ["--episodes", "1", "--repeats", "1", "--backend", "processes:1"]
    done = CliRunner().invoke(app, ["suite", str(suite), *few, "--out", str(tmp_path / "s")])
    assert done.exit_code == 0, done.output
    assert (tmp_path / "s" / "ring-2" / "resources.csv").exists()
