"""A small map with actuated signals, made by SUMO."""

from __future__ import annotations

import subprocess
from pathlib import Path

import pytest

__all__ = ["actuated_grid"]


def actuated_grid(folder: Path) -> Path:
    """Four crossings with actuated signals and short roads, each of two lanes."""
    sumo = pytest.importorskip("sumo", reason="needs the extra: sumo")
    path = folder / "grid.net.xml"
    options = [
        *("--grid", "--grid.number", "2", "--grid.length", "120"),
        *("--grid.attach-length", "100", "--default-junction-type", "traffic_light"),
        *("--tls.default-type", "actuated", "--default.lanenumber", "2", "--no-turnarounds"),
        *("--xml-validation", "never", "--output-file", str(path)),
    ]
    tool = Path(sumo.SUMO_HOME) / "bin" / "netgenerate"
    subprocess.run([tool, *options], check=True, capture_output=True)
    return path
