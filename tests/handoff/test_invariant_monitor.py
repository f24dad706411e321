"""The monitor detects each deliberate violation of an invariant of a divided world."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from cavmarl.core.errors import ProtocolError
from cavmarl.engine.simulation import Simulation
from cavmarl.handoff import shard_setup as dividing
from cavmarl.handoff.coordinator.invariant_monitor import InvariantMonitor
from cavmarl.handoff.division import ZonedShards
from cavmarl.ownership.messages import Birth
from cavmarl.zones.kernels.zone_lookup import is_inside, squared_distance
from tests.support.driving import drive, make_simulation, start
from tests.support.held_entries import held_entries
from tests.support.world import coordination_of

STEPS = 8


def watched(env: str = "grid4x4", worlds: int = 1, **overrides: Any) -> Simulation:
    simulation = make_simulation(
        env,
        mode="respawn",
        agents=4,
        background=40,
        num_worlds=worlds,
        overrides={
            "zones.count": 4, "zones.check_invariants": True, "clock.sim_dt_s": 0.1, **overrides,
        },
    )  # fmt: skip
    start(simulation, seed=1)
    return simulation


@pytest.fixture
def simulation() -> Simulation:
    """Return a divided world after some steps."""
    found = watched()
    for _ in range(STEPS):
        drive(found)
    return found


@pytest.mark.parametrize("env", ["ring", "merge", "grid4x4", "town"])
def test_a_correct_run_passes_the_monitor(env: str) -> None:
    simulation = watched(env, worlds=2)
    for _ in range(25):
        drive(simulation)
    simulation.reset(np.array([False, True]))
    for _ in range(5):
        drive(simulation)


class RowChanger:
    """A monitor that first changes rows and then checks them."""

    def __init__(self, simulation: Simulation, monkeypatch: pytest.MonkeyPatch) -> None:
        self.simulation, self._patch = simulation, monkeypatch
        self.division: ZonedShards = simulation.division

    def zone(self, zone: int) -> tuple[Any, int, int]:
        """Return the rows of a zone, and the numbers of owned and of all rows."""
        worlds = self.simulation.shards[zone].worlds
        return worlds.rows[0], int(worlds.num_owned[0]), int(worlds.num_rows[0])

    def caught(self, change: Any, words: str) -> None:
        look = InvariantMonitor.end

        def end(*arguments: Any) -> None:
            change()
            look(*arguments)

        self._patch.setattr(InvariantMonitor, "end", end)
        with pytest.raises(ProtocolError, match=words):
            drive(self.simulation)


def a_vehicle_that_two_zones_own(world: RowChanger) -> None:
    rows, owned, _ = world.zone(1)
    others = world.simulation.shards[2].worlds
    rows[owned] = others.rows[0, 0]
    world.simulation.shards[1].worlds.num_owned[0] += 1


def a_vehicle_that_is_advanced_twice(world: RowChanger) -> None:
    world.zone(0)[0]["tick"][0] += 1


def a_vehicle_that_jumps(world: RowChanger) -> None:
    world.zone(3)[0]["x"][0] += 40.0


def a_vehicle_without_a_place(world: RowChanger) -> None:
    world.zone(3)[0]["x"][0] = np.nan


def a_vehicle_that_is_lost(world: RowChanger) -> None:
    rows, owned, num = world.zone(2)
    worlds = world.simulation.shards[2].worlds
    rows[owned - 1 : num - 1] = rows[owned:num].copy()
    worlds.num_owned[0] -= 1
    worlds.num_rows[0] -= 1


def a_vehicle_that_has_never_entered(world: RowChanger) -> None:
    rows, owned, _ = world.zone(2)
    rows[owned] = rows[0]
    rows[owned]["id"], rows[owned]["tick"] = 9_999, world.simulation.ticks()[0] - 1
    world.simulation.shards[2].worlds.num_owned[0] += 1


def a_row_whose_epoch_is_not_that_on_record(world: RowChanger) -> None:
    world.zone(1)[0]["epoch"][0] += 1


def a_row_that_is_with_another_zone_than_on_record(world: RowChanger) -> None:
    source, target = (world.simulation.shards[zone].worlds for zone in (0, 1))
    own, other = source.rows[0, 0].copy(), target.rows[0, 0].copy()
    source.rows[0, 0], target.rows[0, 0] = other, own


def a_clock_that_is_late(world: RowChanger) -> None:
    shard = world.simulation.shards[2]
    shard.worlds = shard.worlds._replace(ticks=shard.worlds.ticks - 1)


def a_ghost_of_the_tick_before(world: RowChanger) -> None:
    rows, owned, num = world.zone(1)
    assert num > owned
    rows[owned]["tick"] -= 1


def a_ghost_with_a_changed_field(world: RowChanger) -> None:
    rows, owned, _ = world.zone(1)
    rows[owned]["speed"] += 0.5


def a_ghost_that_is_not_there(world: RowChanger) -> None:
    world.simulation.shards[1].worlds.num_rows[0] -= 1


VIOLATIONS = {
    a_vehicle_that_two_zones_own: r"one owner: vehicle \d+ is owned by zones \[1, 2",
    a_vehicle_that_is_advanced_twice: r"advanced once a tick: vehicle \d+ of zone 0 is at tick",
    a_vehicle_that_jumps: r"continuity: vehicle \d+ of zone 3 moved \d+\.\d+ m in a tick, from",
    a_vehicle_without_a_place: r"tick \d+ of world 0: continuity: vehicle \d+ .* moved nan m",
    a_vehicle_that_is_lost: r"population: vehicle \d+ of zone 2, epoch \d+, is lost: there are",
    a_vehicle_that_has_never_entered: r"population: vehicle 9999 of zone 2 has never entered",
    a_row_whose_epoch_is_not_that_on_record: r"owner on record: zone 1 owns vehicle \d+ at",
    a_row_that_is_with_another_zone_than_on_record: r"owner on record: zone \d owns vehicle \d+ at",
    a_clock_that_is_late: r"one clock: zone 2 is at tick \d+, not at \d+",
    a_ghost_of_the_tick_before: r"age of ghosts: zone 1 has a ghost of vehicle \d+ with tick = ",
    a_ghost_with_a_changed_field: r"age of ghosts: .* ghost of vehicle \d+ with speed",
    a_ghost_that_is_not_there: r"ghosts: zone 1 has 0 ghosts of vehicle \d+, not 1: the vehicle",
}


@pytest.mark.parametrize("change", VIOLATIONS, ids=lambda change: change.__name__)
def test_the_monitor_detects_each_violation(
    change: Callable[[RowChanger], None], simulation: Simulation, monkeypatch: pytest.MonkeyPatch
) -> None:
    world = RowChanger(simulation, monkeypatch)
    world.caught(lambda: change(world), VIOLATIONS[change])


@pytest.fixture
def narrow(monkeypatch: pytest.MonkeyPatch) -> RowChanger:
    """Return a world whose zones do not see the whole map and have room for more ghosts."""
    monkeypatch.setattr(dividing, "halo_m", lambda *_: 60.0)
    found = watched()
    drive(found)
    return RowChanger(found, monkeypatch)


def test_a_duplicated_ghost_is_detected(narrow: RowChanger) -> None:
    def change() -> None:
        rows, owned, num = narrow.zone(1)
        rows[num] = rows[owned]
        narrow.simulation.shards[1].worlds.num_rows[0] += 1

    narrow.caught(
        change, r"ghosts: zone 1 has 2 ghosts of vehicle \d+, not 1: the vehicle of zone \d is"
    )


def test_a_needless_ghost_is_detected(narrow: RowChanger) -> None:
    def change() -> None:
        rows, _, num = narrow.zone(1)
        others, owned, _ = narrow.zone(2)
        rects = narrow.division.zones.rects
        away = [squared_distance(rects, 1, row["x"], row["y"]) for row in others[:owned]]
        rows[num] = others[int(np.argmax(away))]
        narrow.simulation.shards[1].worlds.num_rows[0] += 1

    narrow.caught(
        change, r"ghosts: zone 1 has 1 ghosts of vehicle \d+, not 0: the vehicle of zone 2 is"
    )


def test_a_ghost_of_a_missing_vehicle_is_detected(narrow: RowChanger) -> None:
    def change() -> None:
        rows, _, num = narrow.zone(1)
        rows[num]["id"] = 7_777
        narrow.simulation.shards[1].worlds.num_rows[0] += 1

    narrow.caught(change, r"ghosts: zone 1 has a ghost of vehicle 7777, which does not exist")


def test_a_recorded_arrival_of_a_present_vehicle_is_detected(
    narrow: RowChanger, monkeypatch: pytest.MonkeyPatch
) -> None:
    """All sums are correct, because the vehicle is far from borders and has no ghost."""
    coordination: Any = coordination_of(narrow.simulation)
    coordinator = coordination.coordinators[0]

    def change() -> None:
        rows, owned, num = narrow.zone(1)
        rect = narrow.division.halo.inner[1]
        inside = [is_inside(rect, row["x"], row["y"]) for row in rows[:owned]]
        rows[owned + 1 : num + 1] = rows[owned:num].copy()
        rows[owned] = rows[inside.index(True)]
        rows[owned]["id"] = vehicle = narrow.zone(2)[0][0]["id"]
        rows[owned]["epoch"], rows[owned]["tick"] = 0, narrow.simulation.ticks()[0] - 1
        worlds = narrow.simulation.shards[1].worlds
        worlds.num_owned[0] += 1
        worlds.num_rows[0] += 1
        monkeypatch.setattr(coordinator, "notes", lambda: ((Birth(int(vehicle), 1, b""),), ()))

    narrow.caught(change, r"one owner: vehicle \d+ is owned by zones \[1, 2\]")


def test_an_unrecorded_arrival_is_detected(monkeypatch: pytest.MonkeyPatch) -> None:
    simulation = watched()
    coordination: Any = coordination_of(simulation)
    coordinator = coordination.coordinators[0]
    monkeypatch.setattr(coordinator, "notes", lambda: ((Birth(8_888, 0, b""),), ()))
    with pytest.raises(ProtocolError, match="vehicle 8888 of zone 0, epoch 0, is lost"):
        drive(simulation)


def test_the_memory_of_the_monitor_does_not_grow(monkeypatch: pytest.MonkeyPatch) -> None:
    monitors: set[InvariantMonitor] = set()
    look = InvariantMonitor.end

    def end(monitor: InvariantMonitor, *arguments: Any) -> None:
        monitors.add(monitor)
        look(monitor, *arguments)

    monkeypatch.setattr(InvariantMonitor, "end", end)
    simulation = watched()
    held = []
    for _ in range(100):
        drive(simulation)
        held.append(held_entries(*monitors))
    assert max(held[50:]) <= max(held[:25])


def test_the_ghosts_of_a_view_are_read_only(simulation: Simulation) -> None:
    ghosts = simulation.zones.ghosts(1)
    assert len(ghosts)
    with pytest.raises(ValueError, match="read-only"):
        ghosts["x"][0] = 0.0
    with pytest.raises(ValueError, match="read-only"):
        ghosts[0]["x"] = 0.0


def test_worlds_resume_from_a_saved_state_with_the_monitor(simulation: Simulation) -> None:
    """The monitor takes its tick from the state, and still detects a zone at another tick."""
    saved = [array.copy() for array in simulation.save()]
    hashes = []
    for _ in range(2):
        simulation.load(saved)
        for _ in range(3):
            drive(simulation)
        hashes.append(simulation.state_hash())
    assert hashes[0] == hashes[1]
    for shard in simulation.shards[1:]:
        shard.worlds.ticks[0] += 1
    with pytest.raises(ProtocolError):
        drive(simulation)
