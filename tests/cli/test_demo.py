"""`cavmarl demo`: its output, its files, its page, and missing packages."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from cavmarl.cli import demo, main
from cavmarl.config.io import read_yaml
from cavmarl.config.registry import find_settings

ROOT = Path(__file__).resolve().parents[2]
TRAINED = ROOT / "agents" / "merge_careful_ippo"
RUN = subprocess.run
# Packages of other extras, which the demo does not need.
UNNEEDED = (
    "libsumo",
    "sumo",
    "tensorboard",
    "stable_baselines3",
    "imageio",
    "imageio_ffmpeg",
    "pyarrow",
)
ROW = "{updates},{decisions},1000,0.9{updates},0.0{updates}\n"


def run(*words: str) -> int:
    """Return the exit code of a command."""
    with pytest.raises(SystemExit) as ended:
        main(words)
    return int(ended.value.code or 0)


def run_without_training(command: list[str], **options: Any) -> subprocess.CompletedProcess[Any]:
    """Run a program; in place of the training program, copy a trained driver to its output."""
    if Path(command[1]).name != "ppo.py":
        return RUN(command, **options)
    words = dict(zip(command[2::2], command[3::2], strict=True))
    run_folder = Path(words["--runs"], words["--name"])
    shutil.copytree(TRAINED, run_folder, ignore=shutil.ignore_patterns("result"))
    rows = [ROW.format(updates=k, decisions=1000 * k) for k in (1, 2, 3)]
    head = "updates,agent_steps,agent_steps_per_s,success,collision\n"
    (run_folder / "progress.csv").write_text(head + "".join(rows), "utf-8")
    return subprocess.CompletedProcess(command, 0)


@pytest.fixture(scope="module")
def finished_demo(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any], str]:
    """Return the folder, the JSON file and the output of a demo with one episode per driver."""
    pytest.importorskip("matplotlib")
    pytest.importorskip("pygame")
    folder = tmp_path_factory.mktemp("demo")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(subprocess, "run", run_without_training)
        for module in UNNEEDED:
            patch.setitem(sys.modules, module, None)
        patch.setattr(demo, "EPISODES", 1)
        patch.setattr("rich.console.Console.print", printed := Printed())
        words = ["demo", "--seconds", "1", "--out", str(folder), "--json", str(folder / "x.json")]
        assert run(*words, "--decisions", "300000") == 0
    return folder, json.loads((folder / "x.json").read_text("utf-8")), printed.text


class Printed:
    """A replacement of `Console.print` that stores the text."""

    def __init__(self) -> None:
        self.text = ""

    def __call__(self, *parts: object, **_: object) -> None:
        self.text += " ".join(map(str, parts)) + "\n"


def test_the_demo_estimates_its_duration_before_it_trains(
    finished_demo: tuple[Path, dict[str, Any], str],
) -> None:
    _, document, text = finished_demo
    assert document["decisions_per_s"] == 1000.0
    estimate, training = text.index("training takes about 5 min"), text.index("2. train")
    assert estimate < training
    assert "300,000 decisions" in text[training:]


def test_the_demo_compares_four_drivers_in_the_same_episodes(
    finished_demo: tuple[Path, dict[str, Any], str],
) -> None:
    folder, document, _ = finished_demo
    assert list(document["report"]["policies"]) == [
        "adapted", "cities_ippo", "idm", "random_actions",
    ]  # fmt: skip
    assert (next(folder.glob("evaluation-*")) / "failures.html").is_file()


def test_the_page_contains_pictures_plots_tables_and_commands(
    finished_demo: tuple[Path, dict[str, Any], str],
) -> None:
    folder, document, _ = finished_demo
    page = (folder / "demo.html").read_text("utf-8")
    assert page.count('src="data:image/webp;base64,') == 2
    assert 'id="plot-learning"' in page
    assert 'id="compared"' in page
    assert "300,000 decisions" in page
    assert f"cavmarl view merge --policy {document['driver']} --web" in page
    assert page.index('id="compared"') < page.index('id="results"')


def test_the_error_of_the_demo_names_all_missing_packages(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    monkeypatch.setattr("cavmarl.core.errors.find_spec", lambda _: None)
    assert run("demo", "--out", str(tmp_path)) == 2
    said = " ".join(capsys.readouterr().err.split())
    names = " and ".join(f"'{name}'" for name in demo.NEEDED)
    assert f"{names} are not installed: pip install" in said
    assert "[demo]'" in said


@pytest.mark.parametrize(
    ("success", "delay", "words"),
    [
        ((0.97, 0.95), (10.0, 12.0), "better in success and delay"),
        ((0.94, 0.95), (10.0, 12.0), "better in delay"),
        ((0.97, 0.95), (13.0, 12.0), "better in success;"),
        ((0.94, 0.95), (12.0, 12.0), "better in neither"),
        ((0.94, 0.95), (None, 12.0), "cannot be compared"),
    ],
)
def test_the_comparison_says_in_which_measures_the_adapted_driver_is_better(
    success: tuple[float, float], delay: tuple[float | None, float], words: str
) -> None:
    found: Any = {
        name: {
            "success": SimpleNamespace(mean=success[k]),
            "delay_s": SimpleNamespace(mean=delay[k]),
            "collision": SimpleNamespace(mean=0.01 * k),
        }
        for k, name in enumerate(("adapted", "idm"))
    }
    assert words in demo.compared(found)


def test_the_map_and_the_initial_driver_of_the_demo_exist() -> None:
    settings: Any = read_yaml(find_settings("train", "demo"))
    assert (ROOT / "envs" / settings["env"] / "map" / "map.net.xml").is_file()
    assert (ROOT / "agents" / settings["start"] / "model.safetensors").is_file()


@pytest.mark.slow
def test_the_demo_trains_a_driver(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(demo, "EPISODES", 1)
    monkeypatch.setattr(demo, "MEASURED", 20_000)
    document = tmp_path / "demo.json"
    words = ["--decisions", "20000", "--seconds", "1", "--json", str(document)]
    assert run("demo", "--out", str(tmp_path / "demo"), *words) == 0
    assert json.loads(document.read_text("utf-8"))["decisions_per_s"] > 0.0
