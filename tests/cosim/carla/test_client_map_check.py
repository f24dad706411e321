"""CARLA's own library reads the same roads from the exports of the bundled maps."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

from cavmarl.cli.map import app
from cavmarl.config.registry import entries, load_config, resolve_maps
from cavmarl.core.errors import MissingExtraError
from cavmarl.cosim.carla.client_map_check import check_with_client
from cavmarl.cosim.carla.client_process import ClientProgramError, run_client_program
from cavmarl.engine.world_setup import find_map
from cavmarl.handoff.simulators.carla_zone import PYTHON
from cavmarl.maps.exports.opendrive import write_opendrive
from cavmarl.roads.cache import load_network
from tests.cosim.carla.conftest import VERSION, client_python

pytest.importorskip("sumo", reason="needs the extra 'sumo'")

SEVERAL_MAPS = {"cities", "cities_sensed", "cities_test", "cities_test_left", "cities_validation"}
ENVS = sorted(set(entries()) - SEVERAL_MAPS - {"rush"})  # rush uses the map of town


@pytest.fixture
def client(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(PYTHON, client_python(VERSION))


@pytest.mark.parametrize("env", ENVS)
@pytest.mark.usefixtures("client")
def test_carlas_library_reads_the_export_of_each_map(env: str) -> None:
    path = find_map(env)
    found = check_with_client(load_network(path), path, path)
    assert found.problems == []
    assert found.points > 100
    assert found.off_m.usual < 0.3
    assert found.turned_deg.usual < 5.0
    assert found.spawn_points.found == found.spawn_points.total > 0


@pytest.mark.usefixtures("client")
def test_carlas_library_reads_the_export_of_each_city() -> None:
    """Check that the library finds all movements, junctions and lanes with lights."""
    totals = dict.fromkeys(("movements", "junctions", "lanes with lights"), 0)
    for path in resolve_maps(*load_config("cities")):
        found = check_with_client(load_network(path), path, path)
        assert found.problems == [], path.name
        for name in totals:
            share = found.shares[name]
            assert share.found == share.total, (path.name, name)
            totals[name] += share.total
    assert min(totals.values()) > 300


@pytest.mark.usefixtures("client")
def test_the_command_reads_files_and_names_missing_parts(tmp_path: Path) -> None:
    target, summary = tmp_path / "grid.xodr", tmp_path / "summary.json"
    write_opendrive(find_map("grid4x4"), target, for_carla=True)
    words = ["check", str(target), "--carla", "--json", str(summary)]
    assert CliRunner().invoke(app, words, catch_exceptions=False).exit_code == 0
    found = json.loads(summary.read_text())["carla"]
    assert found["problems"] == []
    assert found["off_m"][1] < 0.05
    assert found["landmarks"] == 64
    assert found["lanes_with_lights"] == [128, 128]

    other = target.read_text().replace('type="1000001"', 'type="1000011"')
    target.write_text(other)
    done = CliRunner().invoke(app, words, catch_exceptions=False)
    assert done.exit_code == 1
    assert "128 of 128 lanes with lights are not found" in " ".join(done.output.split())


@pytest.mark.parametrize("found", ["", "/nowhere/python", "here"])
def test_a_missing_client_is_an_error_before_the_program_runs(
    monkeypatch: pytest.MonkeyPatch, found: str, tmp_path: Path
) -> None:
    python = tmp_path / "python"
    python.write_text(
        "#!/bin/sh\necho \"ModuleNotFoundError: No module named 'carla'\" >&2\nexit 1\n"
    )
    python.chmod(0o755)
    monkeypatch.setenv(PYTHON, str(python) if found == "here" else found)
    monkeypatch.setattr("cavmarl.cosim.carla.client_process.find_spec", lambda name: None)
    with pytest.raises(MissingExtraError, match=r"carla==0\.9\.16, or set CAVMARL_CARLA_PYTHON"):
        run_client_program(tmp_path / "program.py")


def test_a_client_that_aborts_is_an_error(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    python = tmp_path / "python"
    python.write_text("#!/bin/sh\necho 'std::bad_alloc' >&2\nkill -ABRT $$\n")
    python.chmod(0o755)
    monkeypatch.setenv(PYTHON, str(python))
    with pytest.raises(ClientProgramError, match=r"ended with SIGABRT:\n  std::bad_alloc"):
        run_client_program(tmp_path / "program.py")
    python.write_text("#!/bin/sh\nexec sleep 60\n")
    with pytest.raises(ClientProgramError, match=r"took longer than 0\.5 s"):
        run_client_program(tmp_path / "program.py", timeout_s=0.5)
