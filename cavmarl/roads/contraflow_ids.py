"""Ids of contraflow roads, which lead back over the ground of another road."""

from __future__ import annotations

CONTRAFLOW = "contraflow:"  # before the id of the road that is reversed


def contraflow_of(road: str) -> str:
    """Return the id of the contraflow lanes of a road."""
    return f"{CONTRAFLOW}{road}"


def is_contraflow(road: str) -> bool:
    """Return whether an id is that of contraflow lanes."""
    return road.startswith(CONTRAFLOW)
