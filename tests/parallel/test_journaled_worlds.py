"""Worlds with a journal over workers have the results and the journal of one process."""

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
from cavmarl.handoff.coordinator.journal import Journal, JournalReader
from cavmarl.ownership.log_records import replay
from cavmarl.parallel.workers.pooled_worlds import PooledWorlds
from tests.support.replayed import BUSY
from tests.support.vec_runs import Make

STEPS = 40  # long enough for more than two restarts of the checkpoint log


@pytest.fixture(autouse=True)
def _same_runs(monkeypatch: pytest.MonkeyPatch) -> None:
    """Give all runs the same random name, so that their journals can be compared."""
    monkeypatch.setattr("secrets.token_bytes", lambda size: bytes(range(size)))


def _drive(vec: CavVectorEnv, kills: bool = False) -> list[Any]:
    """Return the results of a run that resets the first world in step 6."""
    found: list[Any] = [vec.reset(seed=3)[0].tobytes()]
    struck = itertools.count(1)
    for step in range(STEPS):
        if kills and step % 5 in (1, 2):
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


@pytest.mark.parametrize(("worlds", "workers"), [(1, 1), (2, 2), (2, 1), (1, 2)])
@pytest.mark.parametrize("more", [{}, {"zones.check_invariants": True}])
def test_journals_equal_those_of_an_undisturbed_run(
    make: Make, tmp_path: Path, worlds: int, workers: int, more: dict[str, Any]
) -> None:
    def run(name: str, number: int, kills: bool = False) -> tuple[list[Any], dict[str, bytes]]:
        folder = tmp_path / name
        folder.mkdir()
        settings = {**BUSY, **more, "zones.journal": str(folder / "run.jsonl")}
        vec = make("grid4x4", num_envs=worlds, zones=2, workers=number, overrides=settings)
        found = _drive(vec, kills)
        vec.close()
        return found, _journals(folder)

    alone, journals = run("alone", 0)
    assert len(journals) == worlds
    assert all(content.count(b"\n") > 2 * STEPS for content in journals.values())
    assert run("workers", workers) == (alone, journals)
    assert run("killed", workers, kills=True) == (alone, journals)


def test_an_existing_journal_is_not_changed(make: Make, tmp_path: Path) -> None:
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


def test_a_replaced_worker_resumes_with_repartitioned_zones(make: Make, tmp_path: Path) -> None:
    def run(name: str, workers: int, kills: bool = False) -> tuple[list[Any], dict[str, bytes]]:
        folder = tmp_path / name
        folder.mkdir()
        repartitions = {"zones.repartition_steps": 4, "zones.repartition_tolerance": 0.0}
        settings = {**BUSY, **repartitions, "zones.journal": str(folder / "run.jsonl")}
        vec = make("grid4x4", zones=3, workers=workers, overrides=settings)
        found = _drive(vec, kills)
        vec.close()
        return found, _journals(folder)

    alone = run("alone", 0)
    assert run("killed", 1, kills=True) == alone


def test_balancing_together_with_repartitioning_is_refused_with_a_journal(make: Make) -> None:
    overrides = {
        "zones.journal": "x.jsonl",
        "workers.balance_steps": 5,
        "zones.repartition_steps": 4,
    }
    with pytest.raises(ConfigError, match=r"set workers\.balance_steps or zones\.repart"):
        make("grid4x4", num_envs=3, zones=2, workers=2, overrides=overrides)
    assert not Path("x.jsonl").exists()


@pytest.mark.parametrize("zones", [2, 3])
def test_a_journal_records_that_a_loaded_state_starts_an_episode(
    make: Make, tmp_path: Path, zones: int
) -> None:
    first = make("grid4x4", zones=2, overrides=dict(BUSY))
    _drive(first)
    path = tmp_path / "run.jsonl"
    settings = {**BUSY, "zones.journal": str(path), "zones.check_invariants": True}
    other = make("grid4x4", zones=zones, overrides=settings)
    other.reset(seed=0)
    other.load_state(first.save_state())
    for _ in range(10):
        actions = first.suggest_actions()
        assert (other.step(actions)[0] == first.step(actions)[0]).all()
        assert other.state_hash() == first.state_hash()
    other.close()
    table = replay(JournalReader(path))
    assert table.episode == 1
    assert len(table.owners) > 50
