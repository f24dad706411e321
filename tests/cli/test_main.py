"""The command line: what it shows, what it writes, how it refuses."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from cavmarl.cli import main

COMMANDS = ("evaluate", "view", "demo", "list", "map", "bench")
QUICK = ("--set", "horizon_s=1", "--agents", "2", "--background", "2")


def run(*words: str) -> int:
    """The exit code of a command."""
    with pytest.raises(SystemExit) as ended:
        main(words)
    return int(ended.value.code or 0)


def refusal(capsys: pytest.CaptureFixture[str], *words: str) -> str:
    """What a refused command says: exit code 2, and nothing of Python's own."""
    assert run(*words) == 2
    said = capsys.readouterr().err
    assert "Traceback" not in said
    return " ".join(said.split())


def test_help_names_every_command(capsys: pytest.CaptureFixture[str]) -> None:
    assert run("--help") == 0
    shown = capsys.readouterr().out
    assert all(command in shown for command in COMMANDS)


def test_help_loads_nothing_heavy() -> None:
    code = (
        "import sys; from cavmarl.cli import main\n"
        "try: main(['--help'])\n"
        "except SystemExit: print({'torch', 'pygame', 'highway_env', 'sumo'} & {*sys.modules})"
    )
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert out.stdout.strip().endswith("set()")


def test_an_unknown_command_is_wrong_use(capsys: pytest.CaptureFixture[str]) -> None:
    assert "No such command" in refusal(capsys, "evalute")


def test_list_shows_what_there_is(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    path = tmp_path / "list.json"
    assert run("list", "--json", str(path)) == 0
    shown = capsys.readouterr().out
    assert all(name in shown for name in ("merge", "town", "idm", "random_actions"))
    written = json.loads(path.read_text())
    assert {"idm", "random_actions"} <= written["drivers"].keys()
    assert {"ring", "merge", "grid4x4", "town"} <= written["environments"].keys()


def test_evaluate_shows_a_table_and_writes_json(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    path = tmp_path / "deep" / "report.json"
    words = ("evaluate", "merge", "--policy", "idm", "--episodes", "2", "--seed", "3", *QUICK)
    assert run(*words, "--json", str(path)) == 0
    shown = capsys.readouterr().out
    assert all(word in shown for word in ("success", "collision", "red light", "jerk", "delay"))
    report = json.loads(path.read_text())
    assert report["episodes"] == 2
    assert report["manifest"]["seed"] == 3


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("evaluate", "merg"), "did you mean merge"),
        (("evaluate", "merge", "--policy", "idn"), "did you mean idm"),
        (("evaluate", "merge", "--episodes", "0"), "episodes = 0: must be from 1"),
        (("evaluate", "merge", "--episodes", "many"), "valid integer"),
        (("evaluate", "merge", "--agents", "-1"), "population.agents = -1"),
        (("evaluate", "merge", "--seed", "-1"), "seed = -1"),
        (("evaluate", "merge", "--set", "lidar"), "must be KEY=VALUE"),
        (("evaluate", "merge", "--set", "sensors.lidar.ray=3"), "did you mean sensors.lidar.rays"),
        (("evaluate", "merge", "--set", "horizon_s=NaN"), "horizon_s"),
        (("evaluate",), "Missing argument"),
        (("view", "merge", "--seconds", "0", "--video", "x.mp4"), "must be above 0"),
        (("view", "merge", "--seconds", "nan", "--video", "x.mp4"), "must be above 0"),
        (("view", "merge", "--policy", "nobody", "--video", "x.mp4"), "no policy"),
        (("view", "merge", "--video", "film.gif"), "ends in .mp4"),
        (("bench", "step", "--agents", "0"), "agents = 0"),
        (("bench", "step", "--worlds", "-2"), "worlds = -2"),
        (("bench", "step", "--repeats", "x"), "valid integer"),
        (("demo", "--minutes", "0"), "--minutes must be above 0"),
        (("demo", "--seconds", "-3"), "--seconds above 0"),
        (("demo", "--minutes", "nan"), "--minutes must be above 0"),
        (("list", "--nonsense"), "No such option"),
        (("list", "more"), "unexpected extra argument"),
        (("list", "--json", "/dev/null/list.json"), "cannot be written"),
    ],
)
def test_wrong_use_is_one_line_and_exit_code_2(
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    words: tuple[str, ...],
    message: str,
) -> None:
    monkeypatch.setenv("COLUMNS", "200")
    said = refusal(capsys, *(word.replace("x.mp4", str(tmp_path / "x.mp4")) for word in words))
    assert message in said


def test_an_error_is_one_red_line(capsys: pytest.CaptureFixture[str]) -> None:
    assert run("evaluate", "nowhere") == 2
    said = capsys.readouterr()
    assert said.err.startswith("error: no environment")
    assert said.err.count("\n") == 1
    assert not said.out.strip()


def test_view_films_a_drive(tmp_path: Path) -> None:
    pytest.importorskip("imageio_ffmpeg")
    video, stats = tmp_path / "film.mp4", tmp_path / "stats.json"
    words = ("view", "merge", "--seconds", "1.5", "--video", str(video), *QUICK)
    assert run(*words, "--json", str(stats)) == 0
    assert video.stat().st_size > 1000
    assert json.loads(stats.read_text())["traffic"]["departed"] >= 1


def test_bench_compares_and_says_whether_it_held(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    pytest.importorskip("highway_env")
    path = tmp_path / "speed.json"
    words = ("bench", "step", "--agents", "2", "--worlds", "1", "--repeats", "1")
    assert run(*words, "--json", str(path), "--at-least", "1e9") == 1
    assert "highway-env" in capsys.readouterr().out
    assert json.loads(path.read_text())["ratio"] > 0.0


def test_the_demo_of_a_wheel_says_what_is_missing(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr("cavmarl.cli.demo._SCRIPT", tmp_path / "ippo_torch.py")
    assert "run it in a checkout" in refusal(capsys, "demo")
