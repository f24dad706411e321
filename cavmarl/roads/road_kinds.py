"""Properties of a map that matter to a trained driver: the side of traffic, and stop signs."""

from __future__ import annotations

from typing import Literal

import numpy as np

from cavmarl.roads.network import RoadNetwork

RoadKind = Literal["right_hand", "left_hand", "stop_signs"]

_STOP_SIGNS = (ord("s"), ord("w"))  # LINK["state"]: stop sign, and all-way stop


def road_kinds(network: RoadNetwork) -> tuple[RoadKind, ...]:
    """Return the kinds of a map: its side of traffic, and whether it has stop signs.

    A link counts as a stop sign if it has no signal and every vehicle must stop once.
    """
    side: RoadKind = "left_hand" if network.left_hand else "right_hand"
    links = network.links
    signs = (links["signal"] < 0) & np.isin(links["state"], _STOP_SIGNS)
    return (side, "stop_signs") if signs.any() else (side,)
