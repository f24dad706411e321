"""The manifest is written before the results; results without a valid manifest are refused."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest

from cavmarl.core.errors import ManifestError
from cavmarl.env.vector import make_vec
from cavmarl.evaluate import evaluate, load_report
from cavmarl.evaluate.provenance.manifest import MANIFEST_FILE, hash_of_file, read_closed
from tests.support.forked_processes import ForkedProcess

SMALL: dict[str, Any] = {"episodes": 1, "agents": 2, "background": 2, "max_cycles": 5}


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Return the results folder of a small evaluation."""
    evaluate("merge", "idm", out=tmp_path / "results", **SMALL)
    return tmp_path / "results"


def manifest(env: str = "merge", **changed: Any) -> dict[str, Any]:
    return dict(evaluate(env, "random_actions", **{**SMALL, **changed}).manifest)


def test_a_manifest_is_repeatable_and_changes_with_the_world_and_the_seed() -> None:
    first, again = manifest(), manifest()
    varying = ("started", "ended", "results_sha256")
    assert {k: v for k, v in first.items() if k not in varying} == {
        k: v for k, v in again.items() if k not in varying
    }
    fewer = manifest(agents=1)["world"]
    assert fewer["config_sha256"] != first["world"]["config_sha256"]
    assert fewer["map_content_sha256"] == first["world"]["map_content_sha256"]
    other = manifest("ring")["world"]
    assert other["map_content_sha256"] != first["world"]["map_content_sha256"]
    watching = manifest(overrides={"sensors.lidar.rays": 8})["world"]
    assert watching["config"]["sensors"]["lidar"]["rays"] == 8
    assert watching["config_sha256"] != first["world"]["config_sha256"]
    assert manifest(seed=3)["seeds"] == [3]


def test_a_manifest_identifies_demand_by_its_content(tmp_path: Path) -> None:
    found = []
    for period in (5, 5, 4):
        path = tmp_path / f"{len(found)}.rou.xml"
        path.write_text(
            "<routes><route id='r' edges='main_in weave main_out'/>"
            f"<flow id='f' route='r' begin='0' end='60' period='{period}'/></routes>"
        )
        world = manifest(overrides={"traffic.demand": [str(path)]}, background=0)["world"]
        found.append(world["demand_content_sha256"])
    assert found[0] == found[1] != found[2]
    assert manifest()["world"]["demand_content_sha256"] is None


PERSON = (
    "<routes><person id='p' depart='0'/><route id='r' edges='main_in weave main_out'/>"
    "<flow id='f' route='r' begin='25200' end='25260' period='5'/></routes>"
)


def test_ignored_parts_of_demand_are_reported_once_and_recorded(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    path = tmp_path / "x.rou.xml"
    path.write_text(PERSON)
    demand = {"traffic.demand": [str(path)]}
    said = [
        f"       1 <person> is not read (first: {path}, line 1)",
        "       1 the demand begins at 25200 s, as no vehicle departs from 0 s to 1 s "
        f"(first: {path}, line 1)",
    ]
    assert manifest(background=0, overrides=demand)["world"]["demand_tolerated"] == said
    text = "\n".join(["merge: tolerated in the demand:", *said])
    assert caplog.messages == [text]
    caplog.clear()
    make_vec("merge", num_envs=2, background=0, max_cycles=5, overrides=demand).close()
    assert caplog.messages == [text]
    assert manifest()["world"]["demand_tolerated"] == []


def test_a_manifest_names_hardware_versions_and_commit() -> None:
    found = manifest()
    hardware = found["hardware"]
    assert hardware["cpu"]
    assert hardware["logical_cores"] >= hardware["usable_cores"] >= 1
    assert hardware["memory_gb"] > 0.1
    assert isinstance(hardware["gpus"], list)
    assert all(found["software"]["packages"][name] for name in ("numpy", "numba", "pettingzoo"))
    assert found["code"]["commit"]
    assert found["command"]


def test_a_closed_manifest_lists_its_result_files_with_their_hashes(folder: Path) -> None:
    document = read_closed(folder)
    assert document["status"] == "closed"
    assert document["ended"] >= document["started"]
    assert {"trips.csv", "episodes.csv"} <= document["results_sha256"].keys()
    for name, known in document["results_sha256"].items():
        assert hash_of_file(folder / name) == known


def test_results_without_a_manifest_are_refused(folder: Path) -> None:
    (folder / MANIFEST_FILE).unlink()
    with pytest.raises(ManifestError, match=r"no manifest\.json"):
        load_report(folder)


@pytest.mark.parametrize("text", ["", "{", "[]", "{}", '{"schema": 1}'])
def test_a_broken_manifest_is_refused(folder: Path, text: str) -> None:
    (folder / MANIFEST_FILE).write_text(text)
    with pytest.raises(ManifestError, match=r"manifest\.json"):
        load_report(folder)


def test_a_manifest_of_another_version_is_refused(folder: Path) -> None:
    document = json.loads((folder / MANIFEST_FILE).read_text())
    (folder / MANIFEST_FILE).write_text(json.dumps({**document, "schema": 99}))
    with pytest.raises(ManifestError, match="schema 99"):
        load_report(folder)


def test_results_that_were_changed_are_refused(folder: Path) -> None:
    with (folder / "trips.csv").open("a") as file:
        file.write("\n")
    with pytest.raises(ManifestError, match=r"trips\.csv: is not the file"):
        load_report(folder)
    (folder / "trips.csv").unlink()
    with pytest.raises(ManifestError, match=r"trips\.csv: is missing"):
        load_report(folder)


def test_a_folder_with_results_is_refused(folder: Path) -> None:
    before = {path.name: hash_of_file(path) for path in folder.iterdir()}
    with pytest.raises(ManifestError, match="name a new folder"):
        evaluate("merge", "idm", out=folder, **SMALL)
    assert {path.name: hash_of_file(path) for path in folder.iterdir()} == before


@pytest.mark.parametrize("repeats", [1, 2])
def test_a_killed_run_leaves_an_open_manifest(tmp_path: Path, repeats: int) -> None:
    out = tmp_path / "killed"
    code = (
        "import sys; from pathlib import Path; from cavmarl.evaluate import evaluate\n"
        f"evaluate('merge', 'idm', episodes=100_000, repeats={repeats}, out=Path(sys.argv[1]), "
        "progress=lambda *_: print('.', flush=True))"
    )
    with ForkedProcess(["-c", code, str(out)], stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        process.stdout.readline()  # wait for the first step
        process.send_signal(signal.SIGKILL)
    document = json.loads((out / MANIFEST_FILE).read_text())
    assert document["status"] == "open"
    assert document["ended"] is None
    with pytest.raises(ManifestError, match="open since"):
        load_report(out)


def test_runs_end_when_their_caller_dies(tmp_path: Path) -> None:
    code = (
        "import sys; from pathlib import Path; from cavmarl.evaluate import evaluate\n"
        "evaluate('merge', 'idm', episodes=100_000, repeats=2, out=Path(sys.argv[1]), "
        "progress=lambda *_: print('.', flush=True))"
    )
    command = [sys.executable, "-c", code, str(tmp_path / "killed")]
    with subprocess.Popen(command, stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        process.stdout.readline()
        children = _children(process.pid)
        process.kill()
    assert children
    deadline = time.monotonic() + 20.0
    while any(Path(f"/proc/{pid}").exists() for pid in children):
        assert time.monotonic() < deadline, "a run continues after the death of its caller"
        time.sleep(0.05)


def _children(pid: int) -> list[int]:
    listed = Path(f"/proc/{pid}/task/{pid}/children")
    if not listed.exists():
        pytest.skip("this system does not list a process's children")
    return [int(child) for child in listed.read_text().split()]
