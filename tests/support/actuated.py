"""A small map with actuated signals, made by SUMO."""

from __future__ import annotations

from pathlib import Path

from tests.support.netgenerate import netgenerate

__all__ = ["actuated_grid"]


def actuated_grid(folder: Path) -> Path:
    """Make a map of four crossings with actuated signals and short roads of two lanes."""
    return netgenerate(
        folder / "grid.net.xml",
        *("--grid", "--grid.number", "2", "--grid.length", "120"),
        *("--grid.attach-length", "100", "--default-junction-type", "traffic_light"),
        *("--tls.default-type", "actuated", "--default.lanenumber", "2", "--no-turnarounds"),
    )
