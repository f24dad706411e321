"""Exceptions in the code of users are shown with the user's lines, without frames of cavmarl."""

from __future__ import annotations

import json
from dataclasses import asdict
from io import StringIO
from pathlib import Path

import pytest

from cavmarl.config.world_spec import WorldSpec
from cavmarl.verify import lockstep
from tests.cli.test_main import QUICK, refusal, run

pytestmark = pytest.mark.integration  # a manifest reads the commit from git


def write_policy(folder: Path, body: str) -> Path:
    """Write a policy; line 5, in `act_batch`, is `body`."""
    script = folder / "mine.py"
    script.write_text(
        "from cavmarl import Policy\n\n"
        "class Mine(Policy):\n"
        "    def act_batch(self, observations, mask):\n"
        f"        {body}\n\n"
        "def make_policy(env):\n    return Mine(env)\n"
    )
    return script


def _check_traceback(traceback: str) -> None:
    assert traceback.count('  File "') == 1
    assert 'mine.py", line 5, in act_batch' in traceback
    assert "ZeroDivisionError" in traceback


def test_an_error_of_a_policy_shows_the_lines_of_the_policy(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    script = write_policy(tmp_path, "return 1 / 0")
    words = ("evaluate", "ring", "--policy", str(script), "--episodes", "1", *QUICK)
    assert run(*words, "--out", str(tmp_path / "out")) == 1
    _check_traceback(capsys.readouterr().err)


def test_a_base_exception_of_a_policy_shows_the_lines_of_the_policy(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    script = write_policy(tmp_path, "raise BaseException('ZeroDivisionError')")
    words = ("evaluate", "ring", "--policy", str(script), "--episodes", "1", *QUICK)
    assert run(*words, "--out", str(tmp_path / "out")) == 1
    _check_traceback(capsys.readouterr().err)


def test_a_process_of_verify_determinism_shows_the_lines_of_the_policy(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    script = write_policy(tmp_path, "return 1 / 0")
    spec = WorldSpec.of("ring", agents=2, background=2)
    job = {"spec": asdict(spec), "policy": str(script), "steps": 1}
    monkeypatch.setattr("sys.stdin", StringIO(json.dumps(job) + "\n\n"))
    with pytest.raises(SystemExit) as ended:
        lockstep.main()
    assert ended.value.code == 1
    _check_traceback(capsys.readouterr().err)


def test_the_error_for_invalid_actions_names_the_driver(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    script = write_policy(tmp_path, "return observations[0]")
    words = ("evaluate", "ring", "--policy", str(script), "--episodes", "1", *QUICK)
    said = refusal(capsys, *words, "--out", str(tmp_path / "out"))
    assert "mine.py: actions have shape" in said
