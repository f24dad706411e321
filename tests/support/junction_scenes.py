"""Cars at chosen positions on the arms of a crossing."""

from __future__ import annotations

import math
import subprocess
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from cavmarl.engine.simulation import Simulation
from tests.support.driving import drive, make_traffic, start
from tests.support.traffic import on_lane
from tests.support.world import traffic_of

sumo = pytest.importorskip("sumo", reason="crossings are made by netconvert of the extra 'sumo'")


ARM_M = 150
NODES = {"W": (-ARM_M, 0), "E": (ARM_M, 0), "S": (0, -ARM_M), "N": (0, ARM_M)}


def build_crossing(folder: Path, kind: str, side_lanes: int = 1, only_in: str = "") -> Path:
    """Build a crossing of a west-east main road and a south-north side road.

    `kind`: SUMO's type of the junction. The arms named in `only_in` have no outgoing road.
    """
    target = folder / f"{kind}_{side_lanes}{only_in}.net.xml"
    if target.exists():
        return target
    nodes = "".join(f'<node id="{n}" x="{x}" y="{y}"/>' for n, (x, y) in NODES.items())
    edges = "".join(
        f'<edge id="{arm}_{way}" from="{start}" to="{end}" speed="14" priority="{priority}" '
        f'numLanes="{lanes}"/>'
        for arm, priority, lanes in (
            ("W", 9, 1),
            ("E", 9, 1),
            ("S", 1, side_lanes),
            ("N", 1, side_lanes),
        )
        for way, start, end in (("in", arm, "c"), ("out", "c", arm))
        if way == "in" or arm not in only_in
    )
    (folder / "c.nod.xml").write_text(
        f'<nodes>{nodes}<node id="c" x="0" y="0" type="{kind}"/></nodes>'
    )
    (folder / "c.edg.xml").write_text(f"<edges>{edges}</edges>")
    binary = Path(sumo.SUMO_HOME) / "bin" / "netconvert"
    command = [str(binary), "-n", "c.nod.xml", "-e", "c.edg.xml", "-o", target.name]
    subprocess.run([*command, "--no-turnarounds"], cwd=folder, check=True, capture_output=True)
    return target


def with_shorter_lane(path: Path, lane: str, by_m: float) -> Path:
    """Return the same map with one lane shortened by `by_m` and its junction extended to it."""
    tree = ElementTree.parse(path)
    edge, index = lane.rsplit("_", 1)
    rows = {row.get("id"): row for row in tree.iter("lane")}
    places = [[*map(float, place.split(","))] for place in rows[lane].attrib["shape"].split()]
    (x, y), (end_x, end_y) = places[-2:]
    share = by_m / math.hypot(end_x - x, end_y - y)
    end = f"{end_x - share * (end_x - x)},{end_y - share * (end_y - y)}"
    _stretch(rows[lane], " ".join([*rows[lane].attrib["shape"].split()[:-1], end]), -by_m)
    for link in tree.iter("connection"):
        if link.get("from") == edge and link.get("fromLane") == index and "via" in link.attrib:
            inside = rows[link.get("via")]
            _stretch(inside, f"{end} {inside.attrib['shape']}", by_m)
    shorter = path.with_name(f"{lane}_{by_m}_{path.name}")
    tree.write(shorter)
    return shorter


def _stretch(row: ElementTree.Element, shape: str, by_m: float) -> None:
    row.set("shape", shape)
    row.set("length", f"{float(row.attrib['length']) + by_m:.2f}")


class Scene:
    """A crossing with cars, which runs tick by tick."""

    def __init__(self, path: Path) -> None:
        self.simulation: Simulation = make_traffic(
            path, background=12, renewed=False, overrides={"clock.ctrl_dt_s": 0.05}
        )
        traffic = traffic_of(self.simulation)
        vars(traffic)["demand"] = traffic.demand._replace(num_background=0)
        start(self.simulation, seed=0)
        self.names: list[str] = []

    def put(self, name: str, lane: str, to_line_m: float, goal: str, **fields: Any) -> None:
        """Put a car on a lane, its front `to_line_m` before the end; `goal` is an edge."""
        network, worlds = self.simulation.network, self.simulation.shards[0].worlds
        row = network.lane_ids.index(lane)
        s = float(network.lanes[row]["length_m"]) - to_line_m - 2.5
        goals = [network.edge_ids[edge] for edge in self.simulation.goal_edges[0]]
        travel = self.simulation.travel
        car = on_lane(network, row, s, travel, goal=goals.index(goal), **fields)
        plan = self.simulation.plans[car[0]["goal"], row]
        car["to_go"] = plan["to_go"] - s
        car["id"] = self.simulation.departures.next_id[0]
        self.simulation.departures.next_id[0] += 1
        worlds.rows[0, worlds.num_owned[0]] = car[0]
        worlds.num_owned[0] += 1
        worlds.num_rows[0] += 1
        self.names.append(name)

    def clear(self) -> None:
        """Remove all cars."""
        worlds = self.simulation.shards[0].worlds
        worlds.num_owned[0] = worlds.num_rows[0] = self.simulation.departures.next_id[0] = 0
        self.names.clear()

    def __getitem__(self, name: str) -> Any:
        """Return the record of a car in the scene."""
        vehicles = self.simulation.vehicles()
        return vehicles[vehicles["id"] == self.names.index(name)][0]

    def run(self, seconds: float) -> Iterator[float]:
        """Run, check that no two vehicles touch, and yield the time after each tick."""
        for _ in range(round(seconds / 0.05)):
            drive(self.simulation)
            vehicles = self.simulation.vehicles()
            assert (vehicles["hit"] < 0).all(), "vehicles collide"
            yield float(self.simulation.ticks()[0]) * 0.05

    def entries(self, seconds: float) -> dict[str, float]:
        """Return the times at which the fronts of cars crossed their lines."""
        times: dict[str, float] = {}
        network = self.simulation.network
        for time in self.run(seconds):
            for car in self.simulation.vehicles():
                name = self.names[car["id"]]
                lane = network.lanes[car["lane"]]
                front_is_over = car["s"] + 2.5 > lane["length_m"] and lane["num_links"] > 0
                if name not in times and (front_is_over or lane["internal"]):
                    times[name] = time
        return times
