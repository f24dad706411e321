"""Each kind of defect of a map is found at its place, and nowhere else."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from cavmarl.cli.map import app
from cavmarl.core.errors import ConfigError
from cavmarl.maps.defects import Defect, crossing_of, find_defects
from cavmarl.maps.net_document import NetDocument
from cavmarl.maps.netconvert import build_network
from cavmarl.maps.netconvert_process import run_netconvert
from cavmarl.maps.provenance import head_of
from cavmarl.roads.sumo_net.reader import read_network
from tests.support.terrain import TOWN

pytest.importorskip("sumo", reason="needs the extra 'sumo'")


@pytest.fixture
def town(tmp_path: Path) -> Path:
    source = tmp_path / "town.osm"
    source.write_text(TOWN)
    return build_network(source, tmp_path / "town.net.xml").path


def found(path: Path, buildings: Path | None = None) -> list[Defect]:
    return find_defects(read_network(path), path, buildings)


def changed(path: Path, pattern: str, new: str) -> Path:
    text, count = re.subn(pattern, new, path.read_text(), count=1, flags=re.DOTALL)
    assert count == 1
    path.write_text(text)
    return path


def test_a_correct_map_has_no_defects(town: Path) -> None:
    assert found(town) == []


def test_narrow_lanes_are_found(town: Path) -> None:
    changed(town, r'(<lane id="10#1_0"[^>]*?) shape', r'\1 width="1.5" shape')
    (defect,) = found(town)
    assert (defect.kind, defect.name) == ("lane narrower than a car", "10#1_0")
    assert "1.50 m" in defect.about


def test_steps_in_height_are_found(town: Path) -> None:
    lane = re.search(r'<lane id="10#1_0"[^>]*? shape="([^"]*)"', town.read_text())
    assert lane
    raised = " ".join(f"{x},{y},2.0" for x, y, *_ in (one.split(",") for one in lane[1].split()))
    town.write_text(town.read_text().replace(lane[1], raised))
    steps = [defect for defect in found(town) if defect.kind == "step in height"]
    assert any(defect.name == "10#1_0" and "2.00 m" in defect.about for defect in steps)


def test_signals_without_lanes_are_found(town: Path) -> None:
    program = (
        '<tlLogic id="2" type="static" programID="0" offset="0"><phase duration="9" state="G"/>'
        "</tlLogic><junction "
    )
    changed(town, r"<junction ", program)
    network = read_network(town)
    (defect,) = found(town)
    row = network.junctions[network.junction_ids.index("2")]
    assert (defect.kind, defect.name, defect.x_m) == ("signal without lanes", "2", row["x"])


def test_crossings_without_right_of_way_are_found(town: Path) -> None:
    text = town.read_text()
    for key in ("response", "foes"):
        text = re.sub(rf'{key}="([01]+)"', lambda word: word[0].replace("1", "0"), text)
    town.write_text(text)
    kinds = {defect.kind for defect in found(town)}
    assert kinds == {"crossing without right of way"}


def test_stop_lines_inside_junctions_are_found(town: Path) -> None:
    junction = re.search(r'<junction id="2"[^>]*? x="([^"]*)" y="([^"]*)"', town.read_text())
    assert junction
    x, y = float(junction[1]), float(junction[2])
    rim = f"{x - 30},{y - 30} {x + 30},{y - 30} {x + 30},{y + 30} {x - 30},{y + 30}"
    changed(town, r'(<junction id="2"[^>]*? shape=")[^"]*', rf"\g<1>{rim}")
    kinds = {defect.kind for defect in found(town)}
    assert kinds == {"stop line inside a junction"}


def test_buildings_on_roads_are_found(town: Path, tmp_path: Path) -> None:
    network = read_network(town)
    x, y = network.lane_polyline(network.lane_ids.index("10#1_0"))[-1, :2]
    for shift, count in ((0.0, 1), (300.0, 0)):
        corners = " ".join(
            f"{x + dx + shift:.2f},{y + dy:.2f}" for dx, dy in ((-2, -3), (2, -3), (2, 3), (-2, 3))
        )
        polygons = tmp_path / "b.poly.xml"
        polygons.write_text(
            f'<additional><poly id="b" type="building" shape="{corners}"/></additional>'
        )
        on_roads = found(town, polygons)
        assert (len(on_roads) > 0) is bool(count)
        assert all(defect.kind == "building on a road" for defect in on_roads)


@pytest.mark.parametrize(
    ("tags", "is_found"),
    [
        ("", True),
        ("tunnel=no covered=no", True),
        ("tunnel=building_passage", False),
        ("tunnel=yes layer=-1", False),
        ("covered=yes", False),
    ],
)
def test_roads_through_buildings_are_not_defects(tmp_path: Path, tags: str, is_found: bool) -> None:
    words = "".join(f'<tag k="{k}" v="{v}"/>' for k, v in (one.split("=") for one in tags.split()))
    building = (
        '<node id="91" lat="48.0055" lon="10.9995"/><node id="92" lat="48.0055" lon="11.0005"/>'
        '<node id="93" lat="48.0065" lon="11.0005"/><node id="94" lat="48.0065" lon="10.9995"/>'
        '<way id="90"><nd ref="91"/><nd ref="92"/><nd ref="93"/><nd ref="94"/><nd ref="91"/>'
        '<tag k="building" v="yes"/></way></osm>'
    )
    source = tmp_path / "covered.osm"
    way = '<way id="10"><nd ref="1"/><nd ref="2"/><nd ref="3"/>'
    # The road bends inside the building, because straight lanes have points only at their ends.
    bent = '<node id="95" lat="48.006" lon="11.0001"/>'
    text = TOWN.replace('<way id="10">', f'{bent}<way id="10">', 1)
    text = text.replace(way, way.replace('<nd ref="3"/>', '<nd ref="95"/><nd ref="3"/>') + words)
    source.write_text(text.replace("</osm>", building))
    path = build_network(source, tmp_path / "covered.net.xml").path
    kinds = {defect.kind for defect in found(path, source)}
    assert ("building on a road" in kinds) is is_found


def test_paths_on_two_levels_do_not_cross() -> None:
    one = np.array([[0.0, 0.0, 0.0], [10.0, 10.0, 0.0]])
    other = np.array([[0.0, 10.0, 0.0], [10.0, 0.0, 0.0]])
    assert crossing_of(one, other) == (5.0, 5.0)
    assert crossing_of(one, other + np.array([0.0, 0.0, 6.0])) is None
    assert crossing_of(one, other + np.array([50.0, 0.0, 0.0])) is None


def two_parts(folder: Path) -> Path:
    """Write a ring of three roads, and two roads far from it."""
    places = {"a": (0, 0), "b": (200, 0), "c": (0, 200), "d": (900, 0), "e": (900, 200)}
    roads = ["ab", "bc", "ca", "ba", "de", "ed"]
    nodes = "".join(f'<node id="{name}" x="{x}" y="{y}"/>' for name, (x, y) in places.items())
    edges = "".join(f'<edge id="{road}" from="{road[0]}" to="{road[1]}"/>' for road in roads)
    (folder / "n.xml").write_text(f"<nodes>{nodes}</nodes>")
    (folder / "e.xml").write_text(f"<edges>{edges}</edges>")
    path = folder / "parts.net.xml"
    words = ["-n", str(folder / "n.xml"), "-e", str(folder / "e.xml"), "-o", str(path)]
    run_netconvert(words, path, 60.0)
    path.write_bytes(NetDocument(path).content(head_of({"licence": "ODbL"})))
    return path


def test_the_command_finds_and_removes_disconnected_roads(tmp_path: Path) -> None:
    path = two_parts(tmp_path)
    fixed, page, report = (tmp_path / name for name in ("fixed.net.xml", "p.html", "r.json"))
    words = ["check", str(path), "--fix", str(fixed), "--page", str(page), "--json", str(report)]
    result = CliRunner().invoke(app, words)
    assert result.exit_code == 0, result.output
    told = json.loads(report.read_text())
    assert {defect["kind"] for defect in told["defects"]} == {"unreachable part"}
    assert len(told["repaired"]) == len(told["defects"])
    assert told["left"] == []
    assert found(fixed) == []
    assert "ODbL" in fixed.read_text()
    assert page.read_text().count("<circle") == len(told["defects"])
    refused = CliRunner().invoke(app, ["check", str(path), "--fix", str(tmp_path / "x.txt")])
    assert isinstance(refused.exception, ConfigError)
