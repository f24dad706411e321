"""Opposite lanes on the same strip are reported and moved apart; other lanes do not change."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from cavmarl.evaluate import evaluate
from cavmarl.maps.check import check_map
from cavmarl.maps.defects import find_defects
from cavmarl.maps.repair import mend
from cavmarl.roads.network import RoadNetwork
from cavmarl.roads.polylines import Shape
from cavmarl.roads.sumo_net.reader import read_network
from cavmarl.roads.sumo_net.shared_strips import Road, Strip, find_strips, move_apart
from tests.support.bent_roads import bent_street
from tests.support.netgenerate import netconvert

KIND = "opposite lanes on one strip"
ROADS = [Road(range(1), 0, 1), Road(range(1, 2), 1, 0)]


def line(*points: tuple[float, ...]) -> Shape:
    return np.array([(*point, 0.0)[:3] for point in points])


def strips_of(*shapes: Shape, left_hand: bool = False) -> list[Strip]:
    return find_strips(list(shapes), [3.2, 3.2], ROADS, left_hand)


def tram_street(folder: Path) -> Path:
    """Write a street whose inner lanes of both directions share the same tracks."""
    places = range(0, 1001, 250)
    nodes = "".join(f'<node id="n{k}" x="{x}" y="0"/>' for k, x in enumerate(places))
    edges = ""
    for k, (x, y) in enumerate(pairwise(places)):
        for one, other, begin, end, kerb in ((k, k + 1, x, y, -3.2), (k + 1, k, y, x, 3.2)):
            edges += f"""<edge id="{one}_{other}" from="n{one}" to="n{other}" numLanes="2"
                speed="13.9"><lane index="0" shape="{begin},{kerb} {end},{kerb}"/>
                <lane index="1" shape="{begin},0 {end},0"/></edge>"""
    parts = {"nod": ("node", nodes), "edg": ("edge", edges), "con": ("connection", "")}
    for end, (kind, text) in parts.items():
        (folder / f"m.{end}.xml").write_text(f"<{kind}s>{text}</{kind}s>")
    return netconvert(folder, "m")


def least_apart(network: RoadNetwork) -> float:
    """Return the least distance from the middle of a lane to a lane of the opposite edge, in m."""
    found = [np.inf]
    rows = np.flatnonzero(~network.lanes["internal"])
    ends = network.edges[["from_junction", "to_junction"]][network.lanes["edge"]].tolist()
    for one in rows:
        for other in rows:
            if ends[one] == ends[other][::-1]:
                x, y = network.pose_on(one, 0.5 * network.lanes["length_m"][one])[:2]
                found.append(abs(network.beside(other, x, y)[1]))
    return float(min(found))


def test_in_right_hand_traffic_lanes_on_the_same_strip_move_to_the_right() -> None:
    shapes = [line((0, 0), (100, 0)), line((100, 0.4), (0, 0.4))]
    (strip,) = strips_of(*shapes)
    assert strip.lanes == ((0, 1),)
    assert strip.apart_m == pytest.approx(1.4)
    move_apart(shapes, [strip], [], left_hand=False)
    np.testing.assert_allclose(shapes[0][:, 1], -1.4)
    np.testing.assert_allclose(shapes[1][:, 1], 1.8)
    assert strips_of(*shapes) == []


def test_in_left_hand_traffic_lanes_on_the_same_strip_move_to_the_left() -> None:
    shapes = [line((0, 0), (100, 0)), line((100, 0), (0, 0))]
    strips = strips_of(*shapes, left_hand=True)
    move_apart(shapes, strips, [], left_hand=True)
    np.testing.assert_allclose([shape[0, 1] for shape in shapes], [1.6, -1.6])


def test_bent_lanes_move_apart_by_a_constant_distance() -> None:
    drawn = line((0, 0), (100, 0), (100, 100))
    shapes = [drawn, drawn[::-1].copy()]
    move_apart(shapes, strips_of(*shapes), [], left_hand=False)
    np.testing.assert_allclose(shapes[0][:, :2], [(0, -1.6), (101.6, -1.6), (101.6, 100)])
    np.testing.assert_allclose(shapes[1][:, :2], [(98.4, 100), (98.4, 1.6), (0, 1.6)])


@pytest.mark.parametrize(
    "other",
    [
        line((100, 3.2), (0, 3.2)),  # beside the first lane
        line((100, 0, 5.0), (0, 0, 5.0)),  # on a bridge above
        line((100, 0), (50, 40), (0, 0)),  # touches only the ends
    ],
)
def test_lanes_that_do_not_overlap_share_no_strip(other: Shape) -> None:
    assert strips_of(line((0, 0), (100, 0)), other) == []


def test_ordinary_maps_have_no_shared_strips(tmp_path: Path) -> None:
    path = bent_street(tmp_path, [20.0], lanes=2)
    network = read_network(path)
    assert network.notes == ()
    assert [one for one in find_defects(network, path) if one.kind == KIND] == []


def test_cars_drive_a_street_with_shared_tracks_without_a_collision(tmp_path: Path) -> None:
    path = tram_street(tmp_path)
    network = read_network(path)
    assert least_apart(network) == pytest.approx(3.2)
    (note,) = check_map(network).notes[:1]
    assert note.startswith("moved 4 pairs of opposite edges by up to 1.6 m")
    found = evaluate(path, "idm", episodes=4, agents=8, background=8)["idm"]
    assert found["collision"].mean == 0.0


@pytest.mark.parametrize("lanes", [1, 2])
def test_two_directions_with_one_centre_line_move_apart(tmp_path: Path, lanes: int) -> None:
    path = bent_street(tmp_path, [30.0], lanes=lanes, attributes='spreadType="center"')
    assert least_apart(read_network(path)) > 3.1
    found = evaluate(path, "idm", episodes=4, agents=6, background=0)["idm"]
    assert found["success"].mean == 1.0


def test_the_check_names_shared_strips_and_the_repair_separates_them(tmp_path: Path) -> None:
    path, target = tram_street(tmp_path), tmp_path / "mended.net.xml"
    before = [one for one in find_defects(read_network(path), path) if one.kind == KIND]
    assert sorted(one.name for one in before) == ["0_1_1", "1_2_1", "2_3_1", "3_4_1"]
    assert before[0].about == "with 1_0_1; cavmarl moves it 1.6 m"
    done, left = mend(path, target, before)
    assert f"{KIND} 0_1_1: repaired" in done
    assert left == []
    mended = read_network(target)
    assert mended.notes == ()
    assert least_apart(mended) == pytest.approx(3.2)
