"""The error for a removed key or option has one line and names the replacement."""

from __future__ import annotations

from pathlib import Path

import pytest

from cavmarl.cli import main
from cavmarl.config.env import EnvConfig
from cavmarl.config.io import dotted_keys
from cavmarl.config.registry import load_config
from cavmarl.config.removed_keys import REMOVED_KEYS, REMOVED_OPTIONS
from cavmarl.config.terms import TERMS
from cavmarl.core.errors import ConfigError

KNOWN = {*dotted_keys(EnvConfig), *(f"terms.weights.{name}" for name in TERMS)}


@pytest.mark.parametrize(("key", "replacement"), REMOVED_KEYS.items())
def test_a_removed_key_is_refused_with_its_replacement(key: str, replacement: str) -> None:
    with pytest.raises(ConfigError) as caught:
        load_config("ring", overrides={key: 1})
    (line,) = str(caught.value).splitlines()
    assert line.endswith(f"{key} was removed: {replacement}")


def test_the_error_for_a_key_in_a_removed_section_names_the_section() -> None:
    with pytest.raises(ConfigError, match=r"sensors\.roadgraph was removed: use sensors\.lanes"):
        load_config("ring", overrides={"sensors.roadgraph.points": 20})


def test_the_error_for_a_removed_key_in_a_file_names_the_file(tmp_path: Path) -> None:
    text = (load_config("ring")[1] / "env.yaml").read_text()
    (tmp_path / "env.yaml").write_text(f"{text}\nzones:\n  check: true\n")
    with pytest.raises(ConfigError, match=r"env\.yaml: zones\.check was removed: use"):
        load_config(tmp_path)


def test_no_removed_key_exists() -> None:
    assert not any(
        known == key or known.startswith(f"{key}.") for key in REMOVED_KEYS for known in KNOWN
    )


def test_each_replacement_names_existing_keys() -> None:
    sections = {known.rpartition(".")[0] for known in KNOWN}
    for replacement in REMOVED_KEYS.values():
        named = [word.rstrip(",.") for word in replacement.split() if word.count(".") > 0]
        assert named or "`cavmarl " in replacement
        assert set(named) <= KNOWN | sections


@pytest.mark.parametrize("words", [["verify", "zones", "ring"], ["bench", "step"]])
def test_a_removed_option_is_refused_with_its_replacement(
    words: list[str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(REMOVED_OPTIONS, "--gone", "use --there")
    with pytest.raises(SystemExit) as caught:
        main([*words, "--gone", "3"])
    assert caught.value.code == 2
    assert capsys.readouterr().err.strip().endswith("--gone was removed: use --there")
