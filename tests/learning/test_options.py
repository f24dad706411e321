"""Settings of training programs as options and files."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import pytest

from cavmarl.core.errors import ConfigError
from cavmarl.learning.options import (
    check_at_least,
    check_device,
    parse_settings,
    run_folder,
    run_program,
    split_settings,
)


@dataclass(frozen=True)
class SomeSettings:
    steps: Annotated[int, "of a run"] = 5
    rate: Annotated[float, "of learning"] = 0.5
    anneal: Annotated[bool, "the rate"] = True
    runs: Annotated[str, "folder"] = "runs"

    def __post_init__(self) -> None:
        check_at_least(self, {"steps": 1})


@dataclass(frozen=True)
class WithPlugins:
    plugins: Annotated[str, "modules"] = ""


def test_options_override_a_file_and_a_file_overrides_defaults(tmp_path: Path) -> None:
    file = tmp_path / "few.yaml"
    file.write_text("steps: 7\nrate: 0.25\n")
    assert parse_settings(SomeSettings, [], "") == SomeSettings()
    found = parse_settings(SomeSettings, ["--config", str(file), "--rate", "2", "--no-anneal"], "")
    assert found == SomeSettings(steps=7, rate=2.0, anneal=False)


@pytest.mark.parametrize(
    ("text", "said"), [("step: 1", "step: .*steps"), ("steps: 0", "--steps 0")]
)
def test_an_invalid_file_of_settings_is_refused(tmp_path: Path, text: str, said: str) -> None:
    file = tmp_path / "few.yaml"
    file.write_text(text)
    with pytest.raises(ConfigError, match=said):
        parse_settings(SomeSettings, ["--config", str(file)], "")


def test_the_option_import_can_be_repeated() -> None:
    words = ["--import", "my_terms", "--import", "my_package.sensors"]
    assert parse_settings(WithPlugins, words, "").plugins == "my_terms,my_package.sensors"


def test_the_help_has_the_first_line_of_the_docstring(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit, match="0"):
        parse_settings(SomeSettings, ["--help"], "Learns little.\n\nMore.")
    shown = capsys.readouterr().out
    assert "Learns little." in shown
    assert "More." not in shown
    assert "of a run (default: 5)" in shown


def test_the_folder_of_a_run_has_its_name() -> None:
    assert run_folder("runs", "mine", "merge", "ippo", 3) == Path("runs/mine")
    assert run_folder("runs", "", "maps/town.net.xml", "ippo", 3) == Path("runs/town_ippo_3")


def test_errors_of_a_program_are_printed_without_a_traceback(
    capsys: pytest.CaptureFixture[str],
) -> None:
    def train() -> Path:
        raise ConfigError("no such world")

    assert run_program(train) == 2
    assert capsys.readouterr().err == "error: no such world\n"
    assert run_program(lambda: Path("here"), "run: {folder}") == 0
    assert capsys.readouterr().out == "run: here\n"


@pytest.mark.parametrize("name", ["gpu", "meta", "cuda:99", ""])
def test_a_missing_device_is_refused_with_a_remedy(name: str) -> None:
    check_device("cpu")
    with pytest.raises(ConfigError, match=f"--device {name}: .*give cpu, or cuda"):
        check_device(name)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", []),
        ("a.b=1", ["a.b=1"]),
        ("a.b=1,c=x,", ["a.b=1", "c=x"]),
        ('a={"idm":0.5,"krauss":0.5},b=[1,2]', ['a={"idm":0.5,"krauss":0.5}', "b=[1,2]"]),
    ],
)
def test_settings_are_split_at_commas_before_a_key(text: str, words: list[str]) -> None:
    assert split_settings(text) == words
