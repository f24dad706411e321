"""AT2, AT5, AT10 and AT11 on whole worlds: after any death the tick is begun again."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace

import numpy as np
import pytest

from cavmarl import make_vec
from cavmarl.core.errors import LostTickError, ProtocolError
from cavmarl.handoff.fault_injection.committed_store import CommittedStore
from cavmarl.handoff.fault_injection.fault_plan import (
    COORDINATOR_POINTS,
    ZONE_POINTS,
    Crash,
    Faults,
)
from cavmarl.handoff.fault_injection.recovery import GARBAGE
from cavmarl.ownership.transport import Rates
from cavmarl.verify.fault_campaign import Campaign, LineResult, run_campaign
from tests.support.faulted import BUSY, ROUGH, Recorded, follow, record, replay

ZONES = 4
STEPS = 12
TICKS = range(1, 2 * STEPS + 1)


@pytest.fixture(scope="module")
def busy() -> Recorded:
    return record("grid4x4", BUSY, STEPS)


@pytest.fixture(scope="module")
def campaign() -> Campaign:
    return run_campaign(None, (ZONES,), steps=12, seeds=1, overrides={"clock.ctrl_dt_s": 0.4})


def line(campaign: Campaign, name: str) -> LineResult:
    """A line of the matrix, in which every run was as it has to be."""
    (found,) = [line for line in campaign.lines if line.name == name]
    assert not found.failures
    assert found.missed == 0
    assert found.unmet == ()
    return found


@pytest.mark.parametrize("role", ["source", "target", "bystander"])
def test_at02_a_zones_host_dies_at_every_point(campaign: Campaign, role: str) -> None:
    deaths = line(campaign, f"the {role}'s host dies").figures.zone_deaths
    assert deaths == dict.fromkeys(ZONE_POINTS, 1)


def test_at02_the_coordinator_dies_at_every_point(campaign: Campaign) -> None:
    deaths = line(campaign, "the coordinator dies").figures.coordinator_deaths
    assert deaths == dict.fromkeys(COORDINATOR_POINTS, 1)


@pytest.mark.parametrize(
    ("name", "times"), [("the new host dies, too", 6), ("three hosts die in a row", 9)]
)
def test_at02_new_hosts_die_in_the_recovery(campaign: Campaign, name: str, times: int) -> None:
    assert line(campaign, name).figures.zone_deaths == dict.fromkeys(ZONE_POINTS, times)


def test_at02_everything_else_that_dies(campaign: Campaign) -> None:
    assert campaign.holds
    assert not any(line.unmet or line.missed for line in campaign.lines)
    total = campaign.total()
    assert len(total.recovery_ms) == total.deaths > 500
    assert total.failure_rate == 0.0


def test_at04_who_is_given_up_and_lives_on_is_not_heard(campaign: Campaign) -> None:
    figures = line(campaign, "a host is given up, and lives on").figures
    assert figures.deaths == 3 * len(ZONE_POINTS)
    assert figures.stale["Done", "incarnation"] > 0


def test_at05_the_coordinator_restarts_at_every_record(busy: Recorded) -> None:
    points = [point for point in COORDINATOR_POINTS if point.endswith(("torn", "written"))]
    faults = Faults(crashes=tuple(Crash(tick, point) for tick in TICKS for point in points))
    vec = replay(busy, ZONES, faults)
    assert Counter(death.point for death in vec.simulation.revivals) == dict.fromkeys(
        points, len(TICKS)
    )


def test_at05_everything_is_loaded_anew_in_every_tick(busy: Recorded) -> None:
    hosts = [Crash(tick, "before DONE", zone) for tick in TICKS for zone in range(ZONES)]
    faults = Faults(crashes=(*hosts, *(Crash(tick, "all done") for tick in TICKS)))
    vec = replay(busy, ZONES, faults)
    assert len(vec.simulation.revivals) == len(TICKS) * (ZONES + 1)


def test_what_a_dead_host_had_is_really_gone(
    busy: Recorded, monkeypatch: pytest.MonkeyPatch
) -> None:
    load, lost = CommittedStore.load, []

    def look(store: CommittedStore) -> object:
        shard = store._shards[1]
        lost.append({value for array in
                     (*shard.sides, shard.worlds.num_owned, shard.worlds.num_rows)
                     for value in np.unique(array.view(np.uint8)).tolist()})  # fmt: skip
        return load(store)

    monkeypatch.setattr(CommittedStore, "load", look)
    replay(busy, ZONES, Faults(crashes=(Crash(7, "resolve", 1),)))
    assert lost == [{GARBAGE}]


def test_a_step_that_is_sent_again_has_the_states_of_the_committed_tick(busy: Recorded) -> None:
    # Some zones have computed the tick and others have died; then DONE is lost.
    deaths = tuple(Crash(tick, "commit", tick % ZONES) for tick in TICKS)
    messages = {"Ack": Rates(drop=1.0), "Done": Rates(drop=0.8)}
    vec = replay(busy, ZONES, Faults(messages=messages, crashes=deaths))
    assert vec.simulation.transfers[0].counts["forced"] > 0


def test_at10_nobody_is_lost_or_doubled(busy: Recorded) -> None:
    faults = {"zones.faults": ROUGH.to_json()}
    vec = make_vec("grid4x4", num_envs=1, zones=ZONES, overrides=busy.settings | faults)
    simulation = vec.simulation
    vec.reset(seed=1)
    for _ in range(STEPS):
        vec.step(vec.suggest_actions())
        rows = simulation.vehicles()
        ids = rows["id"].tolist()
        born = {birth.vehicle: birth.zone for birth in simulation.coordinators[0].notes()[0]}
        gone = {entry.vehicle for entry in simulation.coordinators[0].notes()[1]}
        owners = simulation.coordinators[0].directory.table.owners
        known = born | {v: zone for v, (zone, _) in owners.items() if v not in gone}
        assert len(set(ids)) == len(ids)
        assert sorted(known) == sorted(ids)
    assert simulation.revivals


@pytest.mark.parametrize("point", ["PREPARE arrives", "lease taken", "resolve", "before DONE"])
def test_at11_a_tick_that_every_host_dies_of_is_not_tried_for_ever(
    busy: Recorded, point: str
) -> None:
    deaths = tuple(Crash(tick, point, 1, times=10**6) for tick in TICKS)
    faults = {"zones.faults": Faults(crashes=deaths).to_json()}
    vec = make_vec("grid4x4", num_envs=1, zones=ZONES, overrides=busy.settings | faults)
    with pytest.raises(LostTickError, match=r"zone 1 could not reach tick .*: 4 hosts in a row"):
        follow(busy, vec)
    died = vec.simulation.revivals
    assert [death.tick for death in died] == 3 * [died[0].tick]


def test_at11_a_tick_that_every_coordinator_dies_of_is_not_tried_for_ever(busy: Recorded) -> None:
    with pytest.raises(ProtocolError, match="could not reach tick 3: 4 of them died at 'detect'"):
        replay(busy, ZONES, Faults(crashes=(Crash(3, "detect", times=10**6),)))


def test_at11_after_poison_another_episode_is_as_good_as_ever(busy: Recorded) -> None:
    faults = Faults(crashes=(Crash(5, "resolve", 1, times=4),))
    settings = busy.settings | {"zones.faults": faults.to_json()}
    vec = make_vec("grid4x4", num_envs=1, zones=ZONES, overrides=settings)
    with pytest.raises(LostTickError):
        follow(busy, vec)
    follow(busy, vec)


def test_a_reset_in_the_middle_of_hand_overs_voids_them(busy: Recorded) -> None:
    late = {kind: replace(rates, delay=0.6, longest_delay=64) for kind, rates in
            ROUGH.messages.items()}  # fmt: skip
    settings = busy.settings | {"zones.faults": replace(ROUGH, messages=late).to_json()}
    vec = make_vec("grid4x4", num_envs=1, zones=ZONES, overrides=settings)
    for _ in range(3):
        follow(busy, vec)
    assert sum(n for (_, why), n in vec.simulation.coordinators[0].dropped().items()
               if why == "episode") > 0  # fmt: skip
