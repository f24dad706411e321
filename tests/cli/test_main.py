"""The command line: its output, its files, and its errors."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from cavmarl.cli import main
from cavmarl.config.registry import programs
from cavmarl.engine.world_setup import find_map
from cavmarl.handoff import shard_setup as dividing
from cavmarl.roads.cache import load_network
from cavmarl.zones.partition.zone_file import write_zones
from cavmarl.zones.partition.zone_layouts import cut_map

COMMANDS = (
    "evaluate",
    "report",
    "suite",
    "verify",
    "journal",
    "plan",
    "lead",
    "follow",
    "view",
    "demo",
    "list",
    "map",
    "demand",
    "bench",
)
ROOT = Path(__file__).resolve().parents[2]
QUICK = (
    "--set", "horizon_s=1", "--set", "clock.ctrl_dt_s=0.1", "--agents", "2", "--background", "2",
)  # fmt: skip


def run(*words: str) -> int:
    """Return the exit code of a command."""
    with pytest.raises(SystemExit) as ended:
        main(words)
    return int(ended.value.code or 0)


def refusal(capsys: pytest.CaptureFixture[str], *words: str) -> str:
    """Return the message of a refused command, which exits with 2 and prints no traceback."""
    assert run(*words) == 2
    said = capsys.readouterr().err
    assert "Traceback" not in said
    return " ".join(said.split())


def test_help_names_every_command(capsys: pytest.CaptureFixture[str]) -> None:
    assert run("--help") == 0
    shown = capsys.readouterr().out
    assert all(command in shown for command in COMMANDS)


def test_help_imports_no_optional_package() -> None:
    code = (
        "import sys; from cavmarl.cli import main\n"
        "try: main(['--help'])\n"
        "except SystemExit: print({'torch', 'pygame', 'highway_env', 'sumo'} & {*sys.modules})"
    )
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert out.stdout.strip().endswith("set()")


def test_an_unknown_command_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert "No such command" in refusal(capsys, "evalute")


def test_list_shows_all_entries(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
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
    path, out = tmp_path / "report.json", tmp_path / "results"
    words = ("evaluate", "merge", "--policy", "idm", "--episodes", "2", "--seed", "3", *QUICK)
    assert run(*words, "--json", str(path), "--out", str(out)) == 0
    shown = capsys.readouterr().out
    assert all(word in shown for word in ("success", "collision", "red light", "jerk", "speed"))
    assert "no interval of means" in shown
    report = json.loads(path.read_text())
    (rate,) = report["policies"]["idm"]["metrics"]["off_road"]["within_run"]
    ends = f"{100.0 * rate['wilson95']['low']:.1f}, {100.0 * rate['wilson95']['high']:.1f}"
    assert f"[{ends}]" in shown
    assert report["episodes"] == 2
    assert report["manifest"]["seeds"] == [3]
    assert run("report", str(out)) == 0
    assert capsys.readouterr().out.strip() == shown.strip()


def test_evaluate_compares_drivers_in_repeated_runs_and_writes_a_page(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    pytest.importorskip("matplotlib")
    out, page = tmp_path / "results", tmp_path / "page.html"
    words = ("evaluate", "merge", "-p", "idm", "-p", "random_actions", "-n", "1", *QUICK)
    assert run(*words, "--repeats", "2", "--out", str(out), "--html", str(page)) == 0
    shown = " ".join(capsys.readouterr().out.split())
    assert "2 runs of 1 episodes" in shown
    assert "95 % interval between runs (± or two limits), (SD within a run)" in shown
    assert "minus idm, paired by seed" in shown
    assert "<svg" in page.read_text(encoding="utf-8")


def test_evaluate_keeps_its_results_in_a_new_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    for _ in range(2):
        assert run("evaluate", "merge", "-n", "1", *QUICK) == 0
    folders = list((tmp_path / "runs" / "evaluate").iterdir())
    assert len(folders) == 2
    assert all((folder / "manifest.json").is_file() for folder in folders)


def test_a_refused_evaluation_leaves_no_folder(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    refusal(capsys, "evaluate", "merge", "--policy", "nobody")
    assert not list(tmp_path.iterdir())


def test_verify_reports_equality_for_each_number_of_zones(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    path = tmp_path / "found.json"
    words = ("verify", "zones", "merge", "--zones", "1,4", "--steps", "5", "--worlds", "2", *QUICK)
    assert run(*words, "--layout", "strips", "--json", str(path)) == 0
    found = json.loads(path.read_text())
    assert found["holds"]
    assert [(row["zones"], row["steps"]) for row in found["results"]] == [(1, 5), (4, 5)]
    shown = capsys.readouterr().out
    assert shown.count("equal") == 2
    assert found["state_hashes"][1] in shown


def test_verify_takes_the_zones_of_a_file(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    network = load_network(find_map("merge"))
    write_zones(tmp_path / "mine.json", cut_map(network, "strips", 3))
    words = ("verify", "zones", "merge", "--steps", "2", "--layout", "mine.json", *QUICK)
    assert run(*words, "--json", "found.json") == 0
    (row,) = json.loads((tmp_path / "found.json").read_text())["results"]
    assert row["zones"] == 3
    assert "has 3 zones; use 3" in refusal(capsys, *words, "--zones", "4")


def test_verify_fails_and_names_the_first_difference_of_the_divided_world(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(dividing, "halo_m", lambda *_: 1.0)
    path = tmp_path / "found.json"
    words = ("verify", "zones", "grid4x4", "--zones", "1,4", "--steps", "40", "--json", str(path))
    assert run(*words) == 1
    whole, divided = json.loads(path.read_text())["results"]
    assert whole["difference"] is None
    difference = divided["difference"]
    said = " ".join(capsys.readouterr().out.split())
    assert f"4 zones: different: step {difference['step']} (tick {difference['tick']})" in said
    assert f"{difference['values'][0]} undivided, {difference['values'][1]} divided" in said


def test_verify_determinism_reports_equality_and_the_hash(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    path = tmp_path / "found.json"
    words = ("verify", "determinism", "merge", "--steps", "3", *QUICK)
    assert run(*words, "--json", str(path)) == 0
    found = json.loads(path.read_text())
    assert found["difference"] is None
    shown = capsys.readouterr().out
    assert "equal: 3 steps in 3 processes" in shown
    assert found["state_hash"] in shown


def test_verify_determinism_fails_and_names_the_first_difference(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    script = tmp_path / "hashing.py"
    script.write_text(
        "from cavmarl.policies.policy import Policy\n"
        "class Hashing(Policy):\n"
        "    def act_batch(self, observations, mask):\n"
        "        return self.env.suggest_actions() * 0.0 + hash('a') % 997 / 1000.0\n"
        "def make_policy(env):\n"
        "    return Hashing(env)\n"
    )
    words = ("verify", "determinism", "merge", "--policy", str(script), "--steps", "3", *QUICK)
    assert run(*words) == 1
    assert "different: step 1 (tick 2), vehicle 0, s: " in capsys.readouterr().out


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("evaluate", "merg"), "did you mean merge"),
        (("evaluate", "merge", "--policy", "idn"), "did you mean idm"),
        (("evaluate", "merge", "--episodes", "0"), "episodes = 0: must be from 1"),
        (("evaluate", "merge", "--episodes", "many"), "valid integer"),
        (("evaluate", "merge", "--repeats", "0"), "repeats = 0: must be from 1"),
        (("evaluate", "merge", "-p", "idm", "-p", "idm"), "one is listed twice"),
        (
            ("evaluate", "merge", "--html", "/dev/null/x.html"),
            "/dev/null/x.html: cannot be written",
        ),
        (("evaluate", "merge", "--out", "/dev/null/x", *QUICK), "/dev/null/x: cannot be created"),
        (("suite", "nothing"), "no suite or file 'nothing'"),
        (
            ("suite", "standard", "--maps", "no-folder"),
            "is no environment and no file in no-folder",
        ),
        (("report", "no-folder"), "no-folder: has no manifest.json"),
        (("verify", "determinism", "merge", "--steps", "0"), "steps = 0: must be"),
        (("verify", "determinism", "merg"), "did you mean merge"),
        (("verify", "zones", "merge", "--steps", "0"), "steps = 0: must be"),
        (
            ("verify", "zones", "merge", "--zones", "1,x"),
            "--zones 1,x: must be comma-separated",
        ),
        (("verify", "zones", "merge", "--zones", "0"), "zones = 0: must be whole numbers from 1"),
        (("verify", "zones", "merge", "--layout", "hexagons"), "zones.layout"),
        (("verify", "zones", "merge", "--layout", "none.json"), "none.json"),
        (
            ("verify", "zones", "merge", "--layout", "grid", "--set", "zones.layout=strips"),
            "zones.layout is set both by overrides and by layout",
        ),
        (("evaluate", "merge", "--agents", "-1"), "population.agents = -1"),
        (("evaluate", "merge", "--seed", "-1"), "seed = -1"),
        (("evaluate", "merge", "--set", "lidar"), "must be KEY=VALUE"),
        (("evaluate", "merge", "--set", "sensors.lidar.ray=3"), "did you mean sensors.lidar.rays"),
        (("evaluate", "merge", "--set", "horizon_s=NaN"), "horizon_s"),
        (("evaluate", "merge", "--set", "name="), "--set name=: the value is missing"),
        (("evaluate", "merge", "--set", 'name=""'), "--set name=: the value is missing"),
        (("evaluate", "merge", "--set", "nonsense=1"), "nonsense: unknown key"),
        (("evaluate",), "Missing argument"),
        (("view", "merge", "--seconds", "0", "--video", "x.mp4"), "must be above 0"),
        (("view", "merge", "--seconds", "nan", "--video", "x.mp4"), "must be above 0"),
        (("view", "merge", "--policy", "nobody", "--video", "x.mp4"), "no policy"),
        (("view", "merge", "--video", "film.gif"), "must end in .mp4"),
        (("bench", "step", "--agents", "0"), "agents = 0"),
        (("bench", "step", "--worlds", "-2"), "worlds = -2"),
        (("bench", "step", "--repeats", "x"), "valid integer"),
        (("bench", "step", "--at-least", "nan"), "--at-least nan: must be"),
        (("bench", "step", "--repeats", "0"), "repeats = 0: must be from 1 to 100"),
        (("bench", "step", "--at-least", "inf"), "--at-least inf: must be"),
        (("bench", "step", "--at-least", "0"), "--at-least 0: must be"),
        (("bench", "step", "--at-least", "-1"), "--at-least -1: must be"),
        (("bench", "traffic", "some.net.xml"), "no demand: give --demand FILE"),
        (("demo", "--decisions", "0"), "--decisions must be from 1"),
        (("demo", "--seconds", "-3"), "--seconds above 0"),
        (("demo", "--seconds", "nan"), "--seconds above 0"),
        (("demo", "--seed", "-1"), "seed = -1: must be"),
        (("demo", "--out", "/dev/null/demo"), "/dev/null/demo: cannot be written"),
        (("list", "--nonsense"), "No such option"),
        (("list", "more"), "unexpected extra argument"),
        (("list", "--json", "/dev/null/list.json"), "cannot be written"),
    ],
)
def test_wrong_use_prints_one_line_and_exits_with_2(
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    words: tuple[str, ...],
    message: str,
) -> None:
    monkeypatch.setenv("COLUMNS", "200")
    said = refusal(capsys, *(word.replace("x.mp4", str(tmp_path / "x.mp4")) for word in words))
    assert message in said


@pytest.mark.parametrize("command", COMMANDS)
def test_an_unwritable_json_path_is_refused_before_any_work(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, command: str
) -> None:
    network = tmp_path / "broken.net.xml"
    network.write_text("no map")
    words = {
        "evaluate": ("evaluate", "nowhere"),
        "report": ("report", "nowhere"),
        "suite": ("suite", "nowhere"),
        "verify": ("verify", "zones", "nowhere"),
        "view": ("view", "nowhere"),
        "map": ("map", "check", str(network)),
        "bench": ("bench", "step", "--agents", "0"),
        "demand": ("demand", "random", "nowhere", "--out", "x.rou.xml"),
    }.get(command, (command,))
    missing = tmp_path / "missing" / "x.json"
    assert "there is no folder" in refusal(capsys, *words, "--json", str(missing))
    assert not missing.parent.exists()
    assert "Is a directory" in refusal(capsys, *words, "--json", str(tmp_path))


@pytest.mark.parametrize(
    ("words", "option"),
    [
        (("evaluate", "nowhere"), "--html"),
        (("bench", "traffic", "nowhere", "--demand", "x.rou.xml"), "--plot"),
        (("map", "zones", "nowhere"), "--out"),
        (("scenario", "run", "nowhere"), "--picture"),
    ],
)
def test_other_unwritable_files_are_refused_before_any_work(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, words: tuple[str, ...], option: str
) -> None:
    missing = tmp_path / "missing" / "x.png"
    assert f"{option} {missing}: cannot be written" in refusal(capsys, *words, option, str(missing))


def test_checking_a_json_path_creates_no_file(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    new, old = tmp_path / "new.json", tmp_path / "old.json"
    old.write_text("{}")
    for path in (new, old):
        assert "no environment" in refusal(capsys, "evaluate", "nowhere", "--json", str(path))
    assert not new.exists()
    assert old.read_text() == "{}"


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere a window always has a display")
def test_a_window_without_a_display_is_refused(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("DISPLAY", "WAYLAND_DISPLAY", "SDL_VIDEODRIVER"):
        monkeypatch.delenv(name, raising=False)
    assert "use --video FILE" in refusal(capsys, "view", "ring", "--seconds", "0.1")


def test_a_window_opens_with_the_dummy_video_driver_of_sdl(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("pygame")
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    assert run("view", "merge", "--seconds", "0.1", *QUICK) == 0


def test_the_error_for_a_folder_without_a_driver_names_the_missing_file(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    said = refusal(capsys, "evaluate", "merge", "--policy", str(tmp_path), *QUICK)
    assert f"no model.safetensors in {tmp_path}" in said
    assert "Errno" not in said


def test_the_package_runs_as_a_program() -> None:
    command = [sys.executable, "-m", "cavmarl", "list"]
    out = subprocess.run(command, capture_output=True, text=True, check=True)
    assert "merge" in out.stdout


def test_an_error_is_printed_as_one_red_line(capsys: pytest.CaptureFixture[str]) -> None:
    assert run("evaluate", "nowhere") == 2
    said = capsys.readouterr()
    assert said.err.startswith("error: no environment")
    assert said.err.count("\n") == 1
    assert not said.out.strip()


def test_view_writes_a_video(tmp_path: Path) -> None:
    pytest.importorskip("imageio_ffmpeg")
    video, stats = tmp_path / "film.mp4", tmp_path / "stats.json"
    words = ("view", "merge", "--seconds", "1.5", "--video", str(video), *QUICK)
    assert run(*words, "--json", str(stats)) == 0
    assert video.stat().st_size > 1000
    assert json.loads(stats.read_text())["traffic"]["departed"] >= 1


def test_bench_compares_speeds_and_fails_below_the_required_ratio(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    pytest.importorskip("highway_env")
    path = tmp_path / "speed.json"
    words = ("bench", "step", "--agents", "2", "--worlds", "1", "--repeats", "1")
    assert run(*words, "--json", str(path), "--at-least", "1e9") == 1
    assert "highway-env" in capsys.readouterr().out
    assert json.loads(path.read_text())["ratio"] > 0.0


def test_train_lists_its_programs(capsys: pytest.CaptureFixture[str]) -> None:
    assert run("train") == 0
    shown = capsys.readouterr().out
    assert set(programs()) == {path.stem for path in (ROOT / "train").glob("*.py")}
    for name in programs():
        assert name in shown
    assert "ppo" in refusal(capsys, "train", "ippo")
    assert "merge" in refusal(capsys, "train", "ppo", "--config", "nowhere")


@pytest.mark.parametrize("config", [["--config", "demo"], ["--config=demo"]])
def test_train_runs_a_program_with_its_own_options(
    config: list[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """A file of the same name in the working directory is not run."""
    ran: list[str] = []
    monkeypatch.setattr("os.execv", lambda _, words: ran.extend(words))
    (tmp_path / "train").mkdir()
    (tmp_path / "train" / "ppo_sb3.py").touch()
    monkeypatch.chdir(tmp_path)
    assert run("train", "ppo_sb3", "--seed", "3", "--help", *config) == 0
    settings = str(ROOT / "configs" / "train" / "demo.yaml")
    wanted = [config[0], settings] if len(config) == 2 else [f"--config={settings}"]
    assert ran[1:] == [str(ROOT / "train" / "ppo_sb3.py"), "--seed", "3", "--help", *wanted]
