"""The fuzz targets without the fuzzer: seed files, and some mutations of seed files."""

from __future__ import annotations

import random

import pytest

pytest.importorskip("torch", reason="drivers need the extra 'train'")
pytest.importorskip("sumo", reason="maps need the extra 'sumo'")

from fuzz.mutations import mutated
from fuzz.targets import TARGETS

MUTATIONS = 150
SLOW_MUTATIONS = 15


@pytest.mark.parametrize("name", TARGETS)
def test_seed_files_are_accepted(name: str) -> None:
    target = TARGETS[name]
    for content in target.seeds():
        assert target.accepts(content), target.parse(content)


@pytest.mark.parametrize("name", TARGETS)
def test_mutated_files_are_accepted_or_refused_with_a_typed_error(name: str) -> None:
    target, rng = TARGETS[name], random.Random(0)
    seeds = target.seeds()
    number = SLOW_MUTATIONS if target.slow else MUTATIONS
    contents = [mutated(rng.choice(seeds), rng) for _ in range(number)]
    taken = [target.accepts(content) for content in contents]
    assert len(set(contents)) > number // 2
    if name != "cached":  # broken cache entries are rebuilt
        assert not all(taken)


@pytest.mark.parametrize("content", [b"[" * 100_000, b'{"seed": ' + b"9" * 5000 + b"}", b"\xff"])
@pytest.mark.parametrize("name", TARGETS)
def test_hostile_files_cause_only_typed_errors(name: str, content: bytes) -> None:
    TARGETS[name].accepts(content)


@pytest.mark.parametrize("name", TARGETS)
def test_truncated_files_cause_only_typed_errors(name: str) -> None:
    target = TARGETS[name]
    for content in target.seeds():
        for length in (0, 1, 2, 10, len(content) // 2, len(content) - 1):
            target.accepts(content[:length])
