"""Speed limits and lane types of OpenDRIVE are applied to the lanes of the network."""

from __future__ import annotations

from pathlib import Path

import pytest

from cavmarl.config.registry import load_config
from cavmarl.core.errors import MapError
from cavmarl.engine.world_setup import load_roads
from cavmarl.maps.netconvert import build_network
from cavmarl.roads.network import RoadNetwork
from cavmarl.roads.sumo_net.reader import read_network
from tests.support.map_sources import ROAD, built_from, road_file

pytest.importorskip("sumo", reason="needs the extra 'sumo'")

MPH = 0.44704


def limits(network: RoadNetwork) -> dict[str, float]:
    """Return the speed limits in m/s of lanes outside of junctions, by id."""
    return {
        name: float(row["speed_mps"])
        for name, row in zip(network.lane_ids, network.lanes, strict=True)
        if not row["internal"]
    }


@pytest.mark.parametrize(
    ("speed", "mps"),
    [
        ('max="15" unit="mph"', 15 * MPH),
        ('max="50" unit="km/h"', 50 / 3.6),
        ('max="20" unit="m/s"', 20.0),
        ('max="20"', 20.0),
        ('max="no limit"', 142 / 3.6),
        ('max="undefined"', 13.89),
        ('max="0" unit="mph"', 13.89),
    ],
)
def test_lanes_have_the_speed_limit_of_their_road(tmp_path: Path, speed: str, mps: float) -> None:
    text = road_file(ROAD.replace("<type/>", f'<type s="0" type="town"><speed {speed}/></type>'))
    assert limits(built_from(tmp_path, "map.xodr", text)) == {
        "1_0": pytest.approx(mps, abs=0.01),
        "-1_0": pytest.approx(mps, abs=0.01),
    }


def test_speed_limits_change_along_a_road_and_those_of_lanes_take_precedence(
    tmp_path: Path,
) -> None:
    types = (
        '<type s="0" type="town"><speed max="36" unit="km/h"/></type>'
        '<type s="120" type="rural"><speed max="72" unit="km/h"/></type>'
        '<type s="199.5" type="town"><speed max="18" unit="km/h"/></type>'
    )
    own = '<lane id="-1" type="driving"><speed sOffset="60" max="5"/>'
    road = ROAD.replace("<type/>", types).replace('<lane id="-1" type="driving">', own)
    network = built_from(tmp_path, "map.xodr", road_file(road))
    by_place = {}
    for name, mps in limits(network).items():
        lane = network.lane_ids.index(name)
        s = 0.5 * float(network.lanes["length_m"][lane])
        x = network.pose_on(lane, s)[0]
        by_place[name.startswith("-"), round(x)] = mps
    # netconvert cuts both directions at each change of a limit, but not 0.5 m before the end.
    assert by_place == {
        (True, 30): 10.0,
        (True, 90): 5.0,
        (True, 160): 5.0,
        (False, 30): 10.0,
        (False, 90): 10.0,
        (False, 160): 20.0,
    }


def test_roads_without_a_speed_limit_are_counted_once(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "map.xodr"
    path.write_text(road_file(ROAD.replace("<type/>", '<type s="0" type="town"/>')))
    result = build_network(path, tmp_path / "map.net.xml")
    (row,) = result.defaults
    assert row.to_dict() == {
        "kind": "town",
        "edges": 1,
        "guessed": "maxspeed",
        "value": "13.89",
        "used_for": 1,
    }
    assert result.provenance["defaults"] == "town maxspeed=13.89 (1 of 1 roads)"
    monkeypatch.setenv("CAVMARL_CACHE_DIR", str(tmp_path))
    one, other = (load_roads(*load_config(path)) for _ in range(2))
    assert one is other
    assert caplog.text.count("defaults: town maxspeed=13.89 (1 of 1 roads)") == 1


def test_very_low_speed_limits_are_counted(tmp_path: Path) -> None:
    path = tmp_path / "map.xodr"
    speed = '<type s="0" type="town"><speed max="1.2"/></type>'
    path.write_text(road_file(ROAD.replace("<type/>", speed)))
    result = build_network(path, tmp_path / "map.net.xml")
    assert result.notes == ("1 roads with a speed limit below 1.39 m/s (5 km/h)",)


@pytest.mark.parametrize("speed", ['max="-5"', 'max="fast"', 'max="nan"', 'max="5" unit="knots"'])
def test_invalid_speed_limits_are_refused_or_ignored_if_tolerant(
    tmp_path: Path, speed: str
) -> None:
    path = tmp_path / "map.xodr"
    entry = f'<type s="0" type="town"><speed {speed}/></type>'
    path.write_text(road_file(ROAD.replace("<type/>", entry)))
    with pytest.raises(MapError, match=r"road '1': <speed max='.*--tolerant"):
        build_network(path, tmp_path / "map.net.xml")
    result = build_network(path, tmp_path / "map.net.xml", tolerant=True)
    assert result.notes == ("1 speed limits whose max or unit is invalid",)
    assert set(limits(read_network(result.path)).values()) == {13.89}


@pytest.mark.parametrize(
    ("name", "mph"),
    [("Town01", {25}), ("Town04", {30, 35, 55, 65}), ("Town10HD", {40, 50})],
)
def test_towns_of_carla_have_their_speed_limits(
    shared_maps: Path, tmp_path: Path, name: str, mph: set[int]
) -> None:
    result = build_network(shared_maps / "xodr" / f"{name}.xodr", tmp_path / "town.net.xml")
    found = {round(value / MPH) for value in limits(read_network(result.path)).values()}
    assert found == mph
    assert result.defaults == ()


@pytest.mark.parametrize(
    ("kind", "lanes", "note"),
    [
        ("driving", 2, ()),
        ("sidewalk", 1, ()),
        ("entry", 2, ()),
        ("bus", 2, ()),
        ("slipLane", 2, ("1 lanes of type slipLane are read as driving",)),
        ("shared", 2, ("1 lanes of type shared are read as driving",)),
        ("connectingRamp", 2, ("1 lanes of type connectingRamp are read as offRamp",)),
        ("parking", 1, ("1 lanes of type parking are left out",)),
        ("stop", 1, ("1 lanes of type stop are left out",)),
        ("HOV", 1, ("1 lanes of type HOV are left out",)),
        ("cart", 1, ("1 lanes of type cart are unknown and left out",)),
    ],
)
def test_lanes_are_built_by_their_type_and_other_types_are_counted(
    tmp_path: Path, kind: str, lanes: int, note: tuple[str, ...]
) -> None:
    path = tmp_path / "map.xodr"
    beside = (
        f'<lane id="-2" type="{kind}"><width sOffset="0" a="3" b="0" c="0" d="0"/></lane></right>'
    )
    path.write_text(road_file(ROAD.replace("</right>", beside)))
    result = build_network(path, tmp_path / "map.net.xml")
    assert result.notes == note
    network = read_network(result.path)
    edge = network.edge_ids.index("-1")
    assert network.edges["num_lanes"][edge] == lanes
    for_cars = network.lanes["permissions"][network.edges["first_lane"][edge]] & 1
    assert for_cars == (kind != "bus")


@pytest.mark.parametrize("text", ["1000000000", "1e9", "inf", "-200000"])
def test_a_too_long_geometry_is_refused_before_netconvert_starts(tmp_path: Path, text: str) -> None:
    line = '<geometry s="0" x="0" y="0" hdg="0" length="200"><line/></geometry>'
    spiral = line.replace("<line/>", '<spiral curvStart="0" curvEnd="0.1"/>')
    endless = ROAD.replace(line, line + "\n" + spiral.replace('length="200"', f'length="{text}"'))
    path = tmp_path / "map.xodr"
    path.write_text(road_file(ROAD, endless.replace('id="1" junction', 'id="seven" junction')))
    words = rf"map\.xodr:2: road 'seven' has a geometry of {text} m: at most 100000 m"
    with pytest.raises(MapError, match=words):
        build_network(path)


def test_the_memory_of_netconvert_is_limited(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("CAVMARL_MAX_GEOMETRY_M", "1000000000")
    monkeypatch.setenv("CAVMARL_MAX_NETCONVERT_BYTES", str(512 << 20))
    path = tmp_path / "map.xodr"
    road = ROAD.replace('length="200"', 'length="1000000000"')
    road = road.replace("<line/>", '<spiral curvStart="0" curvEnd="0.1"/>')
    path.write_text(road_file(road))
    words = r"netconvert needs more than 0\.5 GiB of memory: .*MAX_NETCONVERT_BYTES"
    with pytest.raises(MapError, match=words):
        build_network(path, tmp_path / "out.net.xml")
