"""Ids of contraflow roads, which run along another road in the opposite direction."""

from __future__ import annotations

CONTRAFLOW = "contraflow:"  # the id of the reversed road follows


def contraflow_of(road: str) -> str:
    """Return the id of the contraflow lanes of a road."""
    return f"{CONTRAFLOW}{road}"


def is_contraflow(road: str) -> bool:
    """Return whether an id is the id of contraflow lanes."""
    return road.startswith(CONTRAFLOW)
