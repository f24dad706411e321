"""The process of CARLA's client: each failure is a typed error, and the process always ends."""

from __future__ import annotations

import time
from pathlib import Path

import pytest

import cavmarl
from cavmarl.core.errors import ZoneSimulatorError
from cavmarl.handoff.simulators import carla_zone


def fake_python(folder: Path, command: str) -> str:
    """Write a program that replaces the Python of CARLA's client; return its path."""
    program = folder / "python"
    program.write_text(f"#!/bin/sh\n{command}\n")
    program.chmod(0o755)
    return str(program)


@pytest.mark.parametrize(
    ("command", "message"),
    [
        ("echo no licence >&2; exit 3", r"its client has ended \(exit code 3: no licence\)"),
        ("kill -9 $$", r"its client has ended \(exit code -9\)"),
        (
            """read line; echo '{"error": "ModuleNotFoundError: No module named '"'carla'"'"}'""",
            "install the package carla, or set CAVMARL_CARLA_PYTHON to a Python",
        ),
        ("read line; echo 'libcarla: hello'", "its client has sent"),
        ("exec sleep 60", r"its client has not answered in time \(timeout_s = 0.2\)"),
    ],
)
def test_a_client_that_fails_is_an_error(
    command: str, message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(carla_zone.PYTHON, fake_python(tmp_path, command))
    monkeypatch.setattr(carla_zone, "GRACE_S", 0.1)
    simulators = {1: "carla://127.0.0.1:9?timeout_s=0.2"}
    vec = cavmarl.make_vec("ring", zones=2, zone_simulators=simulators, agents=2, background=4)
    begin_s = time.monotonic()
    with pytest.raises(ZoneSimulatorError, match=rf"zone 1: carla://127\.0\.0\.1:9: .*{message}"):
        vec.reset()
    assert time.monotonic() - begin_s < 10.0
    vec.close()


def test_a_python_that_is_missing_is_an_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(carla_zone.PYTHON, str(tmp_path / "python"))
    simulators = {1: "carla://[::1]:9"}
    vec = cavmarl.make_vec("ring", zones=2, zone_simulators=simulators, agents=2, background=4)
    with pytest.raises(ZoneSimulatorError, match=r"cannot be started \(No such file"):
        vec.reset()
    vec.close()


def test_cavmarl_runs_a_zone_if_its_simulator_cannot_start(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setenv(carla_zone.PYTHON, fake_python(tmp_path, "exit 3"))
    vec = cavmarl.make_vec(
        "ring",
        zones=2,
        zone_simulators={1: "carla://127.0.0.1:9"},
        agents=2,
        background=4,
        overrides={"zones.simulator_failure": "return", "zones.check_invariants": True},
    )
    vec.reset()
    vec.step(vec.suggest_actions())
    assert "cavmarl runs the zone until the episode ends" in caplog.text
    vec.close()
