"""Recordings with random changes: each one is read, or refused with a typed error."""

from __future__ import annotations

import os
from collections import Counter
from pathlib import Path

import pytest

from cavmarl import CavmarlError
from tests.support.hostile_recordings import Forger, Use, limited_memory, make_recording

MUTATIONS = 150
MANY_MUTATIONS = int(os.environ.get("CAVMARL_RECORDING_MUTATIONS", "1500"))
EVERY = 10  # of this many recordings, one is drawn as pictures, and another is shown on a page


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_recording(tmp_path_factory.mktemp("fuzzed") / "good")


def attack(good: Path, folder: Path, seed: int, number: int) -> Counter[str]:
    forger, found = Forger(good, folder, seed), Counter[str]()
    errors: dict[str, str] = {}
    faults: list[str] = []
    for k in range(number):
        done = forger.forge()
        use = Use(pictures=k % EVERY == 0, page=k % EVERY == 5)
        try:
            with limited_memory():
                use.read(forger.path, folder)
        except CavmarlError as error:
            found["refused"] += 1
            errors[str(error)] = done
        except Exception as error:
            faults.append(f"mutation {k} of seed {seed}, {done}: {error!r}")
        else:
            found["read"] += 1
    assert not faults
    assert not {text: done for text, done in errors.items() if "needs more memory" in text}
    assert not {text: done for text, done in errors.items() if "\n" in text}
    return found


def test_forged_recordings_are_read_or_refused(good: Path, tmp_path: Path) -> None:
    Use(pictures=True, page=True).read(good, tmp_path)
    found = attack(good, tmp_path, 0, MUTATIONS)
    assert found["read"] > MUTATIONS // 20
    assert found["refused"] > MUTATIONS // 4


@pytest.mark.slow
def test_many_forged_recordings_are_read_or_refused(good: Path, tmp_path: Path) -> None:
    found = attack(good, tmp_path, 1, MANY_MUTATIONS)
    print(dict(found))
    assert found.total() == MANY_MUTATIONS
