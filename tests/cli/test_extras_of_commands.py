"""Commands name all missing modules in one error, before any work."""

from __future__ import annotations

from pathlib import Path

import pytest
from typer.testing import CliRunner

from cavmarl.cli import app
from cavmarl.cli.train import extras_of
from cavmarl.config.registry import programs
from cavmarl.core import errors
from cavmarl.core.errors import MissingExtraError


@pytest.fixture
def without_extras(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """Hide the modules of all extras, and return a working directory with a model file."""
    monkeypatch.setattr(errors, "find_spec", lambda name: None)
    monkeypatch.chdir(tmp_path)
    (tmp_path / "model.zip").write_bytes(b"")
    return tmp_path


@pytest.mark.parametrize(
    ("words", "modules", "extras"),
    [
        ("train ppo", "'torch' is", "train"),
        ("train ppo_sb3", "'torch'", "train"),
        ("demo", "'torch' and 'matplotlib' and 'jinja2' and 'pygame' and 'PIL'", "demo"),
        ("evaluate town -p model.zip --html page.html --record kept",
         "'sumo' and 'stable_baselines3' and 'torch' and 'matplotlib' and 'jinja2' and 'pyarrow'",
         "record,report,sumo,train"),
        ("evaluate merge -p idm+model.zip", "'stable_baselines3' and 'torch'", "train"),
        ("view town --web", "'sumo' and 'starlette'", "sumo,viewer"),
        ("view merge --video a.mp4", "'pygame' and 'imageio_ffmpeg'", "render"),
        ("replay kept --mcap a.mcap", "'pyarrow' and 'mcap'", "record"),
        ("baseline merge", "'matplotlib' and 'jinja2'", "report"),
        ("scenario run cut_in --picture a.png", "'pygame' is", "render"),
    ],
)  # fmt: skip
def test_the_error_of_a_command_names_all_missing_modules(
    without_extras: Path, words: str, modules: str, extras: str
) -> None:
    with pytest.raises(MissingExtraError) as refusal:
        CliRunner().invoke(app, words.split(), catch_exceptions=False)
    assert modules in str(refusal.value)
    assert f"[{extras}]'" in str(refusal.value)
    assert [path.name for path in without_extras.iterdir()] == ["model.zip"], (
        "files were written before the error"
    )


def test_each_training_program_needs_torch() -> None:
    found = {name: extras_of(path) for name, path in programs().items()}
    for name in ("ppo", "ppo_sb3", "ppo_gymnasium", "ippo_torchrl"):
        assert found[name]["torch"] == "train"
    assert found["ppo_rllib"]["ray"] == "rllib"
    assert found["ippo_benchmarl"]["benchmarl"] == "benchmarl"
