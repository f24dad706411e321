"""AT1 to AT9 and AT13 on whole worlds (AT8 in test_safeguards.py): nobody can tell who did what."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cavmarl import make_vec
from cavmarl.core.errors import ActionError
from cavmarl.engine.world_setup import find_map
from cavmarl.handoff.fault_injection.fault_plan import (
    COORDINATOR_POINTS,
    MESSAGES,
    ZONE_POINTS,
    Crash,
    Faults,
)
from cavmarl.ownership.messages import Begin, Commit, Message, Record, Reset
from cavmarl.ownership.transport import Network, Rates
from cavmarl.roads.cache import load_network
from cavmarl.verify.fault_figures import FaultFigures
from cavmarl.zones.partition.zone_file import write_zones
from cavmarl.zones.partition.zone_partition import ZonePartition
from tests.support.actuated import actuated_grid
from tests.support.demand_worlds import make, tiny
from tests.support.driving import drive, start
from tests.support.faulted import BUSY, NOISE, QUICK, ROUGH, Recorded, record, replay
from tests.support.rerouting import CARS, DEVICE, FLOW, make_map, rerouter, write_demand

STEPS = 20


@pytest.fixture(scope="module")
def busy() -> Recorded:
    return record("grid4x4", BUSY, STEPS)


def patchwork(seed: int, count: int) -> ZonePartition:
    """Rectangles cut anywhere, each at random: a zone says nothing about its neighbours."""
    low_x, low_y, high_x, high_y = load_network(find_map("grid4x4")).extent_m
    bounds = (low_x - 9.0, low_y - 9.0, high_x + 9.0, high_y + 9.0)
    rng = np.random.default_rng(seed)
    rects = [list(bounds)]
    while len(rects) < count:
        rect = rects.pop(int(rng.integers(len(rects))))
        axis = int(rng.integers(2))
        cut = float(rng.uniform(rect[axis], rect[axis + 2]))
        below, above = rect.copy(), rect.copy()
        below[axis + 2] = above[axis] = cut
        rects += [below, above]
    return ZonePartition(bounds, np.array(rects)[rng.permutation(count)])


@pytest.mark.parametrize("layout", ["grid", "strips", "bisection"])
@pytest.mark.parametrize("zones", [2, 3, 9, 16])
def test_at01_any_number_of_zones_in_any_layout(busy: Recorded, layout: str, zones: int) -> None:
    replay(busy, zones, settings={"zones.layout": layout})


@pytest.mark.parametrize("seed", [0, 1])
def test_at01_owners_that_chance_has_dealt_out(busy: Recorded, seed: int, tmp_path: Path) -> None:
    path = tmp_path / "patchwork.json"
    write_zones(path, patchwork(seed, 24))
    vec = replay(busy, 24, ROUGH, {"zones.layout": str(path)})
    assert len(vec.simulation.revivals) > 5


CASES: dict[str, tuple[str, dict[str, Any]]] = {
    "several frames, late controls": (
        "grid4x4", {**BUSY, "sensors.stack": 3, "clock.control_latency_ticks": 3}),
    "one tick a step": ("grid4x4", {**BUSY, "clock.ctrl_dt_s": 0.2}),
    "agents that enter": ("merge", {**QUICK, "population.mode": "open"}),
    "closed": ("merge", {**QUICK, "population.mode": "closed"}),
    "short episodes": ("grid4x4", {**BUSY, "horizon_s": 1.2}),
    "team's rewards": ("grid4x4", {**BUSY, "terms.team_share": 0.4}),
    "no deferral": ("grid4x4", {**BUSY, "zones.max_deferred_ticks": 0}),
}  # fmt: skip


@pytest.mark.parametrize("name", CASES)
def test_at02_whatever_a_world_keeps_is_kept_over_deaths(name: str) -> None:
    env, settings = CASES[name]
    run = record(env, settings, STEPS, seed=3)
    vec = replay(run, 4, ROUGH)
    again = replay(run, 4, replace(ROUGH, seed=6))
    deaths = (*vec.simulation.revivals, *again.simulation.revivals)
    assert {death.zone is None for death in deaths} == {True, False}


def test_at02_actuated_signals_switch_alike(tmp_path: Path) -> None:
    run = record(actuated_grid(tmp_path), {**QUICK, "population.background": 40}, 60)
    vec = replay(run, 4, ROUGH)
    assert len(vec.simulation.revivals) > 5


def same_hashes(build: Any, steps: int, zones: int, faults: Faults) -> Any:
    """Worlds without agents have no public view: their hashes are compared."""
    whole, divided = build({}), build({"zones.count": zones, "zones.faults": faults.to_json()})
    for simulation in (whole, divided):
        start(simulation, seed=3)
    for step in range(steps):
        for simulation in (whole, divided):
            drive(simulation)
        assert divided.state_hash() == whole.state_hash(), f"step {step}"
        assert divided.traffic_stats() == whole.traffic_stats(), f"step {step}"
    assert len(divided.revivals) > 5
    return whole


def test_at02_vehicles_that_look_for_their_way_find_the_same(tmp_path: Path) -> None:
    net = make_map(tmp_path)
    files = write_demand(
        tmp_path, CARS.format(device=DEVICE) + FLOW, rerouter('<closingReroute id="narrow"/>')
    )
    clock = {"clock.sim_dt_s": 0.2, "clock.ctrl_dt_s": 1.0, "horizon_s": 1200.0}
    whole = same_hashes(lambda zones: make(net, files, overrides=clock | zones), 150, 3, ROUGH)
    assert whole.traffic_stats().rerouted > 10


@pytest.mark.parametrize("env", ["merge", "grid4x4"])
def test_at02_whatever_a_demand_orders_enters_alike(env: str, tmp_path: Path) -> None:
    whole = same_hashes(
        lambda zones: tiny(env, tmp_path, overrides={**QUICK, **zones}), 120, 4, ROUGH
    )
    assert whole.traffic_stats().departed > 20


@pytest.mark.parametrize("kind", ["Prepare", "Ack"])
def test_at03_without_any_acknowledgement_all_hand_overs_are_forced(
    busy: Recorded, kind: str
) -> None:
    vec = replay(busy, 9, Faults(messages={kind: Rates(drop=1.0)}))
    (log,) = vec.simulation.transfers
    assert log.counts["switched"] == 0
    assert {row.waited for row in log.rows if not row.removed} == {2}
    assert all(row.forced for row in log.rows)


@pytest.mark.parametrize("rate", [0.01, 0.1, 0.5, 1.0])
@pytest.mark.parametrize("kind", ["Prepare", "Ack", "Nack", "Abort"])
def test_at03_losses_put_hand_overs_off_and_no_more(busy: Recorded, kind: str, rate: float) -> None:
    messages = {"Prepare": Rates(refuse=0.3)} if kind == "Nack" else {}
    lossy = replace(messages.get(kind, Rates()), drop=rate)
    vec = replay(busy, 9, Faults(messages=messages | {kind: lossy}))
    assert all(row.waited <= 2 for row in vec.simulation.transfers[0].rows)


@pytest.mark.parametrize(
    ("fault", "reason"),
    [
        (Rates(duplicate=1.0, longest_delay=10), ("Prepare", "owned")),
        (Rates(delay=1.0, longest_delay=64), ("Ack", "tick")),
        (Rates(reorder=1.0, duplicate=0.5), ("Done", "answered")),
    ],
)
def test_at03_what_comes_late_or_twice_is_dropped_and_counted(
    busy: Recorded, fault: Rates, reason: tuple[str, str]
) -> None:
    vec = replay(busy, 9, Faults(messages=dict.fromkeys(NOISE, fault)))
    assert vec.simulation.coordinators[0].dropped()[reason] > 0


@pytest.mark.parametrize(
    ("lost", "phases"),
    [("Ack", {"PREPARE"}), ("Step", {"STEP"}), ("Done", {"DONE"}), ("Abort", set())],
)
def test_at03_what_is_sent_again_is_counted_by_phase(
    busy: Recorded, lost: str, phases: set[str]
) -> None:
    vec = replay(busy, 4, Faults(messages={lost: Rates(drop=0.5)}))
    (coordinator,) = vec.simulation.coordinators
    assert {phase for phase, count in coordinator.resent.items() if count} == phases
    figures = FaultFigures.of(vec.simulation, [])
    assert figures.resent == coordinator.resent
    figures.add(figures)
    assert sum(figures.to_dict()["resent"].values()) == 2 * coordinator.resent.total()


def test_at03_several_worlds_lose_their_own_messages() -> None:
    run = record("merge", {**QUICK, "population.mode": "respawn"}, STEPS, worlds=3)
    vec = replay(run, 4, Faults(seed=1, messages=NOISE))
    for coordinator in vec.simulation.coordinators:
        assert isinstance(coordinator.post, Network)
        assert coordinator.post.faults


class Decisions:
    """A watcher that keeps what was decided, without the name of the run."""

    def __init__(self) -> None:
        self.records: list[Record] = []
        self.delivered_kinds: list[tuple[int, str, int]] = []

    def logged(self, records: Iterable[Record]) -> None:
        self.records += [record for record in records if not isinstance(record, Commit | Reset)]

    def delivered(self, destination: int, message: Message) -> None:
        self.delivered_kinds.append((destination, type(message).__name__, message.tick))


def test_at07_a_seed_gives_the_same_run_twice(busy: Recorded) -> None:
    one, two, other = Decisions(), Decisions(), Decisions()
    replay(busy, 4, ROUGH, watchers=[one])
    replay(busy, 4, ROUGH, watchers=[two])
    replay(busy, 4, replace(ROUGH, seed=99), watchers=[other])
    assert one.records == two.records
    assert one.delivered_kinds == two.delivered_kinds
    assert one.delivered_kinds != other.delivered_kinds


def test_at07_when_faults_end_open_hand_overs_do_too(busy: Recorded) -> None:
    until, deferral = 20, 2
    seen = Decisions()
    faults = Faults(messages={"Ack": Rates(drop=1.0), "Step": Rates(drop=0.5)}, until=until)
    vec = replay(busy, 9, faults, watchers=[seen])
    begins = [record for record in seen.records if isinstance(record, Begin)]
    forced = {begin.tick for begin in begins for switch in begin.switches if switch.forced}
    assert forced
    assert max(forced) <= until + deferral + 2
    assert not any(begin.deferred for begin in begins if begin.tick > until + deferral + 2)
    assert vec.simulation.transfers[0].counts["switched"] > 0


@settings(max_examples=12, deadline=None)
@given(data=st.data())
def test_at09_any_plan_at_all(busy: Recorded, data: st.DataObject) -> None:
    zones = data.draw(st.sampled_from([2, 4, 9]), "zones")
    tick = st.integers(1, 2 * STEPS)
    lives = st.booleans()
    times = st.integers(1, 3)
    hosts = st.builds(
        Crash, tick, st.sampled_from(ZONE_POINTS), st.integers(0, zones - 1), lives, times
    )
    coordinators = st.builds(Crash, tick, st.sampled_from(COORDINATOR_POINTS))
    crashes = data.draw(
        st.lists(hosts | coordinators, max_size=6, unique_by=lambda c: (c.tick, c.zone)), "crashes"
    )
    rate = st.sampled_from([0.0, 0.1, 0.5])
    rates = st.builds(Rates, rate, rate, rate, rate, st.just(0.05), rate, st.integers(1, 64))
    kinds = data.draw(st.dictionaries(st.sampled_from(MESSAGES), rates, max_size=4), "messages")
    seed = data.draw(st.integers(0, 1000), "seed")
    replay(busy, zones, Faults(seed, kinds, tuple(crashes)))


def test_at13_a_refused_action_leaves_no_trace(busy: Recorded) -> None:
    faults = {"zones.faults": ROUGH.to_json()}
    vec = make_vec("grid4x4", num_envs=1, zones=4, overrides=busy.settings | faults)
    vec.reset(seed=busy.seed)
    coordinator = vec.simulation.coordinators[0]
    for step, actions in enumerate(busy.actions, start=1):
        tick = coordinator.tick
        wrong = actions.copy()
        wrong[0, 0, 0] = np.nan
        with pytest.raises(ActionError):
            vec.step(wrong)
        assert coordinator.tick == tick
        assert vec.state_hash() == busy.hashes[step - 1][0]
        vec.step(actions)
        assert vec.state_hash() == busy.hashes[step][0]
