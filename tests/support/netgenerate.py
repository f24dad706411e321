"""Maps made by SUMO's netgenerate."""

from __future__ import annotations

import subprocess
from pathlib import Path

import pytest

__all__ = ["netgenerate", "random_map"]

JUNCTIONS = ("priority", "traffic_light", "right_before_left", "allway_stop")


def netgenerate(path: Path, *options: str) -> Path:
    """Make a network with these options in a file; the test is skipped where SUMO is absent."""
    sumo = pytest.importorskip("sumo", reason="needs the extra: sumo")
    tool = Path(sumo.SUMO_HOME) / "bin" / "netgenerate"
    command = [tool, *options, "--xml-validation", "never", "--output-file", str(path)]
    subprocess.run(command, check=True, capture_output=True)
    return path


def random_map(folder: Path, number: int) -> Path:
    """The map of a number: random, grid or spider, of each kind of junction."""
    common = ["-L", str(1 + number % 2), "-j", JUNCTIONS[number // 3 % 4], "--seed", str(number)]
    kinds = (
        ["--rand", "--rand.iterations", "40"],
        ["--grid", "--grid.number", str(3 + number % 4), "--grid.length", str(100 + 5 * number)],
        ["--spider", "--spider.arm-number", str(4 + number % 5), "--spider.omit-center", "true"],
    )
    return netgenerate(folder / "random.net.xml", *kinds[number % 3], *common)
