"""A map that SUMO builds, and demand files in a folder."""

from __future__ import annotations

import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest

from cavmarl.roads.network import RoadNetwork
from cavmarl.roads.sumo_net.reader import read_network
from cavmarl.traffic.demand import DemandFile, read_demand

# Nodes A, B and C lie from west to east, node X lies north of B. BX has one lane, other edges two.
NODES = """<nodes><node id="A" x="0" y="0"/><node id="B" x="200" y="0"/>
<node id="C" x="400" y="0"/><node id="X" x="200" y="200"/></nodes>"""
EDGES = (
    "<edges>"
    + "".join(
        f'<edge id="{a}{b}" from="{a}" to="{b}" numLanes="2" speed="13.89"/>'
        for a, b in ("AB", "BA", "BC", "CB", "XB")
    )
    + '<edge id="BX" from="B" to="X" numLanes="1" speed="13.89" allow="bus taxi"/></edges>'
)


def sumo_binary(name: str) -> str:
    sumo = pytest.importorskip("sumo", reason="needs the extra 'sumo'")
    return str(Path(sumo.SUMO_HOME) / "bin" / name)


@pytest.fixture(scope="session")
def town_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("town")
    (folder / "n.xml").write_text(NODES, encoding="utf-8")
    (folder / "e.xml").write_text(EDGES, encoding="utf-8")
    command = [sumo_binary("netconvert"), "-n", "n.xml", "-e", "e.xml", "-o", "town.net.xml"]
    subprocess.run([*command, "--no-turnarounds"], cwd=folder, check=True, capture_output=True)
    return folder / "town.net.xml"


@pytest.fixture(scope="session")
def town(town_file: Path) -> RoadNetwork:
    return read_network(town_file)


Reader = Callable[..., DemandFile]


@pytest.fixture
def demand(town: RoadNetwork, tmp_path: Path) -> Reader:
    """Return a function that reads demand from the elements inside <routes>, given as text."""

    def read(body: str, *, root: str = "routes", **options: object) -> DemandFile:
        path = tmp_path / "x.rou.xml"
        path.write_text(f"<{root}>\n{body}\n</{root}>", encoding="utf-8")
        return read_demand([path], town, **options)  # type: ignore[arg-type]

    return read
