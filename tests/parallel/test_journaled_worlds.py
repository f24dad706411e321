"""Worlds with a journal on workers: the same results, and the same journal."""

from __future__ import annotations

import itertools
import os
import signal
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cavmarl import CavVectorEnv
from cavmarl.core.errors import ConfigError, JournalError
from cavmarl.handoff.coordinator.journal import Journal
from cavmarl.parallel.pooled_worlds import PooledWorlds
from tests.support.replayed import BUSY
from tests.support.vec_runs import Make

STEPS = 12


@pytest.fixture(autouse=True)
def _same_runs(monkeypatch: pytest.MonkeyPatch) -> None:
    """Runs have names that can be foreseen, so that their journals can be compared."""
    monkeypatch.setattr("secrets.token_bytes", lambda size: bytes(range(size)))


def _drive(vec: CavVectorEnv, kills: bool = False) -> list[Any]:
    """What comes out; a reset without a seed and one of some worlds are among it."""
    found: list[Any] = [vec.reset(seed=3)[0].tobytes()]
    struck = itertools.count(1)
    for step in range(STEPS):
        if kills and step % 4 in (1, 2):
            assert isinstance(vec.worlds, PooledWorlds)
            pids = vec.worlds.pool.pids
            os.kill(pids[next(struck) % len(pids)], signal.SIGKILL)
        if step == 6:
            chosen = np.arange(vec.num_envs) == 0
            found.append(vec.reset(options={"reset_mask": chosen})[0].tobytes())
        observations, rewards, *_ = vec.step(vec.suggest_actions())
        found += [observations.tobytes(), rewards.tobytes()]
        found += [vec.state_hash(w) for w in range(vec.num_envs)]
    return found


def _journals(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in sorted(folder.iterdir())}


@pytest.mark.parametrize(("worlds", "workers"), [(1, 1), (2, 2), (2, 1)])
def test_nobody_can_tell(make: Make, tmp_path: Path, worlds: int, workers: int) -> None:
    def run(name: str, number: int, kills: bool = False) -> tuple[list[Any], dict[str, bytes]]:
        folder = tmp_path / name
        folder.mkdir()
        settings = {**BUSY, "zones.journal": str(folder / "run.jsonl")}
        vec = make("grid4x4", num_envs=worlds, zones=2, workers=number, overrides=settings)
        found = _drive(vec, kills)
        vec.close()
        return found, _journals(folder)

    alone, journals = run("alone", 0)
    assert len(journals) == worlds
    assert all(content.count(b"\n") > 2 * STEPS for content in journals.values())
    assert run("workers", workers) == (alone, journals)
    assert run("killed", workers, kills=True) == (alone, journals)


def test_a_journal_that_is_there_is_left_alone(make: Make, tmp_path: Path) -> None:
    path = tmp_path / "run.jsonl"
    path.write_text("somebody's")
    with pytest.raises(JournalError, match="exists"):
        make("grid4x4", zones=2, workers=1, overrides={**BUSY, "zones.journal": str(path)})
    assert path.read_text() == "somebody's"


@pytest.mark.parametrize("workers", [0, 1])
def test_a_journal_is_locked_until_its_world_is_closed(
    make: Make, tmp_path: Path, workers: int
) -> None:
    path = tmp_path / "run.jsonl"
    vec = make("grid4x4", zones=2, workers=workers, overrides={**BUSY, "zones.journal": str(path)})
    vec.reset(seed=0)
    with pytest.raises(JournalError, match="another run is writing"):
        Journal(path, resume=True)
    vec.close()
    Journal(path, resume=True).close()


@pytest.mark.parametrize(
    ("more", "words"),
    [
        ({"workers": 2, "zones.journal": "x.jsonl"}, r"zones\.journal.*at most workers=1"),
        (
            {"num_envs": 3, "workers": 2, "zones.journal": "x.jsonl", "workers.balance_steps": 5},
            r"leave workers\.balance_steps 0",
        ),
    ],
)
def test_what_cannot_be_is_refused(make: Make, more: dict[str, Any], words: str) -> None:
    keywords = {name: more[name] for name in ("num_envs", "workers") if name in more}
    overrides = {name: value for name, value in more.items() if "." in name}
    with pytest.raises(ConfigError, match=words):
        make("grid4x4", zones=2, overrides=overrides, **keywords)
    assert not Path("x.jsonl").exists()
