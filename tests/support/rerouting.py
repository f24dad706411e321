"""A map with a short and a long route to the same goal, and traffic that can take both."""

from __future__ import annotations

import subprocess
from collections import Counter
from pathlib import Path

import defusedxml.ElementTree
import pytest

from cavmarl.engine.simulation import Simulation
from tests.support.demand_worlds import make
from tests.support.driving import drive, start

# The routes are in → short → narrow → out, and in → long1 → long2 → out. The narrow edge is slow
# and 40 m long. Vehicles that do not fit on it queue on the short edge.
NODES = """<nodes>
  <node id="A" x="0" y="0"/><node id="B" x="300" y="0"/><node id="C" x="700" y="0"/>
  <node id="D" x="740" y="0"/><node id="E" x="1040" y="0"/><node id="X" x="520" y="-350"/>
</nodes>"""
EDGES = """<edges>
  <edge id="in" from="A" to="B" numLanes="1" speed="13.89"/>
  <edge id="short" from="B" to="C" numLanes="1" speed="13.89"/>
  <edge id="narrow" from="C" to="D" numLanes="1" speed="3"/>
  <edge id="long1" from="B" to="X" numLanes="1" speed="13.89"/>
  <edge id="long2" from="X" to="D" numLanes="1" speed="13.89"/>
  <edge id="out" from="D" to="E" numLanes="2" speed="13.89"/>
</edges>"""
CONNECTIONS = """<connections>
  <connection from="narrow" to="out" fromLane="0" toLane="1"/>
  <connection from="long2" to="out" fromLane="0" toLane="0"/>
</connections>"""

CARS = '<vType id="car" sigma="0" speedDev="0">{device}</vType>'
DEVICE = (
    '<param key="has.rerouting.device" value="true"/>'
    '<param key="device.rerouting.period" value="30"/>'
)
FLOW = (
    '<flow id="f" type="car" from="in" to="out" begin="0" end="900" period="3" departSpeed="max"/>'
)


def sumo_binary(name: str) -> str:
    sumo = pytest.importorskip("sumo", reason="needs the extra 'sumo'")
    return str(Path(sumo.SUMO_HOME) / "bin" / name)


def make_map(folder: Path) -> Path:
    """Make a SUMO network with the two routes."""
    parts = {"nodes": NODES, "edges": EDGES, "connections": CONNECTIONS}
    options = []
    for name, content in parts.items():
        path = folder / f"{name}.xml"
        path.write_text(content, encoding="utf-8")
        options += [f"--{name.removesuffix('s')}-files", str(path)]
    net = folder / "two.net.xml"
    command = [sumo_binary("netconvert"), *options, "-o", str(net), "--no-turnarounds"]
    subprocess.run(command, check=True, capture_output=True)
    return net


def write_demand(folder: Path, body: str, additional: str = "") -> list[Path]:
    """Write the files of a demand: one with routes, and one with additional elements."""
    files = [folder / "x.rou.xml", folder / "x.add.xml"]
    for path, root, content in zip(
        files, ("routes", "additional"), (body, additional), strict=True
    ):
        path.write_text(f"<{root}>\n{content}\n</{root}>", encoding="utf-8")
    return files


def two_ways(
    net: Path,
    folder: Path,
    body: str,
    additional: str = "",
    *,
    num_worlds: int = 1,
    seed: int | None = 1,
) -> Simulation:
    """Make worlds on this map; reset the worlds unless the seed is None."""
    clock = {"clock.sim_dt_s": 0.2, "clock.ctrl_dt_s": 1.0, "horizon_s": 1200.0}
    simulation = make(
        net, write_demand(folder, body, additional), num_worlds=num_worlds, overrides=clock
    )
    if seed is not None:
        start(simulation, seed)
    return simulation


def rerouter(inside: str, attrs: str = "", span: str = 'begin="100" end="500"') -> str:
    """Return a <rerouter> element on the first edge."""
    return f'<rerouter id="x" edges="in" {attrs}><interval {span}>{inside}</interval></rerouter>'


def passed(simulation: Simulation, seconds: int) -> dict[str, int]:
    """Return the number of vehicles that are on each edge during the next seconds."""
    network = simulation.network
    found: set[tuple[int, int]] = set()
    for _ in range(seconds):
        drive(simulation)
        rows = simulation.vehicles()
        edges = network.lanes["edge"][rows["lane"]]
        found |= set(zip(edges.tolist(), rows["id"].tolist(), strict=True))
    return {
        name: sum(edge == row for edge, _ in found) for row, name in enumerate(network.edge_ids)
    }


def sumo_passed(net: Path, files: list[Path], folder: Path) -> Counter[str]:
    """Return the number of vehicles that have driven over each edge in SUMO's own run."""
    out = folder / "routes.out.xml"
    command = (
        f"-n {net} -r {files[0]} -a {files[1]} --vehroute-output {out} --step-length 0.2 "
        "--end 1200 --vehroute-output.last-route --no-step-log --xml-validation never"
    )
    subprocess.run([sumo_binary("sumo"), *command.split()], check=True, capture_output=True)
    counts: Counter[str] = Counter()
    for vehicle in defusedxml.ElementTree.parse(out).iter("vehicle"):
        counts.update(vehicle.findall(".//route")[-1].attrib["edges"].split())
    return counts
