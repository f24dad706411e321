"""The side of traffic follows from the place, the rule of the roads, or an option."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from cavmarl.cli import app
from cavmarl.core.errors import ConfigError, MapError
from cavmarl.maps.netconvert import build_network, conversion_notes, map_file
from cavmarl.maps.traffic_sides import Side, sides_at
from cavmarl.roads.network import RoadNetwork
from cavmarl.roads.sumo_net.reader import read_network
from tests.support.driving import drive, make_traffic, start
from tests.support.map_sources import ROUNDABOUT, built_from, osm_file, road_file

pytest.importorskip("sumo", reason="needs the extra 'sumo'")

LEFT = {
    "London": (-0.1, 51.5), "Dover": (1.31, 51.13), "Jersey": (-2.1, 49.2), "Tokyo": (139.7, 35.7),
    "Naha": (127.68, 26.21), "Delhi": (77.2, 28.6), "Sydney": (151.2, -33.9),
    "Auckland": (174.76, -36.85), "Hong Kong": (114.16, 22.28), "Bangkok": (100.5, 13.75),
    "Nong Khai": (102.74, 17.85), "Singapore": (103.85, 1.3), "Nairobi": (36.8, -1.3),
    "Windhoek": (17.08, -22.56), "Cape Town": (18.42, -33.92), "Nicosia": (33.37, 35.17),
    "Kingston": (-76.8, 17.97), "Paramaribo": (-55.2, 5.85), "Suva": (178.44, -18.14),
    "Apia": (-171.76, -13.83), "Stanley": (-57.86, -51.7), "Belfast": (-5.93, 54.6),
}  # fmt: skip
RIGHT = {
    "Calais": (1.85, 50.95), "Cherbourg": (-1.62, 49.64), "Shenzhen": (114.06, 22.56),
    "Yangon": (96.15, 16.8), "Phnom Penh": (104.9, 11.55), "Kabul": (69.2, 34.5),
    "Lhasa": (91.1, 29.65), "Addis Ababa": (38.75, 9.0), "Kigali": (30.06, -1.95),
    "Lubumbashi": (27.48, -11.66), "Luanda": (13.2, -8.8), "Cayenne": (-52.33, 4.93),
    "San Juan": (-66.1, 18.45), "Pago Pago": (-170.7, -14.28), "Gibraltar": (-5.35, 36.14),
    "Busan": (129.04, 35.1), "Taipei": (121.5, 25.03), "New York": (-74.0, 40.7),
    "Monaco": (7.42, 43.74), "the sea": (0.0, 0.0),
}  # fmt: skip


@pytest.mark.parametrize(("places", "side"), [(LEFT, "left"), (RIGHT, "right")])
def test_places_have_the_traffic_side_of_their_country(
    places: dict[str, tuple[float, float]], side: Side
) -> None:
    wrong = {
        name: found for name, place in places.items() if (found := sides_at([place])) != {side}
    }
    assert wrong == {}


def test_places_near_a_border_do_not_determine_the_side() -> None:
    vientiane, south_of_it = (102.62, 17.965), (102.62, 17.80)
    assert sides_at([vientiane]) == set()
    assert sides_at([vientiane, south_of_it]) == {"left"}
    assert sides_at([(102.62, 18.2), south_of_it]) == {"left", "right"}


def test_a_roundabout_in_london_is_driven_clockwise(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "map.osm"
    path.write_text(osm_file(ROUNDABOUT, 51.5, -0.1))
    result = build_network(path, tmp_path / "map.net.xml")
    assert result.options[-1] == "--lefthand"
    assert result.provenance["traffic side"] == "left (by the place of its roads)"
    network = read_network(result.path)
    assert network.left_hand
    # Links from the four roads to the ring yield; links of the ring do not.
    yields = {
        network.lane_ids[row["from_lane"]].partition("_")[0].lstrip("-")
        for row in network.links
        if network.conflicts["must_yield"][row["first_conflict"] :][: row["num_conflicts"]].any()
    }
    assert yields == {"300", "302", "304", "306"}
    world = make_traffic(result.path, background=12)
    start(world, 1)
    for _ in range(1200):
        drive(world)
        assert (world.vehicles(0)["hit"] < 0).all()
    assert world.traffic_stats(0).arrived > 40

    monkeypatch.setenv("CAVMARL_CACHE_DIR", str(tmp_path))
    assert read_network(map_file(path)).left_hand
    side, defaults = conversion_notes(map_file(path))
    assert side == "traffic side: left (by the place of its roads)"
    assert defaults.startswith("defaults: highway.secondary lanes=1 (12 of 12 edges)")


def test_the_option_takes_precedence_over_the_place(tmp_path: Path) -> None:
    path = tmp_path / "map.osm"
    path.write_text(osm_file(ROUNDABOUT, 48.0, 11.0))
    assert not read_network(build_network(path, tmp_path / "right.net.xml").path).left_hand
    done = CliRunner().invoke(
        app,
        ["map", "build", str(path), "--traffic-side", "left", "-o", str(tmp_path / "left.net.xml")],
    )
    assert done.exit_code == 0, done.output
    assert "traffic side: left (by option)" in " ".join(done.output.split())
    assert read_network(tmp_path / "left.net.xml").left_hand
    with pytest.raises(ConfigError, match="is a SUMO network, which has its own side"):
        build_network(tmp_path / "left.net.xml", tmp_path / "copy.net.xml", side="right")


def test_a_map_with_both_traffic_sides_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "map.osm"
    both = osm_file(ROUNDABOUT, 18.2, 102.62).replace(
        "</osm>",
        '<node id="9" lat="17.8" lon="102.62"/><way id="99"><nd ref="206"/><nd ref="9"/>'
        '<tag k="highway" v="primary"/></way></osm>',
    )
    path.write_text(both)
    with pytest.raises(MapError, match=r"left-hand and with right-hand traffic.*--traffic-side"):
        build_network(path, tmp_path / "map.net.xml")
    cropped = build_network(path, tmp_path / "map.net.xml", bbox=(102.0, 18.1, 103.0, 18.3))
    assert cropped.provenance["traffic side"].startswith("right")
    path.write_text(osm_file(ROUNDABOUT, 17.965, 102.62))
    with pytest.raises(MapError, match=r"within 3 km of a border .*--traffic-side"):
        build_network(path, tmp_path / "map.net.xml")
    assert build_network(path, tmp_path / "map.net.xml", side="left").options[-1] == "--lefthand"


WIDTHS = '<width sOffset="0" a="{}" b="0" c="0" d="0"/>'
RIGHT_HAND = road_file(
    '<road name="" length="{length}" id="1" junction="-1"{rule}>'
    '<planView><geometry s="0" x="5" y="{y}" hdg="{hdg}" length="80"><line/></geometry>'
    '<geometry s="80" x="84.601" y="{y_arc}" hdg="{hdg}" length="60"><arc curvature="{arc}"/>'
    "</geometry></planView>"
    '<lanes><laneOffset s="0" a="{offset}" b="0" c="0" d="0"/><laneSection s="0">'
    "{lanes}</laneSection></lanes></road>"
).replace('length="{length}"', 'length="140"')


def asymmetric(*, mirrored: bool) -> str:
    """Return a bent road with three lanes in one direction and one back, or its mirror image."""
    sign = -1 if mirrored else 1
    lanes = {
        n: f'<lane id="{n}" type="driving"><link/>' + WIDTHS.format(3.0 + 0.2 * abs(n)) + "</lane>"
        for n in range(-3, 4)
    }
    many = [lanes[n] for n in ((3, 2, 1) if mirrored else (-1, -2, -3))]
    one = [lanes[-1 if mirrored else 1]]
    left, right = (many, one) if mirrored else (one, many)
    return RIGHT_HAND.format(
        rule=' rule="LHT"' if mirrored else "",
        y=3.0 * sign,
        y_arc=(3.0 + 80 * np.sin(0.1)) * sign,
        hdg=0.1 * sign,
        arc=0.01 * sign,
        offset=1.5 * sign,
        lanes=f"<left>{''.join(left)}</left><center><lane id='0' type='none'/></center>"
        f"<right>{''.join(right)}</right>",
    )


def shapes(network: RoadNetwork, sign: float) -> list[list[tuple[float, float]]]:
    """Return the centre lines of lanes outside of junctions, relative to the lowest x and y."""
    lines = [
        network.lane_polyline(lane)[:, :2] * (1.0, sign)
        for lane in np.flatnonzero(~network.lanes["internal"])
    ]
    low = np.concatenate(lines).min(axis=0)
    return sorted([(round(x, 1), round(y, 1)) for x, y in line - low] for line in lines)


def test_left_hand_opendrive_is_the_mirror_image_of_right_hand(tmp_path: Path) -> None:
    right = built_from(tmp_path, "right.xodr", asymmetric(mirrored=False))
    left = built_from(tmp_path, "left.xodr", asymmetric(mirrored=True))
    assert (right.left_hand, left.left_hand) == (False, True)
    assert len(right.lanes) == len(left.lanes)
    for one, other in zip(shapes(right, 1.0), shapes(left, -1.0), strict=True):
        assert np.abs(np.array(one) - np.array(other)).max() < 0.15  # netconvert rounds coordinates


def test_roads_with_different_rules_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "map.xodr"
    second = re.sub(r' id="1" j', ' id="2" j', asymmetric(mirrored=True).split("header")[1])
    road = "<road" + second.split("<road", 1)[1].removesuffix("</OpenDRIVE>")
    path.write_text(asymmetric(mirrored=False).replace("</OpenDRIVE>", road + "</OpenDRIVE>"))
    with pytest.raises(MapError, match=r"1 roads have rule RHT .* and 1 LHT: a network has one"):
        build_network(path, tmp_path / "map.net.xml")
    result = build_network(path, tmp_path / "map.net.xml", side="left")
    assert "1 roads with rule RHT are built for left-hand traffic" in result.notes
    path.write_text(asymmetric(mirrored=True).replace("LHT", "LEFT"))
    with pytest.raises(MapError, match="rule='LEFT': must be RHT or LHT"):
        build_network(path, tmp_path / "map.net.xml")
