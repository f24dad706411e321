"""Make maps with SUMO's netgenerate, and with netconvert from plain nodes and edges."""

from __future__ import annotations

import subprocess
from pathlib import Path

import pytest

__all__ = ["netconvert", "netgenerate", "random_map"]

JUNCTIONS = ("priority", "traffic_light", "right_before_left", "allway_stop")


def netgenerate(path: Path, *options: str) -> Path:
    """Make a network with these options; skip the test if SUMO is not installed."""
    return _made("netgenerate", path, *options)


def netconvert(folder: Path, name: str) -> Path:
    """Build the network of `NAME.nod.xml`, `NAME.edg.xml` and `NAME.con.xml` beside these files."""
    kinds = {"node": "nod", "edge": "edg", "connection": "con"}
    files = [f"--{kind}-files={folder / name}.{end}.xml" for kind, end in kinds.items()]
    return _made("netconvert", folder / f"{name}.net.xml", *files)


def _made(program: str, path: Path, *options: str) -> Path:
    sumo = pytest.importorskip("sumo", reason="needs the extra: sumo")
    tool = Path(sumo.SUMO_HOME) / "bin" / program
    command = [tool, *options, "--xml-validation", "never", "--output-file", str(path)]
    subprocess.run(command, check=True, capture_output=True)
    return path


def random_map(folder: Path, number: int) -> Path:
    """Make one of several maps by number: random, grid or spider, with different junctions."""
    common = ["-L", str(1 + number % 2), "-j", JUNCTIONS[number // 3 % 4], "--seed", str(number)]
    kinds = (
        ["--rand", "--rand.iterations", "40"],
        ["--grid", "--grid.number", str(3 + number % 4), "--grid.length", str(100 + 5 * number)],
        ["--spider", "--spider.arm-number", str(4 + number % 5), "--spider.omit-center", "true"],
    )
    return netgenerate(folder / "random.net.xml", *kinds[number % 3], *common)
