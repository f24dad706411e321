"""Junctions whose movements yield to each other in a circle."""

from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks.circular_priority import circular_priority
from benchmarks.map_features import map_features
from cavmarl.roads.sumo_net.reader import read_network
from tests.support.netgenerate import netconvert, netgenerate

NODES = """<nodes><node id="C" x="0" y="0" type="{kind}"/>
    <node id="N" x="0" y="200"/><node id="E" x="200" y="0"/>
    <node id="S" x="0" y="-200"/><node id="W" x="-200" y="0"/></nodes>"""


def crossroads(folder: Path, kind: str = "priority", **priorities: int) -> Path:
    """Build a crossing whose arms have these priorities; return its map."""
    roads = "".join(
        f'<edge id="{arm}C" from="{arm}" to="C" priority="{priority}"/>'
        f'<edge id="C{arm}" from="C" to="{arm}" priority="{priority}"/>'
        for arm, priority in priorities.items()
    )
    texts = {"nod": NODES.format(kind=kind), "edg": f"<edges>{roads}</edges>"}
    for end, text in (texts | {"con": "<connections/>"}).items():
        (folder / f"cross.{end}.xml").write_text(text)
    return netconvert(folder, "cross")


def test_three_movements_of_a_crossing_with_different_priorities_yield_in_a_circle(
    tmp_path: Path,
) -> None:
    network = read_network(crossroads(tmp_path, N=3, S=3, W=4, E=1))
    found = circular_priority(network)
    ways = network.links[["from_lane", "to_lane"]][found].tolist()
    names = {tuple(network.lane_ids[lane][:2] for lane in way) for way in ways}
    # The straight link from the south yields to the straight link from the east, which yields to
    # the left turn from the north, which yields to the straight link from the south.
    assert {("SC", "CN"), ("EC", "CW"), ("NC", "CE")} <= names
    assert not any(way[0] == "WC" for way in names), (
        "a link of the road with the highest priority is in a circle"
    )
    assert map_features(network) == ("circular_priority",)


@pytest.mark.parametrize("kind", ["priority", "right_before_left", "allway_stop", "traffic_light"])
def test_ordinary_junctions_have_no_movements_that_yield_in_a_circle(
    tmp_path: Path, kind: str
) -> None:
    network = read_network(crossroads(tmp_path, kind, N=1, S=1, W=4, E=4))
    assert not circular_priority(network).size


def test_maps_with_random_priorities_have_circles(tmp_path: Path) -> None:
    options = ("--random-priority=true", "--default.priority=4", "--grid", "--grid.number=4")
    network = read_network(netgenerate(tmp_path / "random.net.xml", *options))
    assert circular_priority(network).size
