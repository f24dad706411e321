"""Plans of faults over nodes: messages that are harmed and nodes that die change no bit."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import psutil
import pytest

from cavmarl import ConfigError, make_vec
from cavmarl.core.errors import MessageError
from cavmarl.env.vector import CavVectorEnv
from cavmarl.handoff.coordinator.journal import JournalReader
from cavmarl.handoff.fault_injection.fault_plan import MESSAGES, ZONE_POINTS, Faults
from cavmarl.ownership.decisions import Neighbours
from cavmarl.ownership.limits import Limits
from cavmarl.ownership.messages import COORDINATOR, Ack, Begin, Held, Message
from cavmarl.ownership.transport import Rates
from cavmarl.parallel.nodes import faulty_coordinator
from cavmarl.parallel.nodes.fault_phases import (
    Parcel,
    PhasedPost,
    Said,
    Told,
    packed_parcels,
    unpacked_parcels,
)
from cavmarl.parallel.nodes.faulty_coordinator import FaultyNodeCoordinator
from cavmarl.parallel.nodes.links import LinkLostError
from cavmarl.parallel.nodes.node_worlds import NodeWorlds
from cavmarl.verify.simulated_nodes import verify_simulated_nodes
from tests.support.vec_runs import Make, drive, same

WANTED: dict[str, Any] = {"agents": 8, "background": 30, "max_cycles": 20}
EACH = {"drop": 0.3, "delay": 0.2, "duplicate": 0.3, "reorder": 0.3, "corrupt": 0.2}
ROUGH: dict[str, Any] = dict.fromkeys(MESSAGES, EACH) | {"Prepare": {**EACH, "refuse": 0.2}}
LOST: dict[str, Any] = {"Prepare": {"drop": 1.0}}


def over_nodes(vec: CavVectorEnv) -> NodeWorlds:
    assert isinstance(vec.worlds, NodeWorlds)
    return vec.worlds


def planned(**plan: Any) -> dict[str, Any]:
    return {"zones.faults": json.dumps(plan), "zones.check_invariants": True}


def begun(path: Path) -> list[Begin]:
    return [record for record in JournalReader(path) if isinstance(record, Begin)]


def test_messages_of_all_kinds_are_harmed(make: Make) -> None:
    whole = drive(make("grid4x4", num_envs=2, **WANTED), steps=9)
    overrides = planned(seed=4, messages=ROUGH)
    vec = make("grid4x4", num_envs=2, zones=4, nodes=3, overrides=overrides, **WANTED)
    assert same(drive(vec, steps=9), whole)
    worlds = over_nodes(vec)
    kinds, faults = map(set, zip(*worlds.injected, strict=True))
    assert kinds >= {"Step", "Done", "Prepare", "Ack"}
    assert faults == {*EACH, "refuse"}
    assert (worlds.losses, worlds.recoveries) == (0, 0)
    assert worlds.migrations > 4


@pytest.mark.parametrize("nodes", [1, 2])
def test_a_vehicle_whose_offers_are_lost_is_handed_over_with_its_state(
    make: Make, tmp_path: Path, nodes: int
) -> None:
    """It stays as long as `zones.max_deferred_ticks` says; the same plan gives the same run."""
    whole = drive(make("grid4x4", **WANTED))
    runs = []
    for name in ("one.jsonl", "two.jsonl"):
        overrides = planned(messages=LOST) | {"zones.journal": str(tmp_path / name)}
        vec = make("grid4x4", zones=4, nodes=nodes, overrides=overrides, **WANTED)
        assert same(drive(vec), whole)
        assert set(over_nodes(vec).injected) == {("Prepare", "drop")}
        vec.close()
        runs.append(begun(tmp_path / name))
    assert runs[0] == runs[1]
    switches = [switch for record in runs[0] for switch in record.switches]
    waited = [entry.ticks for record in runs[0] for entry in record.deferred]
    assert len(switches) > 3
    assert all(switch.forced for switch in switches)
    assert max(waited) == vec.config.zones.max_deferred_ticks == 2


def test_a_plan_is_over_when_it_says_so(make: Make) -> None:
    overrides = planned(messages=ROUGH, until=3)
    vec = make("grid4x4", zones=4, nodes=2, overrides=overrides, **WANTED)
    drive(vec, steps=2)
    worlds = over_nodes(vec)
    before = worlds.injected.total()
    vec.step(vec.suggest_actions())
    assert worlds.injected.total() == before > 0


def test_a_node_dies_where_the_plan_says(make: Make) -> None:
    whole = drive(make("grid4x4", **WANTED))
    deaths = [{"tick": 9, "point": "lease taken", "zone": 3}]
    overrides = planned(messages=ROUGH, crashes=deaths)
    vec = make("grid4x4", zones=4, nodes=2, overrides=overrides, **WANTED)
    worlds = over_nodes(vec)
    before = worlds.pids
    assert same(drive(vec), whole)
    assert (worlds.losses, worlds.recoveries) == (1, 1)
    assert not psutil.pid_exists(before[1])
    assert psutil.pid_exists(before[0])


@pytest.mark.parametrize("mix", ["none", "kill", "lose"])
def test_simulated_nodes_fail_beside_the_plan(mix: str) -> None:
    found = verify_simulated_nodes(
        "merge", [3], mixes=[mix], seeds=3, agents=3, background=20, zones=3, steps=8,
        overrides=planned(messages=ROUGH),
    )  # fmt: skip
    (line,) = found.lines
    assert found.holds, line.wrong
    assert line.ended == 0
    assert (line.lost > 0) == (mix != "none")


@pytest.mark.parametrize("point", ["STEP arrives", "advance", "before DONE"])
def test_simulated_nodes_die_at_points(point: str) -> None:
    assert deaths_at(point, tick=9, nodes=[2, 3], seeds=1, messages={}) == 2


@pytest.mark.slow
@pytest.mark.parametrize("tick", [5, 18])
def test_simulated_nodes_die_at_every_point_while_messages_are_harmed(tick: int) -> None:
    died = {
        point: deaths_at(point, tick=tick, nodes=[2, 3, 4], seeds=2, messages=ROUGH)
        for point in ZONE_POINTS
    }
    always = {"STEP arrives", "lease taken", "advance", "resolve", "commit"}
    assert all(died[point] == 6 for point in always | {"detect", "before DONE"})


def deaths_at(point: str, tick: int, nodes: list[int], seeds: int, messages: dict[str, Any]) -> int:
    """A node dies there, and nothing changes; how many did, for each number of nodes and seed."""
    deaths = [{"tick": tick, "point": point, "zone": 1}]
    found = verify_simulated_nodes(
        "merge", nodes, mixes=["none"], seeds=seeds, agents=3, background=20, zones=4, steps=10,
        overrides=planned(messages=messages, crashes=deaths),
    )  # fmt: skip
    assert found.holds, [line.wrong for line in found.lines]
    assert all((line.ended, line.lost) == (0, line.back) for line in found.lines)
    return sum(line.lost for line in found.lines)


@pytest.mark.parametrize(
    ("faults", "more", "words"),
    [
        ({"crash_rate": 0.01}, {}, "crash_rate: not over nodes.*name deaths in crashes"),
        ({"crashes": [{"tick": 3, "point": "all done"}]}, {}, "caller's process; name a zone"),
        (
            {"crashes": [{"tick": 3, "point": "advance", "zone": 0, "lives_on": True}]},
            {},
            "lives_on: not over nodes.*leave it out",
        ),
        (
            {"crashes": [{"tick": 3, "point": "advance", "zone": 0, "times": 2}]},
            {},
            "times: not over nodes.*name several",
        ),
        ({"crashes": [{"tick": 3, "point": "advance", "zone": 2}]}, {}, "there are 2 zones"),
        (
            {"crashes": [{"tick": 3, "point": "advance", "zone": 0}]},
            {"num_envs": 2},
            "one world at a time, not in 2",
        ),
        ({"messages": {"Letter": {}}}, {}, "are none of Step"),
        ("nowhere.json", {}, "nowhere.json: No such file.*name a file of JSON"),
    ],
)
def test_plans_that_cannot_be(faults: Any, more: dict[str, Any], words: str) -> None:
    text = faults if isinstance(faults, str) else json.dumps(faults)
    overrides = {"zones.faults": text, **more.pop("overrides", {})}
    with pytest.raises(ConfigError, match=words):
        make_vec("grid4x4", zones=2, nodes=2, overrides=overrides, **more)


def ack(zone: int) -> Message:
    return Ack(bytes(16), 0, 0, zone, 1, 1 - zone, (Held(5, 0, bytes(8)),))


def test_messages_of_a_phase_are_the_same_at_the_other_end() -> None:
    parcels = [Parcel(0, COORDINATOR, ack(1), False), Parcel(3, 1, ack(0), True)]
    head = Told(7, True, False, 3)
    data = memoryview(b"".join(packed_parcels(head, parcels)))
    found = unpacked_parcels(data)
    assert (Told(*found[0]), found[1]) == (head, parcels)  # type: ignore[arg-type]
    for wrong in (data[:3], data[:-1], memoryview(os.urandom(40))):
        with pytest.raises(MessageError, match="no messages of a phase"):
            unpacked_parcels(wrong)


def test_what_happens_to_messages_is_the_plans_or_nothing() -> None:
    post = PhasedPost(Faults(messages={"Ack": Rates(drop=1.0)}), 2)
    post.send(1, [ack(0)])
    assert post.deliver() == []
    post.begin(harms=False)
    post.send(1, [ack(0)])
    assert [parcel.destination for parcel in post.deliver()] == [COORDINATOR, 1]
    assert post.take_injected() == {("Ack", "drop"): 2}
    assert not post.take_injected()


@pytest.mark.parametrize(
    "said",
    [
        b"garbage",
        b"".join(packed_parcels(None, [])),
        b"".join(packed_parcels(Said(0, 0, [(0, 9)], []), [])),
        b"".join(packed_parcels(Said(0, 0, [], []), [Parcel(0, COORDINATOR, ack(1), False)])),
        b"".join(packed_parcels(Said(0, 0, [], []), [Parcel(7, COORDINATOR, ack(0), False)])),
    ],
)
def test_a_node_that_says_what_cannot_be_in_a_phase_is_lost(said: bytes) -> None:
    """No phase at all, no head, a zone or a world that is not there, another node's zone."""
    with pytest.raises(LinkLostError, match="connection to node 0 has ended: no phase"):
        hearing(said).begin(1.0)


def test_a_node_to_which_messages_come_without_end_is_lost(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(faulty_coordinator, "PATIENCE", 20)
    said = b"".join(packed_parcels(Said(1, 0, [], []), []))
    with pytest.raises(LinkLostError, match="node 1 has ended: messages have come in 20 phases"):
        hearing(said).begin(1.0)


def hearing(said: bytes) -> FaultyNodeCoordinator:
    """The coordinator of two nodes that say this in every phase."""
    links: Any = None
    coordinator = FaultyNodeCoordinator(
        [bytes(16)], [0, 1], Limits(), links, [None],
        faults=Faults(), exchange=lambda told: dict.fromkeys(told, memoryview(said)),
    )  # fmt: skip
    coordinator.host(Neighbours(()))
    return coordinator
