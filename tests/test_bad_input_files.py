"""Errors that a user of an environment sees for invalid maps and demand."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from cavmarl import (
    CapacityError,
    CavEnv,
    ConfigError,
    DemandError,
    MapError,
    RouteError,
    parallel_env,
)

# Maps

NET = """<?xml version="1.0"?>
<net version="1.20">
  <location netOffset="0,0" convBoundary="0,0,0,0" origBoundary="0,0,0,0" projParameter="!"/>
  <edge id="a" from="A" to="B">
    <lane id="a_0" index="0" speed="14" length="200" shape="0,0 200,0"/>
  </edge>
  <edge id="b" from="C" to="D">
    <lane id="b_0" index="0" speed="14" length="200" shape="0,50 200,50"/>
  </edge>
  <junction id="A" type="dead_end" x="0" y="0" incLanes="" intLanes="" shape=""/>
  <junction id="B" type="dead_end" x="200" y="0" incLanes="a_0" intLanes="" shape=""/>
  <junction id="C" type="dead_end" x="0" y="50" incLanes="" intLanes="" shape=""/>
  <junction id="D" type="dead_end" x="200" y="50" incLanes="b_0" intLanes="" shape=""/>
</net>
"""


Write = Callable[..., Path]


@pytest.fixture
def write(tmp_path: Path) -> Write:
    def write_map(text: str, name: str = "small.net.xml") -> Path:
        path = tmp_path / name
        path.write_text(text, encoding="utf-8")
        return path

    return write_map


BOMB = '<!DOCTYPE net [<!ENTITY a "aaaa"><!ENTITY b "&a;&a;&a;&a;">]>\n<net>&b;</net>'


@pytest.mark.parametrize(
    "text",
    [
        "",
        "no xml at all",
        NET[:400],
        BOMB,
        "<net/>",
        NET.replace('shape="0,0 200,0"', 'shape="0,0 nan,0"'),
        NET.replace('shape="0,0 200,0"', 'shape="0,0"'),
        NET.replace('shape="0,0 200,0"', 'shape="0,0 0,0"').replace(
            'length="200"', 'length="0"', 1
        ),
        NET.replace('speed="14"', 'speed="nan"', 1),
        NET.replace('speed="14"', 'speed="-1"', 1),
        NET.replace('edge id="b"', 'edge id="a"'),
    ],
    ids=["empty", "text", "cut", "bomb", "bare", "nan", "point", "zero", "speed", "back", "twice"],
)
def test_a_broken_map_is_refused(write: Write, text: str) -> None:
    path = write(text)
    with pytest.raises(MapError, match="small"):
        parallel_env(path)


def test_trips_on_a_map_in_two_parts_stay_in_their_part(write: Write) -> None:
    env = parallel_env(write(NET), agents=2, background=4, seed=0)
    env.reset()
    network = env.network
    for _ in range(30):
        for vehicle in env.simulation.vehicles():
            goal = network.edge_ids[env.simulation.goal_edges[0, vehicle["goal"]]]
            assert goal == network.edge_ids[network.lanes[vehicle["lane"]]["edge"]]
        if env.agents:
            env.step(env.suggest_actions())


def test_a_trip_between_unconnected_parts_is_refused(write: Write) -> None:
    with pytest.raises(ConfigError, match=r"no trip|no route"):
        parallel_env(
            write(NET), overrides={"traffic.origins": ["a"], "traffic.destinations": ["b"]}
        )


def test_a_map_without_a_road_for_cars_is_refused(write: Write) -> None:
    text = NET.replace('speed="14"', 'speed="14" allow="pedestrian"')
    with pytest.raises((RouteError, MapError), match="small"):
        parallel_env(write(text))


def test_a_missing_map_is_refused(tmp_path: Path) -> None:
    folder = tmp_path / "mine"
    folder.mkdir()
    (folder / "env.yaml").write_text("name: mine\nmap: {source: lost.net.xml}\n")
    with pytest.raises(MapError, match=r"map\.source.*lost\.net\.xml"):
        parallel_env(folder)


# Demand

AROUND = "A0B0 B0B1 B1A1 A1A0"
LOST = '<vehicle id="v" depart="0"><route edges="A0B0 lost"/></vehicle>'


def env_with_demand(write: Write, body: str, **more: str) -> CavEnv:
    path = write(f"<routes>\n{body}\n</routes>", "x.rou.xml")
    overrides = {"traffic.demand": [str(path)], **more}
    return parallel_env("grid4x4", agents=1, background=0, seed=0, overrides=overrides)


@pytest.mark.parametrize(
    ("body", "error", "words"),
    [
        (LOST, DemandError, ("lost", "made for this map")),
        (LOST.replace("A0B0 lost", "a b c"), DemandError, ("3 edges", "made for this map")),
        (
            '<vehicle id="v" depart="0"><route edges="A0B0 A1B1"/></vehicle>',
            RouteError,
            ("A0B0", "A1B1", "duarouter"),
        ),
        (
            '<trip id="t" depart="0" from="A0bottom0" to="bottom0A0"/>',
            RouteError,
            ("A0bottom0", "bottom0A0", "on_bad_route = skip"),
        ),
        ('<vType id="t" length="1e9"/>', DemandError, ("length", "at most 100")),
        ('<flow id="f" begin="9" end="3" number="2"/>', DemandError, ("f", "ends before")),
        (
            f'<flow id="f" begin="0" end="9" number="100000000"><route edges="{AROUND}"/></flow>',
            CapacityError,
            ("f", "2000000"),
        ),
    ],
    ids=["edge", "map", "route", "trip", "type", "times", "many"],
)
def test_the_error_for_invalid_demand_names_the_line(
    write: Write, body: str, error: type[Exception], words: tuple[str, ...]
) -> None:
    with pytest.raises(error) as caught:
        env_with_demand(write, body)
    for word in ("x.rou.xml, line 2", *words):
        assert word in str(caught.value)


def test_vehicles_without_a_route_can_be_skipped_and_counted(write: Write) -> None:
    body = '<vehicle id="v" depart="0"><route edges="A0B0 A1B1"/></vehicle>'
    env = env_with_demand(write, body, **{"traffic.on_bad_route": "skip"})
    assert env.simulation.demand is not None
    (line,) = env.simulation.demand.report.lines()
    assert "1 vehicle or flow that cannot drive its route is left out" in line
    assert "x.rou.xml, line 2" in line


@pytest.mark.parametrize("body", ["", '<vType id="t"/>', '<vType id="t" vClass="rail"/>'])
def test_demand_without_vehicles_gives_a_world_without_vehicles(write: Write, body: str) -> None:
    env = env_with_demand(write, body)
    env.reset()
    env.step(env.suggest_actions())
    assert env.traffic_stats()["departed"] == 1


def test_departures_are_sorted_by_time(write: Write) -> None:
    # No random draws: they depend on the position in the file.
    alike = '<vType id="alike" speedDev="0"/>'
    vehicle = f'<vehicle id="{{}}" type="alike" depart="{{}}"><route edges="{AROUND}"/></vehicle>'
    one, other = vehicle.format("a", 3), vehicle.format("b", 1)
    hashes = []
    for body in (one + other, other + one):
        env = env_with_demand(write, alike + body)
        env.reset()
        for _ in range(50):
            env.step(env.suggest_actions())
        assert env.traffic_stats()["departed"] == 3
        assert env.state_space.contains(env.state())
        hashes.append(sorted(env.simulation.vehicles()["x"].tolist()))
    assert hashes[0] == hashes[1]


def test_departures_without_room_wait_and_are_counted(write: Write) -> None:
    flow = f'<flow id="f" begin="0" end="9" number="20000"><route edges="{AROUND}"/></flow>'
    env = env_with_demand(write, flow)
    env.reset()
    for _ in range(100):
        env.step(env.suggest_actions())
    stats = env.traffic_stats()
    assert stats["waiting"] + stats["departed"] == 20_001
    assert 1 < stats["departed"] < 100
