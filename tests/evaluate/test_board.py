"""The board shows verified entries, and marks each failed entry with the reason."""

from __future__ import annotations

import hashlib
import json
import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from cavmarl.cli import main
from cavmarl.config.registry import agent_entries
from cavmarl.core.errors import CavmarlError, ConfigError, ManifestError, PolicyError
from cavmarl.evaluate import evaluate
from cavmarl.evaluate.board import build_board, check_entry, entries_in, entry_driver
from cavmarl.evaluate.evaluation import run_seeds
from cavmarl.policies.onnx_export import export_onnx

pytestmark = pytest.mark.integration  # a manifest reads the commit from git

ROOT = Path(__file__).resolve().parents[2]
SMALL: dict[str, Any] = {"episodes": 2, "agents": 2, "background": 2, "max_cycles": 30, "seed": 3}
SCRIPT = '''"""Brakes always."""
import numpy as np
from cavmarl import Policy


class Brake(Policy):
    def act_batch(self, observations, mask):
        return np.full((*mask.shape, 2), -0.5, dtype=np.float32)


def make_policy(env):
    return Brake(env)
'''


@pytest.fixture
def entry(tmp_path: Path) -> Path:
    return Path(shutil.copytree(agent_entries()["merge_ippo"], tmp_path / "entries/merge_ippo"))


def script_entry(folder: Path, script: str = SCRIPT, name: str = "brake") -> Path:
    own = folder / name
    own.mkdir(parents=True)
    (own / f"{name}.py").write_text(script)
    (own / "README.md").write_text(f"# {name}\n\nBrakes <b>always</b>.\n")
    evaluate("merge", {name: str(own / f"{name}.py")}, out=own / "result", **SMALL)
    return own


def change_manifest(entry: Path, **keys: Any) -> None:
    path = entry / "result" / "manifest.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | keys))


def flip_byte(path: Path) -> None:
    content = bytearray(path.read_bytes())
    content[-2] ^= 1
    path.write_bytes(content)


ENTRIES = {path.name: path for path in entries_in([ROOT / "board"])}


@pytest.mark.parametrize("name", ENTRIES)
def test_an_entry_of_the_board_is_verified(name: str) -> None:
    """This test omits the entries of `agents/`, which the tests of the zoo verify."""
    path = ENTRIES[name]
    is_script = name in agent_entries()
    assert entry_driver(path) == (agent_entries()[name] if is_script else path)
    found = check_entry(path)
    assert found.expected
    assert not found.differing


def test_a_model_of_another_library_is_shown_as_not_verified(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("onnxruntime", reason="needs the extra: onnx")
    own = tmp_path / "entries" / "sailor"
    own.mkdir(parents=True)
    model = own / "sailor.onnx"
    export_onnx("merge_ippo", model)
    (own / "README.md").write_text("# sailor\n\nA model of another library.\n")
    evaluate("merge", {"sailor": str(model)}, out=own / "result", **SMALL)
    assert entry_driver(own) == model
    assert not check_entry(own).expected
    with pytest.raises(SystemExit) as ended:
        main(["board", "check", str(own)])
    assert ended.value.code == 0
    assert "it is shown as not verified" in " ".join(capsys.readouterr().out.split())
    out = tmp_path / "board.html"
    (found,) = build_board([own], out)
    assert (found.kind, found.state, found.failure) == ("model", "not verified", "")
    page = out.read_text()
    assert "0 of 1 entries are verified" in page
    assert "<td>not verified</td>" in page
    flip_byte(model)
    (found,) = build_board([own], out)
    assert "is not the file that the result of sailor was made with" in found.failure
    assert found.state == "failed"


def test_the_folder_of_agents_has_an_entry_for_each_trained_driver() -> None:
    names = [path.name for path in entries_in([agent_entries()["merge_ippo"].parent])]
    assert names == sorted(name for name, path in agent_entries().items() if path.is_dir())


Spoil = Callable[[Path], None]
SPOILT: dict[str, tuple[Spoil, type[CavmarlError], str]] = {
    "weights": (
        lambda entry: flip_byte(entry / "model.safetensors"),
        ManifestError,
        r"model\.safetensors: is not the file that .*manifest\.json names; copy both",
    ),
    "settings": (
        lambda entry: flip_byte(entry / "config.json"),
        ManifestError,
        r"config\.json: is not the file that the result of merge_ippo was made with; restore it",
    ),
    "trips": (
        lambda entry: flip_byte(entry / "result" / "trips.csv"),
        ManifestError,
        r"trips\.csv: is not the file that .* was closed with; restore it",
    ),
    "metrics": (
        lambda entry: change_manifest(entry, metrics_version=1),
        ManifestError,
        "has metrics of version 1, .*: evaluate again",
    ),
    "job": (
        lambda entry: change_manifest(entry, job={}),
        ManifestError,
        "does not say what was driven; make the result again",
    ),
    "unlisted tables": (
        lambda entry: change_manifest(entry, results_sha256={}),
        ManifestError,
        r"has no hash of trips\.csv, so the table may be of another run; evaluate again",
    ),
    "episodes": (
        lambda entry: change_manifest(entry, episodes=1_000_000),
        ManifestError,
        "shows episodes or seeds that were not driven; evaluate the driver again",
    ),
    "seeds": (
        lambda entry: change_manifest(entry, seeds=[7]),
        ManifestError,
        "shows episodes or seeds that were not",
    ),
    "files of the driver": (
        lambda entry: change_manifest(entry, policies={"merge_ippo": []}),
        ManifestError,
        "is not the file that the result of merge_ippo was made with",
    ),
    "world": (
        lambda entry: change_manifest(
            entry, world={"environment": "merge-v6", "config": {"sensors": {"ego": 1}}}
        ),
        ManifestError,
        "the manifest of its result describes no world",
    ),
    "drivers": (
        lambda entry: change_manifest(entry, policies={"a": {}, "b": {}}),
        ManifestError,
        "has 2 drivers; evaluate this driver alone",
    ),
    "card": (
        lambda entry: (entry / "README.md").unlink(),
        ConfigError,
        r"has no README\.md; write a card",
    ),
    "result": (
        lambda entry: shutil.rmtree(entry / "result"),
        ManifestError,
        "the origin of these results is unknown; make them with",
    ),
    "training": (
        lambda entry: (entry / "manifest.json").unlink(),
        ManifestError,
        "does not name the trained weights .*; copy the manifest of the training run",
    ),
    "driver": (
        lambda entry: (entry / "model.safetensors").unlink(),
        PolicyError,
        r"has no driver; put model\.safetensors and config\.json, a script merge_ippo\.py or",
    ),
}


@pytest.mark.parametrize("spoilt", SPOILT)
def test_a_damaged_entry_is_refused_and_marked_as_failed(
    spoilt: str, entry: Path, tmp_path: Path
) -> None:
    spoil, kind, message = SPOILT[spoilt]
    spoil(entry)
    with pytest.raises(kind, match=message):
        check_entry(entry)
    out = tmp_path / "board.html"
    (found,) = build_board(entries_in([entry.parent]), out)
    assert re.search(message, found.failure)
    page = out.read_text()
    assert "0 of 1 entries are verified" in page
    assert page.count("✗ failed") == 1
    assert "✓ verified" not in page


def test_results_that_differ_from_a_repeated_evaluation_are_refused(entry: Path) -> None:
    path = entry / "result" / "manifest.json"
    document = json.loads(path.read_text())
    job = document["job"] | {"episodes": 1, "seed": 3}
    seeds = run_seeds(3, len(document["seeds"]))
    change_manifest(entry, job=job, episodes=1, seeds=seeds)
    with pytest.raises(
        ManifestError, match=r"trips\.csv, .* of the evaluation repeated on .* differ from"
    ):
        check_entry(entry)


def test_a_board_shows_verified_and_failed_entries(entry: Path, tmp_path: Path) -> None:
    folder = entry.parent
    script_entry(folder)
    clock = SCRIPT.replace("-0.5,", "-0.5 * (time.time_ns() % 1000 / 1000.0),")
    script_entry(folder, f"import time\n{clock}", "clock")
    bad = script_entry(folder, name="bad")
    raising = SCRIPT.replace(
        "        return np", "        raise KeyError('gone')\n        return np"
    )
    (bad / "bad.py").write_text(raising)
    digest = hashlib.sha256(raising.encode()).hexdigest()
    policies = {"bad": {"given": "bad", "sha256": {"bad.py": digest}}}
    change_manifest(bad, policies=policies)
    out = tmp_path / "board.html"
    found = {one.name: one for one in build_board(entries_in([folder]), out)}
    failures = {name: one.failure for name, one in found.items() if one.failure}
    assert sorted(failures) == ["bad", "clock"]
    assert "of the evaluation repeated on" in failures["clock"]
    assert "KeyError" in failures["bad"]
    assert failures["bad"].endswith("; correct the script")
    assert found["brake"].kind == "scripted"
    assert found["brake"].conditions == "agents 2, background 2, max_cycles 30"
    assert found["merge_ippo"].conditions == ""
    assert found["merge_ippo"].shares is not None
    assert 0.5 < found["merge_ippo"].shares["success"].value <= 1.0
    page = out.read_text()
    assert "2 of 4 entries are verified" in page
    assert "Brakes &lt;b&gt;always&lt;/b&gt;." in page  # cards are text, not HTML
    assert "<script" not in page
    assert not re.findall(r"(?:src|href)=", page)
    assert page.index("<b>brake</b>") < page.index("<b>bad</b>")  # verified entries come first


def test_wrong_folders_and_names_are_refused(entry: Path, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="is not a folder; give folders that contain entries"):
        entries_in([tmp_path / "nowhere"])
    (tmp_path / "empty").mkdir()
    with pytest.raises(ConfigError, match="contains no entries; an entry is a folder with"):
        entries_in([tmp_path / "empty"])
    with pytest.raises(ConfigError, match="--entry merge: there is no such entry; there are merge"):
        entries_in([entry.parent], ["merge"])
    with pytest.raises(ConfigError, match=r"has the same name as .*; rename one of the two"):
        entries_in([entry.parent, agent_entries()["merge_ippo"].parent])
    with pytest.raises(ConfigError, match="is not a folder; give the folder of an entry"):
        check_entry(tmp_path / "nowhere")


def test_the_commands_check_an_entry_and_build_the_board(
    entry: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out, told = tmp_path / "page.html", tmp_path / "told.json"
    with pytest.raises(SystemExit) as ended:
        main(["board", "check", str(entry)])
    assert ended.value.code == 0
    assert "can be submitted" in " ".join(capsys.readouterr().out.split())
    words = ["board", "build", str(entry.parent), str(ROOT / "board"), "--entry", "merge_ippo"]
    with pytest.raises(SystemExit) as ended:
        main([*words, "--out", str(out), "--json", str(told)])
    assert ended.value.code == 0
    entries = json.loads(told.read_text())["entries"]
    assert {name: one["failure"] for name, one in entries.items()} == {"merge_ippo": ""}
    flip_byte(entry / "result" / "trips.csv")
    capsys.readouterr()
    with pytest.raises(SystemExit) as ended:
        main([*words, "--out", str(out)])
    assert ended.value.code == 1
    assert "merge_ippo: " in capsys.readouterr().err
    assert "✗ failed" in out.read_text()


@pytest.mark.parametrize(
    ("keys", "wrong"),
    [
        ({"software": {}}, r"software\.packages"),
        ({"world": []}, r"world\.environment"),
        ({"policies": None}, "policies"),
        ({"episodes": "x"}, "episodes"),
        ({"seeds": 3}, "seeds"),
    ],
)
def test_a_damaged_manifest_does_not_stop_the_board(
    keys: dict[str, Any], wrong: str, entry: Path, tmp_path: Path
) -> None:
    change_manifest(entry, **keys)
    (found,) = build_board([entry], tmp_path / "board.html")
    assert re.search(rf"manifest\.json: {wrong} is missing or damaged; evaluate", found.failure)


def test_a_manifest_with_a_damaged_job_does_not_stop_the_board(entry: Path, tmp_path: Path) -> None:
    job = json.loads((entry / "result" / "manifest.json").read_text())["job"]
    change_manifest(entry, job=job | {"overrides": 3})
    (found,) = build_board([entry], tmp_path / "board.html")
    assert "does not say what was driven" in found.failure


def test_an_entry_can_be_checked_from_inside_its_folder(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(ROOT / "board" / "idm")
    assert not check_entry(Path()).differing


def test_a_script_that_exits_does_not_end_the_check(tmp_path: Path) -> None:
    own = script_entry(tmp_path / "entries")
    script = own / "brake.py"
    script.write_text(script.read_text() + "\n\nraise SystemExit(0)\n")
    digest = hashlib.sha256(script.read_bytes()).hexdigest()
    manifest = json.loads((own / "result" / "manifest.json").read_text())
    manifest["policies"]["brake"]["sha256"] = {"brake.py": digest}
    change_manifest(own, policies=manifest["policies"])
    with pytest.raises(PolicyError, match=r"brake\.py: ends the program \(SystemExit\(0\)\)"):
        check_entry(own)
