"""Programs that share nothing: how fast they are side by side."""

from __future__ import annotations

import multiprocessing

import pytest

from cavmarl import ConfigError
from cavmarl.bench.worker_speed import CoreCeiling, measure_ceiling
from cavmarl.core.errors import WorkerError


def test_all_programs_step_and_end() -> None:
    before = {*multiprocessing.active_children()}
    found = measure_ceiling("ring", worlds=3, programs=2, steps=2, repeats=2, agents=2, alike=True)
    assert found.programs == 2
    assert len(found.alone_ms) == len(found.together_ms) == 2
    assert min(found.alone_ms + found.together_ms) > 0.0
    assert {*multiprocessing.active_children()} <= before
    assert found.to_dict()["ratio"] == found.ratio


def test_the_ratio_is_that_of_the_middle_turn() -> None:
    assert CoreCeiling(2, (4.0, 8.0, 6.0), (2.0, 5.0, 6.0)).ratio == 1.6


def test_more_programs_than_worlds() -> None:
    with pytest.raises(ConfigError, match="3 programs, 2 worlds"):
        measure_ceiling("ring", worlds=2, programs=3)


def test_a_program_that_cannot_begin(capfd: pytest.CaptureFixture[str]) -> None:
    before = {*multiprocessing.active_children()}
    with pytest.raises(WorkerError, match="has ended"):
        measure_ceiling("no such place", worlds=2)
    assert "no such place" in capfd.readouterr().err
    assert {*multiprocessing.active_children()} <= before
