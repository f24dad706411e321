"""The kinds of a map that a driver was not trained on, and the warnings about them."""

from __future__ import annotations

from collections.abc import Sequence

from cavmarl.roads.network import RoadNetwork
from cavmarl.roads.road_kinds import RoadKind, road_kinds

_OTHER_SIDE = "left and right are exchanged in its observations and actions"
_NOTES: dict[RoadKind, str] = {
    "left_hand": "was trained in right-hand traffic, but this map has left-hand traffic; "
    + _OTHER_SIDE,
    "right_hand": "was trained in left-hand traffic, but this map has right-hand traffic; "
    + _OTHER_SIDE,
    "stop_signs": "was trained on maps without stop signs, but this map has some; its results may "
    "be worse than those on its card",
}


def untrained_kinds(network: RoadNetwork, trained_on: Sequence[RoadKind]) -> tuple[RoadKind, ...]:
    """Return the kinds of a map on which a driver was not trained."""
    return tuple(kind for kind in road_kinds(network) if kind not in trained_on)


def is_other_side(untrained: Sequence[RoadKind]) -> bool:
    """Return whether a driver was trained on the other side of the road."""
    return any(kind != "stop_signs" for kind in untrained)


def note_of(name: str, untrained: RoadKind) -> str:
    """Return the warning for a driver on a map of a kind that was not part of its training."""
    return f"The policy {name} {_NOTES[untrained]}"
