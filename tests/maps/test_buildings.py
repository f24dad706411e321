from __future__ import annotations

import gzip
from pathlib import Path

import numpy as np
import pytest

from cavmarl.core.errors import MapError
from cavmarl.engine.world_setup import load_world
from cavmarl.maps.buildings import (
    DEFAULT_HEIGHT_M,
    LEVEL_M,
    Footprint,
    convex_parts,
    points_inside,
    read_footprints,
    walls_of,
    with_buildings,
)
from cavmarl.roads.network import GeoReference
from cavmarl.roads.sumo_net.reader import read_network

GEO = GeoReference("+proj=utm +zone=32 +ellps=WGS84", -655629.53, -5481164.76)
SQUARE = np.array([(0.0, 0.0), (10.0, 0.0), (10.0, 8.0), (0.0, 8.0)])
HOLE = np.array([(4.0, 2.0), (6.0, 2.0), (6.0, 6.0), (4.0, 6.0)])
BEND = np.array([(0.0, 0.0), (9.0, 0.0), (9.0, 3.0), (3.0, 3.0), (3.0, 9.0), (0.0, 9.0)])


def area(parts: np.ndarray) -> float:
    x, y = parts[..., 0], parts[..., 1]
    return float(0.5 * (x * np.roll(y, -1, 1) - np.roll(x, -1, 1) * y).sum())


@pytest.mark.parametrize(
    ("rings", "expected"), [((SQUARE,), 80.0), ((SQUARE, HOLE), 72.0), ((BEND,), 45.0)]
)
def test_the_convex_parts_of_a_footprint_have_its_area(
    rings: tuple[np.ndarray, ...], expected: float
) -> None:
    turned = [ring @ np.array([[0.8, 0.6], [-0.6, 0.8]]) for ring in rings]
    assert area(convex_parts(rings)) == pytest.approx(expected)
    assert area(convex_parts(tuple(turned))) == pytest.approx(expected)


def test_a_courtyard_has_walls_and_no_roof() -> None:
    yard = Footprint("yard", (SQUARE, HOLE), 12.0)
    assert len(walls_of([yard])) == 8
    middle = np.array([5.0, 4.0])
    for part in convex_parts(yard.rings):
        (x0, y0), (x1, y1) = part.min(axis=0), part.max(axis=0)
        assert not (x0 < middle[0] < x1 and y0 < middle[1] < y1)


OSM = """<osm version="0.6">
 <node id="1" lat="49.4640" lon="11.1500"/><node id="2" lat="49.4640" lon="11.1502"/>
 <node id="3" lat="49.4641" lon="11.1502"/><node id="4" lat="49.4641" lon="11.1500"/>
 <way id="10"><nd ref="1"/><nd ref="2"/><nd ref="3"/><nd ref="4"/><nd ref="1"/>
  <tag k="building" v="yes"/><tag k="height" v="12.5 m"/></way>
 <way id="11"><nd ref="1"/><nd ref="2"/><nd ref="3"/><nd ref="1"/>
  <tag k="building" v="yes"/><tag k="building:levels" v="4"/></way>
 <way id="12"><nd ref="1"/><nd ref="2"/><nd ref="3"/><nd ref="1"/>
  <tag k="building" v="yes"/><tag k="height" v="tall"/></way>
 <way id="13"><nd ref="1"/><nd ref="2"/><nd ref="3"/><nd ref="1"/>
  <tag k="building" v="roof"/></way>
 <way id="14"><nd ref="1"/><nd ref="2"/><nd ref="99"/><nd ref="1"/>
  <tag k="building" v="yes"/></way>
 <way id="15"><nd ref="1"/><nd ref="2"/><nd ref="3"/></way>
 <way id="16"><nd ref="1"/><nd ref="4"/><nd ref="3"/></way>
 <relation id="20"><member type="way" ref="15" role="outer"/>
  <member type="way" ref="16" role="outer"/><tag k="building" v="yes"/></relation>
</osm>
"""


def written(folder: Path, text: str, name: str = "some.osm.gz") -> Path:
    path = folder / name
    path.write_bytes(gzip.compress(text.encode()) if name.endswith(".gz") else text.encode())
    return path


def test_heights_and_rings_are_read_from_openstreetmap(tmp_path: Path) -> None:
    found = {f.name: f for f in read_footprints(written(tmp_path, OSM), GEO)}
    assert {name: f.height_m for name, f in found.items()} == {
        "way 10": 12.5,
        "way 11": 4 * LEVEL_M,
        "way 12": DEFAULT_HEIGHT_M,
        "relation 20": DEFAULT_HEIGHT_M,
    }
    (ring,) = found["way 10"].rings
    (joined,) = found["relation 20"].rings
    assert len(ring) == len(joined) == 4
    # A degree of longitude has 111.32 km times the cosine of the latitude; a degree of latitude has
    # 111.2 km.
    assert np.ptp(ring[:, 0]) == pytest.approx(0.0002 * 111_320 * np.cos(np.radians(49.464)), 0.03)
    assert np.ptp(ring[:, 1]) == pytest.approx(0.0001 * 111_200, abs=0.6)


POLYGONS = """<additional>
 <location netOffset="0.00,0.00" convBoundary="0,0,1,1" origBoundary="0,0,1,1" projParameter="!"/>
 <poly id="hall" type="building.hall" color="red" shape="0,0 10,0 10,8 0,8 0,0">
  <param key="height" value="21"/></poly>
 <poly id="line" type="building" color="red" shape="0,0 10,0"/>
 <poly id="wood" type="forest" color="green" shape="0,0 10,0 10,8"/>
</additional>
"""


def test_polygons_of_sumo_are_read_in_the_frame_of_the_map(tmp_path: Path) -> None:
    (hall,) = read_footprints(written(tmp_path, POLYGONS, "a.poly.xml"), None)
    assert hall.rings[0].tolist() == SQUARE.tolist()
    assert hall.height_m == 21.0


@pytest.mark.parametrize(
    ("text", "geo", "words"),
    [
        (OSM, None, "has no georeference"),
        (POLYGONS, GEO, "line 2: <location> has the offset 0.00,0.00"),
        (
            POLYGONS.replace("0,0 10,0", "0,nan 10,0"),
            None,
            "line 3: <poly> has a value that is not a number",
        ),
        (
            POLYGONS.replace("10,8 0,8 0,0", "10"),
            None,
            "line 3: <poly> has a value that is not a number",
        ),
        (OSM.replace(' lon="11.1500"', ""), GEO, "line 2: <node> has no attribute 'lon'"),
        ("<net/>", None, "<net> is not the root of a file of buildings"),
        (OSM[:-20], GEO, "broken XML"),
    ],
)
def test_an_unusable_file_is_refused_with_its_cause(
    tmp_path: Path, text: str, geo: GeoReference | None, words: str
) -> None:
    with pytest.raises(MapError, match=words):
        read_footprints(written(tmp_path, text), geo)


def test_buildings_that_are_not_on_the_map_are_refused(tmp_path: Path) -> None:
    network = read_network(Path("envs/merge/map/map.net.xml"))
    far = tmp_path / "b.poly.xml"
    far.write_text(POLYGONS.replace("0,0 10,0 10,8 0,8 0,0", "9e4,0 9.1e4,0 9.1e4,8"))
    with pytest.raises(MapError, match="none of its 1 buildings"):
        with_buildings(network, far)
    none = written(tmp_path, POLYGONS.replace("building.hall", "forest"), "c.xml")
    with pytest.raises(MapError, match="none of its 0 buildings"):
        with_buildings(network, none)


@pytest.mark.parametrize(
    "shape", ["0,0 9e9,0 9e9,8", " ".join(f"{k},{k % 2}" for k in range(4001))]
)
def test_buildings_of_impossible_size_are_refused(tmp_path: Path, shape: str) -> None:
    network = read_network(Path("envs/merge/map/map.net.xml"))
    path = written(tmp_path, POLYGONS.replace("0,0 10,0 10,8 0,8 0,0", shape), "a.poly.xml")
    with pytest.raises(MapError, match=r"poly hall is .* remove it"):
        with_buildings(network, path)


def test_buildings_change_the_hash_and_no_lane(tmp_path: Path) -> None:
    network = read_network(Path("envs/merge/map/map.net.xml"))
    built = with_buildings(network, written(tmp_path, POLYGONS, "a.poly.xml"))
    assert len(built.walls) == 4
    assert len(built.roofs) == 1
    assert built.source_hash != network.source_hash
    assert built.content_hash != network.content_hash
    assert built.lanes.tobytes() == network.lanes.tobytes()


@pytest.mark.parametrize(
    ("name", "buildings"),
    [("monaco.osm.gz", 500), ("laufamholz.osm.xml", 50), ("berlin_siegessaeule.osm.gz", 1)],
)
def test_buildings_of_real_maps_do_not_stand_on_roads(
    shared_maps: Path, name: str, buildings: int
) -> None:
    source = shared_maps / "osm" / name
    network = load_world(source, overrides={"map.buildings": "osm"}).network
    assert len(set(network.walls["building"].tolist())) >= buildings
    # Some roads lead through or under buildings. If the buildings were at wrong positions, many
    # more points of roads would be inside of them.
    assert len(points_inside(network, network.roofs)) < 0.02 * len(network.points)


def _tagged(tags: str) -> str:
    """Return OSM in which the square building, way 10, has these tags."""
    words = "".join(
        f'<tag k="{k}" v="{v}"/>' for k, v in (pair.split("=") for pair in tags.split())
    )
    return OSM.replace('<tag k="building" v="yes"/><tag k="height" v="12.5 m"/>', words)


@pytest.mark.parametrize(
    ("tags", "stands"),
    [
        ("building=yes", True),
        ("building=yes layer=-1", False),
        ("building=yes location=underground", False),
        ("building=yes layer=1", True),  # below the building, no road is known
        ("building=yes layer=x", True),
        ("building=yes min_height=1.8", True),
        ("building=yes min_height=3", False),
        ("building=yes min_height=4.5 building:min_level=0", False),
        ("building=yes building:min_level=1", False),
        ("building=yes building:min_level=0", True),
        ("building=yes building:min_level=-2", True),  # two levels are cellars
    ],
)
def test_buildings_that_do_not_stand_on_the_ground_are_left_out(
    tmp_path: Path, tags: str, stands: bool
) -> None:
    found = {f.name for f in read_footprints(written(tmp_path, _tagged(tags)), GEO)}
    assert ("way 10" in found) is stands
    assert {"way 11", "way 12", "relation 20"} <= found


@pytest.mark.parametrize(
    ("key", "value", "walls"), [("layer", "1", 0), ("layer", "0", 4), ("min_height", "5", 0)]
)
def test_a_building_above_a_road_has_no_walls(
    tmp_path: Path, key: str, value: str, walls: int
) -> None:
    network = read_network(Path("envs/merge/map/map.net.xml"))
    x, y = network.lane_polyline(0)[0, :2].tolist()
    near, far = (
        " ".join(f"{x + dx:.2f},{y + dy:.2f}" for dx, dy in corners)
        for corners in (
            ((-5, -5), (5, -5), (5, 5), (-5, 5)), ((-5, 200), (5, 200), (5, 210), (-5, 210))
        )
    )  # fmt: skip
    text = (
        f'<additional><poly id="above" type="building" shape="{near}">'
        f'<param key="{key}" value="{value}"/></poly>'
        f'<poly id="beside" type="building" shape="{far}"/>'
        f'<poly id="beside, raised" type="building" shape="{far}"><param key="layer" value="1"/>'
        "</poly></additional>"
    )
    built = with_buildings(network, written(tmp_path, text, "a.poly.xml"))
    assert len(points_inside(built, built.roofs)) == 0 or walls
    assert len(built.walls) == 8 + walls
