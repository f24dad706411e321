"""Whole runs under seeded faults equal the undivided world (acceptance test AT7)."""

from __future__ import annotations

import pytest

from cavmarl.ownership.limits import Limits
from cavmarl.ownership.messages import COORDINATOR
from tests.ownership.simulator import COORDINATOR_POINTS, ZONE_POINTS, Simulator
from tests.ownership.toy import ToyWorld, number
from tests.support.lossy_network import FaultPlan, Rates

TICKS = 25
LAYOUTS = {
    "one zone": ((), ()),
    "two": ((12,), ()),
    "corner": ((12,), (12,)),
    "thin": ((10, 12), (12,)),
    "nine": ((8, 16), (8, 16)),
}


def world(layout: str, seed: int = 0) -> ToyWorld:
    cuts_x, cuts_y = LAYOUTS[layout]
    return ToyWorld(cuts_x=cuts_x, cuts_y=cuts_y, seed=seed)


@pytest.mark.parametrize("layout", LAYOUTS)
def test_a_divided_world_equals_the_undivided_one(layout: str) -> None:
    simulator = Simulator(world(layout))
    simulator.run(TICKS)
    assert simulator.digests == world(layout).undivided(TICKS)
    assert simulator.forced == simulator.deferred == 0
    assert (simulator.switches > 5) == (layout != "one zone")


FAULTS = {
    "loss of 1 %": Rates(drop=0.01),
    "loss of 10 %": Rates(drop=0.1),
    "loss of 50 %": Rates(drop=0.5),
    "duplicates": Rates(duplicate=0.5, longest_delay=30),
    "delays": Rates(delay=0.5, longest_delay=30),
    "reorder": Rates(reorder=1.0),
    "bits flip": Rates(corrupt=0.2),
    "targets refuse": Rates(refuse=0.5),
    "everything": Rates(0.1, 0.1, 0.1, 0.3, 0.05, 0.1, 20),
}


@pytest.mark.parametrize("layout", ["corner", "thin"])
@pytest.mark.parametrize("faults", FAULTS)
def test_faults_of_messages_change_no_result(faults: str, layout: str) -> None:
    simulator = Simulator(world(layout), plan=FaultPlan(seed=1, otherwise=FAULTS[faults]))
    simulator.run(TICKS)
    assert simulator.digests == world(layout).undivided(TICKS)
    assert sum(simulator.network.faults.values()) > 5


@pytest.mark.parametrize("kind", ["Prepare", "Ack"])
def test_every_hand_off_is_forced_if_all_offers_or_answers_are_lost(kind: str) -> None:
    simulator = Simulator(world("corner"), plan=FaultPlan(rates={kind: Rates(drop=1.0)}))
    simulator.run(TICKS)
    assert simulator.digests == world("corner").undivided(TICKS)
    assert simulator.switches == simulator.forced > 5


POINTS = [(point, COORDINATOR) for point in COORDINATOR_POINTS]
POINTS += [(point, zone) for point in ZONE_POINTS for zone in (0, 2)]


@pytest.mark.parametrize(("point", "party"), POINTS)
def test_a_crash_at_any_point_changes_no_result(point: str, party: int) -> None:
    simulator = Simulator(
        world("corner"),
        crashes=lambda tick, at, who: tick % 3 == 2 and at == point and who == party,
    )
    simulator.run(TICKS)
    assert simulator.digests == world("corner").undivided(TICKS)
    assert sum(simulator.deaths.values()) + len(simulator.zombies) >= 3 or point == "false alarm"


def campaign(seed: int, layout: str) -> Simulator:
    """Return a run in which all faults occur, even several times in a tick."""

    def crashes(tick: int, point: str, party: int) -> bool:
        return number(seed, "crash", tick, point, party) % 100 < 2

    plan = FaultPlan(seed=seed, otherwise=FAULTS["everything"])
    limits = Limits(repeats=len(ZONE_POINTS))
    return Simulator(world(layout, seed), plan=plan, crashes=crashes, limits=limits)


@pytest.mark.parametrize("seed", range(12))
def test_a_run_with_all_faults_changes_no_result_and_can_be_repeated(seed: int) -> None:
    layout = list(LAYOUTS)[seed % len(LAYOUTS)]
    first, second = campaign(seed, layout), campaign(seed, layout)
    first.run(TICKS)
    second.run(TICKS)
    assert first.digests == world(layout, seed).undivided(TICKS)
    assert first.log == second.log
    assert first.trace.text() == second.trace.text()


def test_every_open_hand_off_ends_within_d_plus_2_ticks_after_the_last_fault() -> None:
    limits = Limits()
    for seed in range(6):
        plan = FaultPlan(seed=seed, otherwise=Rates(drop=0.6, delay=0.3), until=150)
        simulator = Simulator(world("corner", seed), plan=plan, limits=limits)
        while simulator.network.phase < 150:
            simulator.step()
        waiting = {v: simulator.directory.table.owners[v] for v in simulator.open_handoffs()}
        for _ in range(limits.deferral + 2):
            simulator.step()
        simulator.judge()
        owners = simulator.directory.table.owners
        for vehicle, before in waiting.items():
            back = simulator.directory.table.deferred.get(vehicle, 0) <= 1
            assert owners.get(vehicle) != before or back


@pytest.mark.parametrize("seed", range(4))
def test_a_reset_in_the_middle_of_transfers_begins_an_empty_episode(seed: int) -> None:
    simulator = campaign(seed, "corner")
    for _ in range(3):
        for _ in range(5):
            simulator.step()
        simulator.reset()
        assert not simulator.directory.table.owners
        assert not simulator.directory.table.deferred
    ticks = simulator.directory.table.tick
    simulator.run(5)
    assert simulator.directory.table.tick == ticks + 5
    assert simulator.directory.table.episode == 3


@pytest.mark.slow
@pytest.mark.parametrize("block", range(20))
def test_many_runs_with_all_faults_change_no_result(block: int) -> None:
    for seed in range(100 + 50 * block, 150 + 50 * block):
        layout = list(LAYOUTS)[seed % len(LAYOUTS)]
        simulator = campaign(seed, layout)
        simulator.run(TICKS)
        assert simulator.digests == world(layout, seed).undivided(TICKS), seed
