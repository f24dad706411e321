"""The coordinator of a divided world in one process: its journal and its counts."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from cavmarl import make_vec
from cavmarl.core.errors import ProtocolError
from cavmarl.engine.world_setup import load_world
from cavmarl.handoff.coordinator import local_coordinator as direct
from cavmarl.handoff.coordinator.journal import JournalReader
from cavmarl.handoff.coordinator.journal_summary import owners_at
from cavmarl.handoff.coordinator.local_coordinator import LocalCoordinator
from cavmarl.ownership.log_records import replay as replay_records
from cavmarl.ownership.messages import Begin
from cavmarl.zones.kernels.ownership_changes import UNREAD_LIMIT
from cavmarl.zones.partition.zone_file import write_zones
from cavmarl.zones.partition.zone_partition import ZonePartition
from tests.cli.test_main import run as command
from tests.support.replayed import BUSY, QUICK, Recorded, record, replay

ZONES = 4
STEPS = 15


@pytest.fixture(scope="module")
def busy() -> Recorded:
    return record("grid4x4", BUSY, STEPS)


def test_the_journal_of_a_run_names_the_owners(busy: Recorded, tmp_path: Path) -> None:
    path = tmp_path / "run.jsonl"
    vec = replay(busy, ZONES, {"zones.journal": str(path)})
    table = vec.simulation.coordinators[0].directory.table
    records = tuple(JournalReader(path))
    told = replay_records(records)
    assert told.owners == table.owners
    assert told.hosts == table.hosts
    assert told.tick == table.tick == 2 * STEPS
    rows = dict(vec.simulation.division.owners(0))
    gone = {entry.vehicle for entry in vec.simulation.coordinators[0].notes()[1]}
    owners = {v: zone for v, (zone, _) in table.owners.items() if v not in gone}
    assert owners.items() <= rows.items()
    assert owners_at(path, table.tick).owners == table.owners
    assert command("journal", str(path)) == 0


def test_each_world_has_its_own_journal(tmp_path: Path) -> None:
    run = record("grid4x4", BUSY, 6, worlds=2)
    vec = replay(run, 2, {"zones.journal": str(tmp_path / "run.jsonl")})
    for w, coordinator in enumerate(vec.simulation.coordinators):
        told = replay_records(JournalReader(tmp_path / f"run.{w}.jsonl"))
        assert told.owners == coordinator.directory.table.owners


def just_before_the_end_of(edge: str, path: Path) -> Path:
    """Write two zones of grid4x4; the right one begins 11 m before the end of an edge."""
    roads = load_world("grid4x4").network
    lane = roads.lanes[int(roads.edges[roads.edge_ids.index(edge)]["first_lane"])]
    end_x = float(roads.points[int(lane["first_point"] + lane["num_points"]) - 1]["x"])
    cut_x = end_x - 11.0
    low_x, low_y, high_x, high_y = roads.extent_m
    rects = [
        (low_x - 9.0, low_y - 9.0, cut_x, high_y + 9.0),
        (cut_x, low_y - 9.0, high_x + 9.0, high_y + 9.0),
    ]
    bounds = (rects[0][0], rects[0][1], rects[1][2], rects[1][3])
    write_zones(path, ZonePartition(bounds, np.array(rects)))
    return path


def test_the_row_of_a_transfer_marks_a_vehicle_that_leaves_in_the_same_tick(tmp_path: Path) -> None:
    """The trip ends 3.5 m beyond the border, and a car moves up to 2.8 m per tick."""
    demand = tmp_path / "grid.rou.xml"
    demand.write_text(
        '<routes><flow id="a" from="C3D3" to="D3right3" begin="0" end="60" period="2"/></routes>',
        encoding="utf-8",
    )
    settings = {
        **QUICK,
        "population.mode": "respawn",
        "population.agents": 1,
        "population.background": 0,
        "traffic.demand": [str(demand)],
        "zones.layout": str(just_before_the_end_of("D3right3", tmp_path / "zones.json")),
        "zones.hysteresis_m": 0.0,
    }
    run = record("grid4x4", settings, 150)
    log = replay(run, 2).simulation.transfers[0]
    gone = [row.removed for row in log.rows]
    assert 3 < sum(gone) < len(gone) - 3
    assert log.counts["removed"] == sum(gone)
    assert [row.release_depth_m is None for row in log.rows] == gone


def test_the_offer_of_a_vehicle_that_turns_away_from_a_border_is_withdrawn() -> None:
    run = record("grid4x4", {**BUSY, "zones.approach_ticks": 30}, 2 * STEPS)
    simulation = replay(run, ZONES).simulation
    assert simulation.transfers[0].counts["aborted"] > 0
    assert len(simulation.coordinators[0].in_flight()) > 5


def test_a_world_with_few_vehicles_has_room_for_many_unread_changes() -> None:
    whole, divided = (
        make_vec("ring", zones=zones, agents=2, background=3, max_cycles=1000) for zones in (1, 4)
    )
    book, most = divided.simulation.division.book, 0
    for vec in (whole, divided):
        vec.reset(seed=1)
    for _ in range(500):
        for vec in (whole, divided):
            vec.step(vec.suggest_actions())
        most = max(most, int(book.num_changes[0]))
    assert most > 3 * divided.simulation.capacity
    assert UNREAD_LIMIT - 1 + divided.simulation.capacity <= book.changes.shape[1]
    assert whole.state_hash() == divided.state_hash()


def test_the_table_is_updated_on_request_or_after_many_changes(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    late = 16  # a small number, which the run reaches soon
    monkeypatch.setattr(direct, "UNREAD_LIMIT", late)
    vec = make_vec("grid4x4", zones=ZONES, overrides=BUSY)
    vec.reset(seed=1)
    simulation = vec.simulation
    (coordinator,), (log,) = simulation.coordinators, simulation.transfers
    assert isinstance(coordinator, LocalCoordinator)
    directory, book = coordinator.directory, simulation.division.book
    for _ in range(3 * STEPS):
        vec.step(vec.suggest_actions())
    assert 0 < book.num_changes[0] < late
    assert directory.table.tick < coordinator.tick == 6 * STEPS
    assert len(log.rows) == simulation.migrations > late
    assert directory.table.tick == coordinator.tick
    assert book.num_changes[0] == 0
    owners = {v: zone for v, (zone, _) in coordinator.directory.table.owners.items()}
    born = dict(entry[:2] for entry in coordinator.notes()[0])
    gone = {entry.vehicle for entry in coordinator.notes()[1]}
    on_record = {v: zone for v, zone in (owners | born).items() if v not in gone}
    assert on_record == dict(simulation.division.owners(0))


def test_a_change_from_a_zone_that_is_not_the_recorded_owner_is_detected() -> None:
    vec = make_vec("grid4x4", zones=ZONES, overrides=BUSY)
    vec.reset(seed=1)
    (coordinator,) = vec.simulation.coordinators
    assert isinstance(coordinator, LocalCoordinator)
    vec.step(vec.suggest_actions())
    directory, book = coordinator.directory, vec.simulation.division.book
    assert directory.table.owners, "the initial vehicles are not on record"
    while not book.num_changes[0]:
        vec.step(vec.suggest_actions())
    vehicle, target, epoch = book.changes[0, 0][["vehicle", "target", "epoch"]].tolist()
    directory.table.owners[vehicle] = (target, epoch - 1)
    with pytest.raises(ProtocolError, match=f"vehicle {vehicle} changed .* owner on record"):
        _ = coordinator.directory


def test_a_lost_vehicle_is_detected(busy: Recorded) -> None:
    vec = make_vec("grid4x4", zones=4, overrides=BUSY)
    vec.reset(seed=1)
    lost = vec.simulation.shards[1].worlds.num_owned
    with pytest.raises(ProtocolError, match=r"zones own \[.*\] vehicles, but .* are expected"):  # noqa: PT012
        for step in range(STEPS):
            lost[0] -= step == 0
            vec.step(vec.suggest_actions())


def test_the_journal_distinguishes_actions(tmp_path: Path) -> None:
    told = []
    for name, throttle in (("one", 0.0), ("again", 0.0), ("other", 0.5)):
        path = tmp_path / f"{name}.jsonl"
        settings = {"zones.count": 4, "zones.journal": str(path)}
        vec = make_vec("grid4x4", num_envs=1, agents=4, background=10, overrides=settings)
        vec.reset(seed=3)
        for _ in range(3):
            vec.step(np.full((1, vec.num_agents, 2), throttle, dtype=np.float32))
        told.append([record.inputs for record in JournalReader(path) if isinstance(record, Begin)])
    one, again, other = told
    assert one == again
    assert all(len(inputs) == 16 for inputs in one)
    assert not set(one) & set(other)


def test_an_undivided_world_can_have_a_journal(tmp_path: Path) -> None:
    path = tmp_path / "one.jsonl"
    settings = {"zones.journal": str(path), "zones.check_invariants": True}
    vec = make_vec("grid4x4", num_envs=1, agents=4, background=10, overrides=settings)
    vec.reset(seed=3)
    for _ in range(5):
        vec.step(np.zeros((1, vec.num_agents, 2), dtype=np.float32))
    (coordinator,) = vec.simulation.coordinators
    owners = owners_at(path, coordinator.tick).owners
    assert set(owners) == set(vec.simulation.vehicles()["id"].tolist())
    assert {zone for zone, _ in owners.values()} == {0}
    undivided = make_vec("grid4x4", num_envs=1, agents=4, background=10)
    assert not undivided.simulation.coordinators, "a world without a journal keeps a log"
