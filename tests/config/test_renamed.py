"""Old names of keys, modes and terms still work, warn, and mean the same; removed keys do not."""

from __future__ import annotations

import dataclasses
import re
import warnings
from pathlib import Path

import pytest

from cavmarl.config.env import EnvConfig
from cavmarl.config.io import dotted_keys
from cavmarl.config.registry import load_config
from cavmarl.config.renamed import KEYS, MODES, REMOVED
from cavmarl.core.errors import ConfigError

VALUES = {"workers.watch": True, "zones.check": True}


@pytest.mark.parametrize(("old", "new"), KEYS.items())
def test_an_old_key_is_read_as_the_new_one(old: str, new: str) -> None:
    value = VALUES.get(old, 5)
    with pytest.warns(FutureWarning, match=f"{old} is now called {new}"):
        found, _ = load_config("ring", overrides={old: value})
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        wanted, _ = load_config("ring", overrides={new: value})
    assert found == wanted
    assert found != load_config("ring")[0]


def test_new_keys_are_keys() -> None:
    known = set(dotted_keys(EnvConfig))
    for new in KEYS.values():
        assert new in known or new.startswith("terms.weights.")


@pytest.mark.parametrize(("old", "new"), MODES.items())
def test_an_old_mode_is_read_as_the_new_one(old: str, new: str) -> None:
    with pytest.warns(FutureWarning, match=new):
        found, _ = load_config("merge", overrides={"population.mode": old})
    assert found.population.mode == new


def test_a_file_with_old_names_is_read(tmp_path: Path) -> None:
    ring = load_config("ring")[1]
    text = (ring / "env.yaml").read_text()
    assert "terms:" not in text
    assert "zones:" not in text
    (tmp_path / "map").symlink_to(ring / "map")
    (tmp_path / "env.yaml").write_text(
        f"{text}\nterms:\n  weights:\n    comfort: -0.5\nzones:\n  check: true\n"
    )
    with pytest.warns(FutureWarning) as caught:
        found, _ = load_config(tmp_path)
    assert len(caught) == 2
    assert found.terms.weights["jerk"] == -0.5
    assert "comfort" not in found.terms.weights
    assert dataclasses.asdict(found)["zones"]["check_invariants"] is True


@pytest.mark.parametrize(("key", "instead"), REMOVED.items())
def test_a_removed_key_is_refused_with_what_to_do_instead(key: str, instead: str) -> None:
    assert key not in dotted_keys(EnvConfig)
    message = re.escape(f"{key} has been removed: {instead}")
    with pytest.raises(ConfigError, match=message):
        load_config("ring", overrides={key: "hold"})
