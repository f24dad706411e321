"""Reversed roads and the events of `map.events`: divisions, saved states and refusals."""

from __future__ import annotations

from contextlib import closing
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("sumo", reason="needs the extra 'sumo'")

from cavmarl import ActionError, CapacityError, ConfigError, make_vec, parallel_env
from cavmarl.env.lane_changes import LaneChanges
from cavmarl.maps.netconvert_process import run_netconvert
from cavmarl.recordings.recording import Recording
from tests.support.acted_on import hashes_of
from tests.support.saved_midway import check_resumed

ROOM: dict[str, Any] = {
    "map.changed_lanes": 12,
    "map.contraflow": ["B1B2", "C1B1"],
    "population.reroute": "always",
}


def reverse(env: Any, step: int) -> None:
    """Reverse two roads in step 3, and open one of them again in step 70."""
    if step == 3:
        env.close_road("B1B2", contraflow=True)
        env.close_road("C1B1", contraflow=True)
    if step == 70:
        env.open_road("B1B2")


hashes = partial(
    hashes_of, act=reverse, overrides=ROOM, agents=2, background=50, steps=100, every=20
)


def test_a_divided_world_with_reversed_roads_equals_the_undivided_one() -> None:
    undivided = hashes()
    assert hashes(zones=4) == undivided
    assert hashes(zones=4, workers=2) == undivided
    assert hashes(act=lambda env, step: None, steps=20) != undivided[:1]


@pytest.mark.slow
def test_worlds_with_reversed_roads_over_nodes_are_equal() -> None:
    assert hashes(zones=2, nodes=2) == hashes()


def test_saved_states_include_reversed_roads() -> None:
    # The state is saved while vehicles still leave the roads that will be reversed.
    check_resumed(reverse, ROOM, at=30, steps=120)


def test_a_reversed_road_is_used_only_when_the_original_direction_is_empty() -> None:
    with closing(parallel_env("grid4x4", agents=1, background=80, overrides=ROOM)) as env:
        env.reset(seed=2)
        network = env.network
        edges = network.lanes["edge"]
        below = edges == network.edge_ids.index("B1B2")
        above = edges == network.edge_ids.index("contraflow:B1B2")
        used = 0
        for step in range(700):
            if step == 3:
                env.close_road("B1B2", contraflow=True)
            if step == 250:
                env.open_road("B1B2")
                assert "B1B2" in env.closed_roads()
            env.step(env.suggest_actions())
            lanes = env.present.vehicles(0)["lane"]
            assert not (below[lanes].any() and above[lanes].any())
            used += int(above[lanes].any())
        assert used > 20
        assert env.closed_roads() == ()
        assert below[env.present.vehicles(0)["lane"]].any()
        assert env.traffic_stats()["contacts"] == 0


NODES = """<nodes><node id="W" x="-200" y="0"/><node id="A" x="0" y="0"/>
<node id="M" x="150" y="0"/>
<node id="N" x="300" y="0"/><node id="B" x="450" y="0"/><node id="X" x="650" y="0"/></nodes>"""
BRIDGE = ("MA", "NM", "BN")
EVACUEES = (
    '<vType id="evacuee"><param key="has.rerouting.device" value="true"/>'
    '<param key="device.rerouting.period" value="20"/></vType>'
)


def chain(folder: Path) -> Path:
    """Write a world with a chain of roads that can be reversed, and vehicles in both directions."""
    words = ["-n", str(folder / "chain.nod.xml"), "-e", str(folder / "chain.edg.xml")]
    ends = [
        (a, b) for one in ("WA", "AM", "MN", "NB", "BX") for a, b in (tuple(one), tuple(one[::-1]))
    ]
    edges = "".join(f'<edge id="{a}{b}" from="{a}" to="{b}"/>' for a, b in ends)
    (folder / "chain.nod.xml").write_text(NODES, encoding="utf-8")
    (folder / "chain.edg.xml").write_text(f"<edges>{edges}</edges>", encoding="utf-8")
    run_netconvert([*words, "-o", str(folder / "chain.net.xml")], folder, None)
    trips = "".join(
        f'<trip id="{k}" type="evacuee" depart="{k}" from="{a}" to="{b}"/>'
        for k in range(120)
        for a, b in [("WA", "BX") if k % 2 else ("XB", "AW")]
    )
    demand = f"<routes>{EVACUEES}{trips}</routes>"
    (folder / "trips.rou.xml").write_text(demand, encoding="utf-8")
    (folder / "env.yaml").write_text(
        "name: chain\nversion: 1\n"
        "map: {source: chain.net.xml, contraflow: [MA, NM, BN], changed_lanes: 6}\n"
        "clock: {sim_dt_s: 0.1, ctrl_dt_s: 1.0}\n"
        "population: {mode: respawn, agents: 0, background: 0, reroute: blocked}\n"
        "traffic: {demand: [trips.rou.xml]}\nhorizon_s: 900\n",
        encoding="utf-8",
    )
    return folder


@pytest.mark.parametrize("order", [BRIDGE, BRIDGE[::-1]])
def test_a_chain_of_roads_is_reversed_one_after_the_other_so_that_vehicles_can_leave(
    tmp_path: Path, order: tuple[str, ...]
) -> None:
    with closing(make_vec(chain(tmp_path), num_envs=1)) as vec:
        vec.reset(seed=1)
        names, edges = vec.network.edge_ids, vec.network.lanes["edge"]
        rows = {road: (names.index(road), names.index(f"contraflow:{road}")) for road in BRIDGE}
        used, closed = set(), []
        for step in range(400):
            if step == 60:
                for road in order:
                    vec.close_road(road, shuts_in=True, contraflow=True)
                # NM and MA stay open for now, because vehicles have to leave over them.
                assert vec.closed_roads() == ("BN",)
            if step == 250:
                for road in order:
                    vec.open_road(road)
            vec.step(vec.suggest_actions())
            closed.append(vec.closed_roads())
            there = edges[vec.present.vehicles(0)["lane"]]
            for road, (below, above) in rows.items():
                assert not ((there == below).any() and (there == above).any())
                used |= {road} if (there == above).any() else set()
        assert used == set(BRIDGE)
        assert [("BN",), ("BN", "NM"), ("BN", "MA", "NM")] == sorted(set(closed[60:250]), key=len)
        assert closed[-1] == ()
        stats = vec.traffic_stats()
        assert (stats["arrived"], stats["contacts"]) == (120, 0)


def test_a_divided_world_equals_the_undivided_one_while_roads_wait_for_their_reversal(
    tmp_path: Path,
) -> None:
    keys = {"map.events": [{"at_s": 40, "action": "reverse", "edges": [*BRIDGE], "shuts_in": True}]}

    def found(**more: Any) -> list[str]:
        with closing(make_vec(tmp_path, num_envs=1, overrides=keys, **more)) as vec:
            vec.reset(seed=1)
            hashes = []
            for step in range(160):
                vec.step(vec.suggest_actions())
                if step % 40 == 39:
                    hashes.append(vec.state_hash())
            return hashes

    chain(tmp_path)
    undivided = found()
    assert found(zones=3) == undivided
    assert found(zones=2, workers=2) == undivided


def test_a_road_that_is_closed_during_its_return_stays_closed(tmp_path: Path) -> None:
    with closing(make_vec(chain(tmp_path), num_envs=1)) as vec:

        def drive(steps: int) -> tuple[str, ...]:
            for _ in range(steps):
                vec.step(vec.suggest_actions())
            return vec.closed_roads()

        vec.reset(seed=1)
        vec.close_road("MA", shuts_in=True, contraflow=True)
        assert drive(90) == ("MA",)
        vec.close_road(
            "MA", shuts_in=True, contraflow=True
        )  # has no effect, because the road is already reversed
        vec.open_road("MA")
        assert drive(2) == ("MA",)
        vec.close_road("MA", shuts_in=True)
        assert drive(120) == ("MA",)
        vec.open_road("MA")
        assert drive(1) == ()


def test_steps_without_events_and_reversible_roads_examine_no_roads(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(LaneChanges, "advance", lambda *_: pytest.fail("roads are examined"))
    with closing(make_vec("merge", num_envs=1, overrides={"map.changed_lanes": 2})) as vec:
        vec.reset(seed=1)
        vec.step(vec.suggest_actions())


def test_saved_states_with_invalid_reversals_are_refused(tmp_path: Path) -> None:
    with closing(make_vec(chain(tmp_path), num_envs=1)) as vec:
        vec.reset(seed=1)
        vec.close_road("BN", shuts_in=True, contraflow=True)
        for _ in range(60):
            vec.step(vec.suggest_actions())
        changes = LaneChanges(
            vec.config, vec.network, 1, lambda: pytest.fail("no world is examined")
        )
        changes.reverse(0, "MA", shuts_in=True)
        told, states = changes.memory
        assert changes.wrong((told, states)) == ""
        for place, value, message in (
            ((0, 1, 0), 5, "unknown state"),
            ((0, 1, 0), 2, "is not reversed, or closed on a reversed road"),
            ((0, 0, 0), 1, "a reversed road is open"),
            ((0, 0, 0), 3, "a reversed road is open"),
            ((0, 1, 1), -2, "unknown state"),
            ((0, 1, 2), 2, "lanes that stay closed"),
        ):
            forged = states.copy()
            forged[place] = value
            assert message in changes.wrong((told, forged))
        opened = told.copy()
        opened[0, 5] = (
            1 + vec.network.lane_ids.index("contraflow:MA_0"),
            1.0,
            1.0,
        )
        assert "are open on a road that is not reversed" in changes.wrong((opened, states))


def test_invalid_reversals_are_refused_with_a_remedy() -> None:
    keys = {**ROOM, "map.changed_lanes": 5}
    with closing(parallel_env("grid4x4", overrides=keys)) as env:
        env.reset(seed=1)
        with pytest.raises(ActionError, match=r"cannot be reversed: give one of map\.contraflow"):
            env.close_road("B2B1", contraflow=True)
        with pytest.raises(ActionError, match="the map has no such road"):
            env.close_road("Z9", contraflow=True)
        for change in (env.close_road, env.open_road):
            with pytest.raises(ActionError, match="are contraflow lanes: reverse or open the road"):
                change("contraflow:B1B2")
        with pytest.raises(ActionError, match="world 1: must be from 0 to 0"):
            env.close_road("B1B2", world=1, contraflow=True)
        with pytest.raises(ActionError, match="is reversed with all its lanes; leave lanes out"):
            env.close_road("B1B2", lanes=[0], contraflow=True)
        env.close_road("B1B2", contraflow=True)
        # This reversal needs four of the five lanes, so there is no room for another one.
        with pytest.raises(CapacityError, match=r"map\.changed_lanes = 5; set it higher"):
            env.close_road("C1B1", contraflow=True)
        assert env.closed_roads() == ("B1B2",)
    with pytest.raises(ConfigError, match=r"map\.changed_lanes = 0: map\.contraflow changes lanes"):
        parallel_env("grid4x4", overrides={"map.contraflow": ["B1B2"]})
    with pytest.raises(ConfigError, match=r"map\.contraflow: the map has no road 'Z9'"):
        parallel_env("grid4x4", overrides={**ROOM, "map.contraflow": ["Z9"]})


EVENTS = {
    "map.changed_lanes": 16,
    "map.contraflow": ["C1B1"],
    "map.events": [
        {"at_s": 0.4, "action": "close", "edges": ["B1B2", "B2B1"]},
        {"at_s": 1.0, "action": "reverse", "edges": ["C1B1"]},
        {"at_s": 1.0, "action": "damage", "edges": ["A1B1"], "lanes": [0], "speed_mps": 3},
        {"at_s": 5.0, "action": "open", "edges": ["B1B2", "C2B2"]},
    ],
}


def by_hand(env: Any, step: int) -> None:
    """Make the changes of EVENTS by calls at the same times."""
    if step == 2:
        env.close_road("B1B2")
        env.close_road("B2B1")
    if step == 5:
        env.close_road("C1B1", contraflow=True)
        env.damage_road("A1B1", 3.0, lanes=[0])
    if step == 25:
        env.open_road("B1B2")


def test_events_have_the_same_effect_as_calls() -> None:
    def nothing(env: Any, step: int) -> None:
        pass

    wanted = hashes(act=by_hand, overrides={**EVENTS, "map.events": []})
    assert hashes(act=nothing, overrides=EVENTS) == wanted
    assert hashes(act=nothing, overrides=EVENTS, zones=2) == wanted


def test_events_happen_in_each_episode_of_each_world() -> None:
    with closing(
        make_vec("grid4x4", num_envs=2, background=20, max_cycles=12, overrides=EVENTS)
    ) as vec:
        vec.reset(seed=1)
        closed = []
        for _ in range(30):
            vec.step(vec.suggest_actions())
            closed.append([vec.closed_roads(world) for world in range(2)])
        assert closed[1] == [(), ()]
        assert closed[3] == [("B1B2", "B2B1")] * 2
        over = closed.index([(), ()], 4)  # the next episodes have begun
        again = closed[over:]
        assert again[again.index([("B1B2", "B2B1")] * 2) - 1] == [(), ()]


def test_events_are_recorded(tmp_path: Path) -> None:
    keys = {"agents": 2, "overrides": EVENTS, "record": tmp_path / "run"}
    with closing(parallel_env("grid4x4", **keys)) as env:  # type: ignore[arg-type]
        env.reset(seed=2)
        for _ in range(80):
            env.step(env.suggest_actions())
    events = [found.event for found in Recording.open(tmp_path / "run").events()]
    told = [
        (event.kind, event.detail)
        for event in events
        if event.kind in ("closed", "opened", "damaged", "reversed")
    ]
    assert told[:4] == [
        ("closed", "B1B2"), ("closed", "B2B1"), ("closed", "C1B1"), ("damaged", "A1B1 0 3.0")
    ]  # fmt: skip
    assert ("opened", "B1B2") in told
    assert ("reversed", "C1B1") in told
    assert ("opened", "C2B2") not in told


@pytest.mark.parametrize(
    ("event", "message"),
    [
        ({"at_s": 1, "action": "close", "edges": ["Z9"]}, r"events\.0: edge 'Z9': the map has no"),
        ({"at_s": 1, "action": "open", "edges": ["Z9"]}, r"events\.0: edge 'Z9': the map has no"),
        ({"at_s": 1, "action": "close", "edges": []}, "must name a road"),
        ({"at_s": -1, "action": "close", "edges": ["B1B2"]}, "at_s = -1"),
        ({"at_s": 1, "action": "burn", "edges": ["B1B2"]}, "must be 'close'"),
        ({"at_s": 1, "action": "damage", "edges": ["B1B2"]}, "must be given for damage"),
        ({"at_s": 1, "action": "close", "edges": ["B1B2"], "speed_mps": 3}, "for no other action"),
        ({"at_s": 1, "action": "damage", "edges": ["B1B2"], "speed_mps": 90}, "at most that"),
        ({"at_s": 1, "action": "reverse", "edges": ["B1B2"]}, r"only roads in map\.contraflow"),
        ({"at_s": 1, "action": "reverse", "edges": ["C1B1"], "lanes": [0]}, "leave the key out"),
        ({"at_s": 1, "action": "close", "edges": ["B1B2"], "lanes": [7]}, "has the lanes 0 to 1"),
    ],
)
def test_invalid_events_are_refused(event: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        parallel_env("grid4x4", overrides={**EVENTS, "map.events": [event]})


def test_events_that_need_too_many_lanes_or_close_the_last_exit_are_refused() -> None:
    with pytest.raises(ConfigError, match=r"map\.events\.0: world 0: .* map\.changed_lanes = 3"):
        parallel_env("grid4x4", overrides={**EVENTS, "map.changed_lanes": 3})
    last = {"at_s": 1, "action": "close", "edges": ["main_out"]}
    keys = {"map.changed_lanes": 9, "map.events": [last]}
    with pytest.raises(ConfigError, match=r"map\.events\.0: edge 'main_out': it is the last way"):
        parallel_env("merge", overrides=keys)
    with closing(
        parallel_env("merge", overrides={**keys, "map.events": [{**last, "shuts_in": True}]})
    ) as env:
        env.reset(seed=1)
        for _ in range(12):
            env.step(env.suggest_actions())
        assert env.closed_roads() == ("main_out",)


def test_the_rows_of_vehicles_do_not_depend_on_zones_and_workers() -> None:
    def rows(**more: Any) -> np.ndarray[Any, Any]:
        with closing(make_vec("grid4x4", num_envs=1, background=20, **more)) as vec:
            vec.reset(seed=1)
            for _ in range(5):
                vec.step(vec.suggest_actions())
            found = vec.present.vehicles(0)
            return found[np.argsort(found["id"])]

    here = rows()
    for name in ("id", "x", "y", "speed", "order"):
        assert (rows(zones=2, workers=2)[name] == here[name]).all()
