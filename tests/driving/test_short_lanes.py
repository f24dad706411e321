"""A vehicle has to change to the left on a lane that is hardly longer than the vehicle."""

from __future__ import annotations

from pathlib import Path

import pytest

from cavmarl.evaluate.traffic.native_side import idle_commands, make_world
from tests.support.netgenerate import netconvert

JUNCTION_M = 8.0  # the junctions at both ends shorten an edge by this length
NODES = """<nodes><node id="w" x="-100" y="0"/><node id="u" x="0" y="100"/>
<node id="j" x="0" y="0" type="unregulated"/><node id="k" x="{x}" y="0" type="unregulated"/>
<node id="n" x="{x}" y="100"/><node id="e" x="{east}" y="0"/></nodes>"""
EDGES = """<edges><edge id="wj" from="w" to="j"/><edge id="uj" from="u" to="j"/>
<edge id="jk" from="j" to="k" numLanes="2"/><edge id="kn" from="k" to="n"/>
<edge id="ke" from="k" to="e"/></edges>"""
CONNECTIONS = """<connections><connection from="wj" to="jk" fromLane="0" toLane="0"/>
<connection from="uj" to="jk" fromLane="0" toLane="1"/>
<connection from="jk" to="ke" fromLane="0" toLane="0"/>
<connection from="jk" to="kn" fromLane="1" toLane="0"/></connections>"""
DEMAND = """<routes><vType id="car" sigma="0"/>
<vehicle id="beside" type="car" depart="0"><route edges="uj jk kn"/>
  <stop lane="jk_1" endPos="{end}" duration="15"/></vehicle>
<vehicle id="left" type="car" depart="3"><route edges="wj jk kn"/></vehicle></routes>"""


@pytest.mark.parametrize("length_m", [9.0, 11.0, 13.4, 14.4, 14.6, 15.9, 16.1, 20.0])
def test_a_vehicle_on_a_short_lane_changes_lanes_when_the_adjacent_lane_is_free(
    tmp_path: Path, length_m: float
) -> None:
    """On lanes of 13 to 16 m, the vehicle may have to wait with its rear in the junction."""
    x = length_m + JUNCTION_M
    files = {"nod": NODES.format(x=x, east=x + 100.0), "edg": EDGES, "con": CONNECTIONS}
    for end, text in files.items():
        (tmp_path / f"m.{end}.xml").write_text(text)
    demand = tmp_path / "m.rou.xml"
    demand.write_text(DEMAND.format(end=min(length_m - 1.0, 8.0)))
    world = make_world(netconvert(tmp_path, "m"), [demand], 60, 1, 0.1)
    lanes = world.network.lanes["length_m"]
    lane = world.network.lane_ids.index("jk_0")
    assert float(lanes[lane]) == pytest.approx(length_m, abs=0.01)
    commands, stood = idle_commands(world), 0.0
    for _ in range(450):
        world.step(commands)
        for row in world.vehicles():
            if row["lane"] == lane:
                stood = max(stood, float(row["wait_s"]))
    assert stood > 5.0, "the vehicle did not wait for the adjacent lane"
    assert len(world.vehicles()) == 0, "a vehicle has not arrived"
