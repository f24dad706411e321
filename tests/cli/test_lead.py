"""`cavmarl lead`: faults of followers, traces, recordings, and refused options."""

from __future__ import annotations

import json
import os
import stat
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from cavmarl.cli import main
from cavmarl.cosim.followers.follower_client import Follower
from cavmarl.cosim.followers.follower_messages import Control, Say

STEPS = 6


def follow_with(address: str, controls: Any, name: str = "bad") -> None:
    with Follower(address, ["car_0"], name) as follower:
        for sight in follower:
            if not sight.snapshot.is_over:
                follower.answer(controls)


def disconnect(address: str) -> None:
    Follower(address, ["car_0"]).__dict__["_line"].close()


def send_nothing(address: str) -> None:
    with Follower(address, ["car_0"]):
        time.sleep(2.0)


def answer_a_future_frame(address: str) -> None:
    with Follower(address, ["car_0"]) as follower:
        follower.wait()
        follower.__dict__["_line"].say(Say.CONTROL, Control(99, {}))
        time.sleep(1.0)


def send_other_bytes(address: str) -> None:
    """Join, and then send bytes that are not a frame."""
    with Follower(address, ["car_0"]) as follower:
        os.write(follower.__dict__["_line"].fileno(), b"\x00" * 64)
        time.sleep(1.0)


FAULTS: dict[str, Callable[[str], None]] = {
    "not a number": lambda address: follow_with(address, {"car_0": [float("nan"), 0.0]}),
    "out of range": lambda address: follow_with(address, {"car_0": [7.0, 0.0]}),
    "another agent": lambda address: follow_with(address, {"car_9": [0.0, 0.0]}),
    "a name with markup": lambda address: follow_with(address, {"car_0": [2.0, 0.0]}, "[/x]"),
    "disconnected": disconnect,
    "silent": send_nothing,
    "a future frame": answer_a_future_frame,
    "no frame": send_other_bytes,
}


def lead_with(address: Path, fault: Callable[[str], None], *words: str) -> int:
    def follow() -> None:
        while True:
            try:
                return fault(str(address))
            except Exception as error:  # the world does not listen yet, or refused the follower
                if "does not answer (" not in str(error):
                    return None
            time.sleep(0.01)

    caller = threading.Thread(target=follow)
    caller.start()
    try:
        main(["lead", "ring", "--at", str(address), "--timeout-s", "1", "--steps", str(STEPS),
              "--agents", "2", "--background", "2", *words])  # fmt: skip
    except SystemExit as end:
        return int(end.code or 0)
    finally:
        caller.join(20.0)
    return 0


@pytest.mark.parametrize("fault", FAULTS.values(), ids=FAULTS)
def test_a_fault_of_a_follower_ends_only_that_follower(
    tmp_path: Path, fault: Callable[[str], None], capsys: pytest.CaptureFixture[str]
) -> None:
    found = tmp_path / "found.json"
    assert lead_with(tmp_path / "s", fault, "--json", str(found)) == 0
    result = json.loads(found.read_text())
    assert result["steps"] == STEPS
    assert len(result["lost"]) == 1
    assert "built-in driver" in capsys.readouterr().err


def test_a_fault_of_a_follower_can_end_the_run(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert lead_with(tmp_path / "s", FAULTS["disconnected"], "--on-lost", "end") == 2
    assert "error" in capsys.readouterr().err


def test_a_name_with_markup_is_shown_unchanged(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    fault = lambda address: follow_with(address, {"car_0": [0.1, 0.0]}, "[/x]")  # noqa: E731
    assert lead_with(tmp_path / "s", fault, "--json", str(tmp_path / "found.json")) == 0
    assert "[/x]" in capsys.readouterr().out
    assert json.loads((tmp_path / "found.json").read_text())["lost"] == []


def test_a_port_without_a_file_for_the_secret_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["lead", "ring", "--at", "0", "--followers", "0", "--steps", "1"]
    with pytest.raises(SystemExit):
        main(words)
    assert "--secret-file" in capsys.readouterr().err
    file = tmp_path / "secret"
    with pytest.raises(SystemExit) as end:
        main([*words, "--secret-file", str(file)])
    assert not end.value.code
    assert stat.S_IMODE(file.stat().st_mode) == 0o600
    assert len(file.read_text().strip()) == 64
    file.write_text("")
    with pytest.raises(SystemExit):
        main([*words, "--secret-file", str(file)])
    assert "is empty" in capsys.readouterr().err


def exit_code(words: list[str]) -> int:
    with pytest.raises(SystemExit) as ended:
        main(words)
    return int(ended.value.code or 0)


@pytest.mark.integration
def test_a_run_with_a_trace_and_a_deadline_is_recorded(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    trace = tmp_path / "van.csv"
    rows = [f"{0.02 * k:.2f},{-60 + 0.2 * k:.3f},-80,0" for k in range(50) if k not in (20, 21)]
    trace.write_text("\n".join(["time_s,x,y,heading", *rows]), encoding="utf-8")
    settings = ["--set", "population.external=2", "--set", "clock.ctrl_dt_s=0.05"]
    world = ["ring", *settings, "--agents", "2", "--background", "2"]
    report = tmp_path / "report.json"
    code = exit_code([
        "lead", *world, "--at", str(tmp_path / "s"), "--followers", "0", "--steps", "30",
        "--trace", str(trace), "--pace", "20", "--deadline", "5", "--json", str(report),
        "--record", str(tmp_path / "run"), "--record-also", "commands",
    ])  # fmt: skip
    assert code == 0
    shown = capsys.readouterr().out
    assert "trace: van" in shown
    assert "deadline of 5000 ms missed in 0 of 30 steps" in shown
    found = json.loads(report.read_text())
    (actor,) = found["actors"]
    assert (actor["received"], actor["late"], actor["lost"]) == (48, 0, 2)
    assert (found["deadline"]["missed"], found["deadline"]["steps"]) == (0, 30)
    words = ["verify", "recording", *world, "--recording", str(tmp_path / "run")]
    assert exit_code(words) == 0
    assert f"equal: 30 steps in 1 episodes; state {found['state_hash']}" in capsys.readouterr().out


def test_a_deadline_without_a_pace_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert exit_code(["lead", "ring", "--deadline", "0.1"]) == 2
    assert "--deadline 0.1: goes with --pace" in capsys.readouterr().err


def test_the_recording_is_closed_after_a_wrong_pace(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = tmp_path / "run"
    assert exit_code(["lead", "ring", "--pace", "0", "--record", str(run)]) == 2
    assert "pacing by 0.0: must be a number above 0" in capsys.readouterr().err
    assert json.loads((run / "recording.json").read_text())["status"] == "closed"
