"""Leases of several ticks, and vehicles that cross a border before the coordinator knows them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest

from cavmarl.config.env import EnvConfig
from cavmarl.config.registry import load_config
from cavmarl.engine.world_setup import make_world
from cavmarl.handoff.division import ZonedShards
from cavmarl.handoff.shard_setup import limits_of, neighbours_of
from cavmarl.ownership.ledger import state_digest
from cavmarl.ownership.messages import COORDINATOR, Ack, Message, Offer, Prepare
from cavmarl.parallel.network.transport import Bytes
from cavmarl.parallel.nodes.index_check import IndexCheck
from cavmarl.parallel.nodes.leases import MOST, late_ticks, lease_ticks, leases_of
from cavmarl.parallel.nodes.link import FrameKind, NodeFrame
from cavmarl.parallel.nodes.node_coordinator import NodeCoordinator
from cavmarl.parallel.nodes.zone_endpoints import (
    Report,
    ZoneEndpoints,
    packed,
    read_report,
    unpacked,
)
from cavmarl.parallel.worlds.local_worlds import LocalWorlds

WAIT_S = 0.1


@pytest.mark.parametrize("ticks", range(1, 2 * MOST + 2))
def test_a_lease_covers_the_ticks_of_a_step(ticks: int) -> None:
    config = config_with_ticks(ticks)
    each = lease_ticks(config)
    assert each <= MOST
    assert (leases_of(ticks, each) - 1) * each < ticks <= leases_of(ticks, each) * each
    assert leases_of(0, each) == 0
    assert late_ticks(config) == each - 1


def config_with_ticks(ticks: int) -> EnvConfig:
    """Return settings with this number of ticks per step."""
    overrides = {"clock.ctrl_dt_s": 0.05 * ticks, "clock.sim_dt_s": 0.05}
    overrides["horizon_s"] = 5.0 * ticks
    return load_config("grid4x4", zones=2, overrides=overrides)[0]


def test_the_halo_grows_with_the_ticks_of_a_lease() -> None:
    config, base_dir = load_config("grid4x4", zones=2, agents=1)
    world = make_world(config, base_dir)
    halos = [
        LocalWorlds(world, 1, late_ticks=late).simulation.division.halo.halo_m for late in (0, 1, 3)
    ]
    tick_m = halos[1] - halos[0]
    assert tick_m > 0
    assert halos[2] - halos[0] == pytest.approx(3 * tick_m)


class Wires:
    """Links that store each sent frame and deliver it at once to the coordinator."""

    def __init__(self) -> None:
        self.reports: list[list[Report]] = []
        self.answers: list[Message] = []
        self.coordinator: NodeCoordinator | None = None

    def send(self, to: int, kind: FrameKind, number: int, pieces: Sequence[Bytes] = ()) -> None:
        assert to == COORDINATOR
        assert self.coordinator is not None
        data = memoryview(b"".join(pieces))
        if kind is FrameKind.REPORT:
            messages, said, _ = read_report(data, 1)
            self.reports.append(said)
            self.coordinator.commit({0: (messages, said)})
        else:
            self.answers += [message for _, message in unpacked(data)]
            self.coordinator.receive(0, NodeFrame(kind, number, data))

    def now_s(self) -> float:
        return 0.0


def make_endpoints() -> tuple[ZoneEndpoints, NodeCoordinator, ZonedShards, Any]:
    """Return the endpoints of two zones of one node, before they report a new episode."""
    config, base_dir = load_config("grid4x4", zones=2, agents=1, background=20)
    worlds = LocalWorlds(make_world(config, base_dir), 1)
    worlds.arrays.chosen[:] = True
    worlds.reset(1, 0)
    division = worlds.simulation.division
    wires: Any = Wires()
    limits = limits_of(config.zones, division.codec.schema)
    coordinator = NodeCoordinator([bytes(16)], [0, 0], limits, wires, [None])
    wires.coordinator = coordinator
    hostings = coordinator.host(neighbours_of(division))
    checks = IndexCheck(worlds.simulation)
    hosts = ZoneEndpoints(
        division, (0, 1), (0, 0), hostings, limits, wires, [], checks, [], ticks=2
    )
    hosts.reset(np.ones(1, dtype=np.bool_))
    return hosts, coordinator, division, wires


def test_a_new_vehicle_beyond_the_border_is_offered_in_a_lease_of_no_ticks() -> None:
    hosts, coordinator, division, wires = make_endpoints()
    row = division.owned(0, 0)[0]
    there = division.owned(0, 1)[0]
    row["x"], row["y"] = (
        there["x"],
        there["y"],
    )  # zone 0 owns the vehicle, whose position is now far beyond the border

    hosts.report()
    ((report,),) = wires.reports
    assert (report.movers, report.is_late, coordinator.is_late) == ([], True, True)
    hosts.note(unpacked(memoryview(coordinator.begin(WAIT_S)[0])))
    (report,) = wires.reports[1]
    assert [mover[:2] for mover in report.movers] == [[int(row["id"]), 1]]
    assert (report.is_late, coordinator.is_late, coordinator.switched) == (False, False, 0)
    coordinator.begin(WAIT_S)
    assert coordinator.switched == 1


def test_an_offer_before_the_lease_of_its_episode_is_answered_after_the_lease() -> None:
    hosts, coordinator, division, wires = make_endpoints()
    hosts.report()
    table = coordinator.worlds[0].directory.table
    vehicle = int(division.owned(0, 0)[0]["id"])
    state = division.changes.state(0, 0, 0)
    offer = Offer(vehicle, 0, state_digest(state), state)
    prepare = Prepare(
        bytes(16), table.episode, table.tick + 1, 0, 1, 1, division.codec.schema, (offer,)
    )
    hosts.receive(0, NodeFrame(FrameKind.MESSAGES, 0, memoryview(packed([(0, prepare)]))))
    assert wires.answers == []
    hosts.note(unpacked(memoryview(coordinator.begin(WAIT_S)[0])))
    (ack,) = wires.answers
    assert isinstance(ack, Ack)
    assert (ack.zone, ack.entries[0].vehicle) == (1, vehicle)
