"""Exports comply with the rules of ASAM for OpenDRIVE."""

from __future__ import annotations

import math
import subprocess
from pathlib import Path
from xml.etree.ElementTree import Element, fromstring

import numpy as np
import pytest

from cavmarl.maps.exports.opendrive import write_opendrive
from cavmarl.maps.exports.opendrive_curves import curve_length_m
from cavmarl.maps.heights.draping import HeightOptions
from cavmarl.maps.netconvert import build_network
from tests.support.terrain import TOWN, plane, write_geotiff

pytest.importorskip("sumo", reason="needs the extra 'sumo'")

ROOT = Path(__file__).parents[3]
CHECKER = ROOT / ".venv-tools" / "bin" / "python"


@pytest.fixture(scope="module")
def export(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Export a town on a slope; vehicles make U-turns at its dead ends."""
    folder = tmp_path_factory.mktemp("export")
    (folder / "town.osm").write_text(TOWN)
    model = write_geotiff(folder / "ground.tif", plane(0.02, 0.05))
    options = HeightOptions((model,))
    town = build_network(folder / "town.osm", folder / "town.net.xml", heights=options).path
    write_opendrive(town, folder / "town.xodr")
    return folder / "town.xodr"


@pytest.fixture(scope="module")
def roads(export: Path) -> dict[str, Element]:
    return {road.get("id", ""): road for road in fromstring(export.read_text()).iter("road")}


def _polyline(geometry: Element) -> np.ndarray:
    x, y, heading, length = (float(geometry.get(key, "0")) for key in ("x", "y", "hdg", "length"))
    p = np.linspace(0.0, 1.0, 2001)
    curve = geometry.find("paramPoly3")
    if curve is None:
        u, v = p * length, 0.0 * p
    else:
        u, v = (
            sum(float(curve.get(f"{key}{axis}", "0")) * p**n for n, key in enumerate("abcd"))
            for axis in "UV"
        )
    cos, sin = math.cos(heading), math.sin(heading)
    return np.stack([x + u * cos - v * sin, y + u * sin + v * cos], axis=1)


def test_lengths_equal_those_of_the_curves(roads: dict[str, Element]) -> None:
    curves = 0
    for road in roads.values():
        s = 0.0
        for geometry in road.iterfind("planView/geometry"):
            walked = float(np.hypot(*np.diff(_polyline(geometry), axis=0).T).sum())
            assert walked == pytest.approx(float(geometry.get("length", "0")), abs=1e-3)
            assert float(geometry.get("s", "0")) == pytest.approx(s, abs=1e-6)
            s += float(geometry.get("length", "0"))
            curves += geometry.find("paramPoly3") is not None
        assert float(road.get("length", "0")) == pytest.approx(s, abs=1e-6)
        places = [float(one.get("s", "0")) for one in road.iterfind("elevationProfile/elevation")]
        assert places == sorted(places)
        assert max(places) < s
    assert curves > 10


def test_lanes_over_junctions_join_the_roads_without_a_gap(roads: dict[str, Element]) -> None:
    def border(road: Element, at_start: bool, lane: int) -> np.ndarray:
        geometry = road.findall("planView/geometry")[0 if at_start else -1]
        line = _polyline(geometry)
        one, other = (line[0], line[1]) if at_start else (line[-2], line[-1])
        step = (other - one) / np.hypot(*(other - one))
        offset = road.find("lanes/laneOffset")
        left = 0.0 if offset is None else float(offset.get("a", "0"))
        for row in road.iterfind("lanes/laneSection/right/lane"):
            if int(row.get("id", "0")) > lane:
                left -= float(row.find("width").get("a", "0"))
        return (one if at_start else other) + left * np.array([-step[1], step[0]])

    around = 0
    for road in roads.values():
        if road.get("junction") == "-1":
            continue
        around += road.find("lanes/laneOffset") is not None
        for kind, at_start in (("predecessor", True), ("successor", False)):
            other = roads[road.find(f"link/{kind}").get("elementId")]
            for lane in road.iterfind("lanes/laneSection/right/lane"):
                there = int(lane.find(f"link/{kind}").get("id"))
                mine = border(road, at_start, int(lane.get("id", "0")))
                assert mine == pytest.approx(border(other, not at_start, there), abs=0.01)
    assert around > 0  # the map has U-turns at dead ends


def test_the_length_of_a_quarter_circle_has_an_error_below_0_03_per_cent() -> None:
    k = 4.0 / 3.0 * math.tan(math.pi / 8.0)
    control = 10.0 * np.array([(1.0, 0.0), (1.0, k), (k, 1.0), (0.0, 1.0)])
    p0, p1, p2, p3 = control
    found = np.stack([p0, 3 * (p1 - p0), 3 * (p2 - 2 * p1 + p0), p3 - 3 * (p2 - p1) - p0], axis=1)
    assert curve_length_m(found) == pytest.approx(5.0 * math.pi, rel=3e-4)


def test_two_exports_of_a_map_have_equal_bytes(export: Path, tmp_path: Path) -> None:
    again = tmp_path / "town.xodr"
    write_opendrive(export.with_name("town.net.xml"), again)
    assert again.read_bytes() == export.read_bytes()
    assert 'code="licence"' in export.read_text()
    assert "ODbL" in export.read_text()


@pytest.mark.skipif(not CHECKER.exists(), reason="needs ASAM's checker: make rules")
def test_the_checker_of_asam_finds_no_violation(export: Path) -> None:
    words = [str(CHECKER), "-m", "docs.opendrive_rules", str(export)]
    result = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, check=False)
    assert "23 of 23 rules checked, 0 violations" in result.stdout, result.stdout + result.stderr
