"""The committed store: what is wrong in it is found before it is the truth."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import pytest

from cavmarl import make_vec
from cavmarl.core.errors import LostTickError, ProtocolError
from cavmarl.handoff.coordinator.coordinator_setup import make_coordinators
from cavmarl.handoff.fault_injection.committed_store import CommittedStore
from cavmarl.handoff.fault_injection.fault_plan import Crash, Faults
from cavmarl.ownership.safeguards import ALL_ON
from tests.support.faulted import BUSY, Recorded, record, replay

ZONE = 2
# Somebody may die, and dies where it does no harm: so there is a store.
STORED = Faults(crashes=(Crash(1, "BEGIN written"),))


@pytest.fixture(scope="module")
def busy() -> Recorded:
    return record("grid4x4", BUSY, 12)


class Wild:
    """Writes into a row of another zone, in the store, at some of the writes.

    Args:
        often: at every how manieth write of a tick.
    """

    def __init__(self, monkeypatch: pytest.MonkeyPatch, often: int) -> None:
        self.writes = self.strikes = 0
        self._often = often
        self._write = CommittedStore.write
        monkeypatch.setattr(CommittedStore, "write", lambda *given: self.write(*given))

    def write(self, store: CommittedStore, notes: Any) -> None:
        self._write(store, notes)
        self.writes += 1
        if self.writes > 1 and self.writes % self._often == 0:
            rows = store.written(ZONE, 0)
            rows["speed"][0] += 0.5
            self.strikes += 1


def test_a_wild_write_is_found_and_the_tick_begun_again(
    busy: Recorded, monkeypatch: pytest.MonkeyPatch
) -> None:
    wild = Wild(monkeypatch, often=3)
    vec = replay(busy, 4, STORED)
    found = [death for death in vec.simulation.revivals if death.point == "wrong rows"]
    assert len(found) == wild.strikes > 5
    assert {death.zone for death in found} == {ZONE}


def test_a_wild_write_that_nobody_looks_for_becomes_the_truth(
    busy: Recorded, monkeypatch: pytest.MonkeyPatch
) -> None:
    blind = replace(ALL_ON, digest_before_commit=False)
    monkeypatch.setattr(
        "cavmarl.engine.simulation.make_coordinators", partial(make_coordinators, safeguards=blind)
    )
    wild = Wild(monkeypatch, often=3)
    deaths = tuple(Crash(tick, "advance", ZONE) for tick in range(4, 24))
    with pytest.raises(AssertionError):
        replay(busy, 4, Faults(crashes=deaths))
    assert wild.strikes > 0


def test_a_zone_whose_rows_are_always_wrong_is_not_tried_for_ever(
    busy: Recorded, monkeypatch: pytest.MonkeyPatch
) -> None:
    Wild(monkeypatch, often=1)
    with pytest.raises(LostTickError, match=f"zone {ZONE} could not reach tick 1"):
        replay(busy, 4, STORED)


def test_what_was_written_is_not_the_truth_until_it_is_flipped(busy: Recorded) -> None:
    faults = {"zones.faults": STORED.to_json()}
    simulation = make_vec(
        "grid4x4", num_envs=1, zones=4, overrides=busy.settings | faults
    ).simulation
    store = CommittedStore(simulation._shards, simulation._shared_arrays)
    with pytest.raises(ProtocolError, match="reset the worlds first"):
        store.load()
    with pytest.raises(ProtocolError, match="nothing has been written"):
        store.flip()
    simulation.seed(3)
    simulation.reset()
    before = simulation.state_hash()
    store.write((((), ()),))
    store.flip()
    for shard in simulation._shards:
        shard.worlds.rows["speed"] += 1.0
    simulation.gate.next_id[:] += 1
    store.write((((), ()),))
    assert simulation.state_hash() != before
    assert np.all(store.written(0, 0)["speed"] >= 1.0)
    store.load()
    assert simulation.state_hash() == before
