"""The service restores owners of vehicles and members of sessions from its log.

With `zone_nodes`, the zones of a session are divided into that many parts. `members` names the node
of each part. The session's own node leads the parts; they connect to its door, a network address.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest

from cavmarl.core.errors import ServiceError
from cavmarl.service.request_bodies import DoorBody, TransfersBody
from cavmarl.service.service_records import KEPT_OWNERS, Infrastructure
from cavmarl.service.session_worlds import SessionWorld
from tests.support.fleet import Fleet

DOOR = DoorBody(host="127.0.0.1", port=9, key="0" * 64)


@pytest.fixture
def fleet(tmp_path: Path) -> Iterator[Fleet]:
    made = Fleet(tmp_path / "store.sqlite")
    yield made
    made.close()


def test_owners_and_members_are_restored_from_the_log(fleet: Fleet) -> None:
    fleet.join("a", "b", "c")
    session = fleet.open(zone_nodes=2)
    rows = [[0, 1, 5, 7, 0, 1, 1], [0, 1, 6, 8, 1, 0, 1], [0, 1, 9, 7, 1, 2, 2]]
    fleet.broker.hand_over(session, TransfersBody(at=3, transfers=rows, prepared=[[0, 8, 0, 2]]))
    assert session.owners["0"].zones == {8: [0, 1], 7: [2, 2]}
    assert fleet.broker.prepared[session.id] == [[0, 8, 0, 2]]
    fleet.log.flush()
    replayed = Infrastructure()
    for line in fleet.log.store.read():
        replayed.apply(line)
    assert asdict(replayed.sessions[session.id]) == asdict(session)
    fleet.broker.hand_over(session, TransfersBody(at=4, transfers=[[0, 2, 1, 1, 0, 1, 1]]))
    assert session.owners["0"].zones == {1: [1, 1]}  # only the owners of the new episode
    assert fleet.broker.prepared[session.id] == []


def test_only_the_newest_owners_are_stored(fleet: Fleet) -> None:
    fleet.join("a")
    session = fleet.open()
    rows = [[0, 0, 1, vehicle, 0, 1, 1] for vehicle in range(KEPT_OWNERS + 5)]
    for first in range(0, len(rows), 2000):
        some = rows[first : first + 2000]
        fleet.broker.hand_over(session, TransfersBody(at=1, transfers=some))
    assert [*session.owners["0"].zones] == [*range(5, KEPT_OWNERS + 5)]


def test_lost_members_are_replaced_and_get_the_address_of_their_leader(fleet: Fleet) -> None:
    fleet.join("a", "b", "c")
    session = fleet.open(preferred="a", zone_nodes=2)
    assert session.node == "a"
    first, second = session.members
    assert first != second
    assert fleet.beat("a")["without_door"] == [session.id]
    fleet.broker.zone_nodes.open_door(session, DOOR)
    assert fleet.beat("a")["without_door"] == []
    task = {"session": session.id, **DOOR.model_dump()}
    assert [fleet.beat(name)["zones_of"] for name in (first, second)] == [[task], [task]]
    fleet.broker.drain(fleet.nodes, second)
    fleet.broker.sweep()
    assert second not in session.members
    assert len(session.members) == 2
    assert fleet.beat(second)["zones_of"] == []
    fleet.broker.close(fleet.client, session.id)
    assert all(not live.zones_of for live in fleet.broker.live.values())


def test_a_node_may_have_several_parts_of_a_session(fleet: Fleet) -> None:
    fleet.join("a", slots=3)
    session = fleet.open(zone_nodes=4)
    assert session.members == ["a", "a"]  # the leader takes the third slot of a
    fleet.join("b")
    fleet.broker.sweep()
    assert session.members == ["a", "a", "b", "b"]


def test_a_repeated_request_with_the_same_key_is_executed_once(fleet: Fleet) -> None:
    fleet.join("a", slots=8)
    session = fleet.open(key="k-1")
    assert fleet.open(key="k-1").id == session.id
    assert fleet.open(key="k-2").id != session.id
    assert fleet.open().id != fleet.open().id
    with pytest.raises(ServiceError, match="another request") as refused:
        fleet.open(key="k-1", needs=["gpu"])
    assert refused.value.problem == "conflict"
    other = fleet.identity("bob", "client")
    assert fleet.broker.open(other, session.configuration, key="k-1").id != session.id
    fleet.broker.close(fleet.client, session.id)
    with pytest.raises(ServiceError, match="closed"):
        fleet.open(key="k-1")


def test_a_session_reports_each_finished_transfer_once_and_also_prepared_transfers() -> None:
    document = {"environment": "grid4x4", "num_envs": 1, "seed": 0, "overrides": {}}
    document |= {"zones": 4, "agents": 4, "background": 40, "max_cycles": None}
    world = SessionWorld(document, None, 0, {})
    world.command(1, lambda: world.reset(0), is_quiet=True)
    prepared, told = [], []
    idle = np.zeros(world.describe()["action"]["shape"], np.float32).tobytes()
    for number in range(2, 60):
        world.command(number, lambda: world.step(idle), is_quiet=True)
        found = world.ownership()
        prepared += found["prepared"]
        told += found["transfers"]
    assert prepared
    assert [tuple(row[2:]) for row in told] == [
        (row["tick"], row["vehicle"], row["source"], row["target"], row["epoch"])
        for row in world.transfers()
    ]
    assert world.num_transfers == len(told)
    world.close()
