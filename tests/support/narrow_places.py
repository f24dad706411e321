"""Maps with little space: a lane drop, close signals, close U-turns, and paths that cross."""

from __future__ import annotations

from pathlib import Path

from tests.support.netgenerate import netconvert

ZIPPER_NODES = """<nodes><node id="a" x="0" y="0"/><node id="b" x="300" y="0" type="zipper"/>
<node id="c" x="600" y="0"/></nodes>"""
ZIPPER_EDGES = """<edges><edge id="ab" from="a" to="b" numLanes="2" speed="13.9"/>
<edge id="bc" from="b" to="c" speed="13.9"/></edges>"""
ZIPPER_CONNECTIONS = """<connections><connection from="ab" to="bc" fromLane="0" toLane="0"/>
<connection from="ab" to="bc" fromLane="1" toLane="0"/></connections>"""
ZIPPER_DEMAND = """<routes><vType id="car"/><vType id="truck" vClass="truck"/>
<vType id="idm" carFollowModel="IDM"/>
<vTypeDistribution id="mix" vTypes="car truck idm" probabilities="6 1 3"/>
<flow id="right" type="{type}" from="ab" to="bc" begin="0" end="900" vehsPerHour="{per_h}"
  departLane="0" departSpeed="max"/>
<flow id="left" type="{type}" from="ab" to="bc" begin="0" end="900" vehsPerHour="{per_h}"
  departLane="1" departSpeed="max"/></routes>"""

PAIR_NODES = """<nodes>
<node id="n" x="0" y="{north}"/><node id="s" x="0" y="-300"/><node id="w1" x="-300" y="0"/>
<node id="e1" x="300" y="0"/><node id="w2" x="-300" y="{apart}"/><node id="e2" x="300" y="{apart}"/>
<node id="j1" x="0" y="0" type="traffic_light"/>
<node id="j2" x="0" y="{apart}" type="{second}"/></nodes>"""
PAIR_EDGES = """<edges><edge id="sj" from="s" to="j1" numLanes="2"/>
<edge id="js" from="j1" to="s" numLanes="2"/><edge id="up" from="j1" to="j2" numLanes="2"/>
<edge id="down" from="j2" to="j1" numLanes="2"/><edge id="nj" from="n" to="j2" numLanes="2"/>
<edge id="jn" from="j2" to="n" numLanes="2"/><edge id="wj1" from="w1" to="j1"/>
<edge id="je1" from="j1" to="e1"/><edge id="ej2" from="e2" to="j2"/>
<edge id="jw2" from="j2" to="w2"/></edges>"""
PAIR_CONNECTIONS = """<connections>
<connection from="sj" to="up" fromLane="0" toLane="0"/>
<connection from="sj" to="up" fromLane="1" toLane="1"/>
<connection from="up" to="jn" fromLane="0" toLane="0"/>
<connection from="up" to="jw2" fromLane="1" toLane="0"/>
<connection from="nj" to="down" fromLane="0" toLane="0"/>
<connection from="nj" to="down" fromLane="1" toLane="1"/>
<connection from="down" to="js" fromLane="0" toLane="0"/>
<connection from="down" to="je1" fromLane="1" toLane="0"/>
<connection from="wj1" to="je1" fromLane="0" toLane="0"/>
<connection from="ej2" to="jw2" fromLane="0" toLane="0"/></connections>"""
PAIR_DEMAND = """<routes>
<flow id="ns" from="nj" to="js" begin="0" end="900" vehsPerHour="450" departLane="best"/>
<flow id="ne" from="nj" to="je1" begin="0" end="900" vehsPerHour="300" departLane="best"/>
<flow id="sn" from="sj" to="jn" begin="0" end="900" vehsPerHour="450" departLane="best"/>
<flow id="sw" from="sj" to="jw2" begin="0" end="900" vehsPerHour="300" departLane="best"/>
<flow id="we" from="wj1" to="je1" begin="0" end="900" vehsPerHour="150"/>
<flow id="ew" from="ej2" to="jw2" begin="0" end="900" vehsPerHour="150"/></routes>"""

# Two signals, and between them a junction with a path of 24 m between lanes of 4 m and 0.8 m.
BETWEEN_NODES = """<nodes><node id="s" x="0" y="-300"/><node id="n" x="0" y="340"/>
<node id="w1" x="-100" y="0"/><node id="e1" x="100" y="0"/><node id="w2" x="-100" y="40"/>
<node id="e2" x="100" y="40"/><node id="w3" x="-100" y="20"/><node id="e3" x="100" y="20"/>
<node id="j1" x="0" y="0" type="traffic_light"/><node id="j2" x="0" y="40" type="traffic_light"/>
<node id="m" x="0" y="20" type="priority" radius="12"/></nodes>"""
BETWEEN_EDGES = """<edges><edge id="sj" from="s" to="j1"/><edge id="jm" from="j1" to="m"/>
<edge id="mj" from="m" to="j2"/><edge id="jn" from="j2" to="n"/><edge id="wj1" from="w1" to="j1"/>
<edge id="je1" from="j1" to="e1"/><edge id="wj2" from="w2" to="j2"/>
<edge id="je2" from="j2" to="e2"/>{crossing}</edges>"""
CROSSING_EDGES = '<edge id="wm" from="w3" to="m"/><edge id="me" from="m" to="e3"/>'

TURNS_NODES = """<nodes><node id="w" x="-200" y="0"/><node id="a" x="0" y="0" type="priority"/>
<node id="b" x="11" y="0" type="priority"/><node id="e" x="211" y="0"/></nodes>"""
TURNS_EDGES = """<edges><edge id="wa" from="w" to="a" priority="2"/>
<edge id="aw" from="a" to="w" priority="2"/><edge id="ab" from="a" to="b" priority="2"/>
<edge id="ba" from="b" to="a" priority="2"/><edge id="be" from="b" to="e" priority="2"/>
<edge id="eb" from="e" to="b" priority="2"/></edges>"""
TURNS_CONNECTIONS = """<connections>
<connection from="wa" to="ab" fromLane="0" toLane="0" keepClear="true"/>
<connection from="ab" to="be" fromLane="0" toLane="0"/>
<connection from="ab" to="ba" fromLane="0" toLane="0"/>
<connection from="eb" to="ba" fromLane="0" toLane="0" keepClear="true"/>
<connection from="ba" to="aw" fromLane="0" toLane="0"/>
<connection from="ba" to="ab" fromLane="0" toLane="0"/></connections>"""
TURNS_DEMAND = """<routes>
<flow id="west" begin="0" end="900" period="30"><route edges="wa ab ba aw"/></flow>
<flow id="east" begin="1" end="900" period="30.5"><route edges="eb ba ab be"/></flow></routes>"""

LOOP_NODES = """<nodes><node id="w" x="-150" y="0"/><node id="j" x="0" y="0" type="priority"/>
<node id="e" x="150" y="0"/><node id="s" x="14" y="-150"/></nodes>"""
LOOP_EDGES = """<edges><edge id="wj" from="w" to="j" shape="-150,0 -8,0"/>
<edge id="je" from="j" to="e" shape="14,0 150,0"/>
<edge id="js" from="j" to="s" shape="14,-8 14,-150"/></edges>"""
LOOP_CONNECTIONS = """<connections><connection from="wj" to="je" fromLane="0" toLane="0"/>
<connection from="wj" to="js" fromLane="0" toLane="0"
  shape="-8,-1.6 -3.4,2.3 -0.3,13.9 4,16.4 8.7,14.6 11.3,9.2 12.4,-8"/></connections>"""
LOOP_DEMAND = """<routes>
<flow id="turn" from="wj" to="js" begin="0" end="300" period="6" departSpeed="max"/>
<flow id="on" from="wj" to="je" begin="0" end="300" period="6.2" departSpeed="max"/></routes>"""


def zipper(folder: Path, per_h: int = 500, vehicle_type: str = "car") -> tuple[Path, Path]:
    """Make a road on which two lanes become one, with `per_h` vehicles/h on each lane."""
    demand = ZIPPER_DEMAND.format(type=vehicle_type, per_h=per_h)
    return _made(folder, ZIPPER_NODES, ZIPPER_EDGES, ZIPPER_CONNECTIONS, demand)


def signal_pair(
    folder: Path, apart_m: float = 24.0, second: str = "traffic_light"
) -> tuple[Path, Path]:
    """Make two crossings with signals; opposing left turns share the short road between both.

    `second`: SUMO's type of the second crossing.
    """
    nodes = PAIR_NODES.format(apart=apart_m, north=apart_m + 300.0, second=second)
    return _made(folder, nodes, PAIR_EDGES, PAIR_CONNECTIONS, PAIR_DEMAND)


def signals_with_a_junction_between(folder: Path, is_crossed: bool) -> Path:
    """Make two crossings with signals, and a junction between them that a road may cross."""
    edges = BETWEEN_EDGES.format(crossing=CROSSING_EDGES if is_crossed else "")
    return _made(folder, BETWEEN_NODES, edges, "<connections/>", "<routes/>")[0]


def turning_pair(folder: Path) -> tuple[Path, Path]:
    """Make a road of 11 m, with space for one car; vehicles turn around at both of its ends."""
    return _made(folder, TURNS_NODES, TURNS_EDGES, TURNS_CONNECTIONS, TURNS_DEMAND)


def looping_turn(folder: Path) -> tuple[Path, Path]:
    """Make a right turn that begins to the left and crosses the straight path from its lane."""
    return _made(folder, LOOP_NODES, LOOP_EDGES, LOOP_CONNECTIONS, LOOP_DEMAND)


def _made(folder: Path, nodes: str, edges: str, connections: str, demand: str) -> tuple[Path, Path]:
    for end, text in {"nod": nodes, "edg": edges, "con": connections}.items():
        (folder / f"m.{end}.xml").write_text(text, encoding="utf-8")
    routes = folder / "m.rou.xml"
    routes.write_text(demand, encoding="utf-8")
    return netconvert(folder, "m"), routes
