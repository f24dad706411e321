"""Demand that fills an empty map, so that worlds of unequal age differ in cost."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.errors import ConfigError
from cavmarl.roads.network import RoadNetwork

__all__ = ["write_filling_demand"]


def write_filling_demand(
    network: RoadNetwork, path: Path, *, seconds: float, period_s: float
) -> Path:
    """Write flows from every road into the map to every road out of it."""
    ins, outs = _ends(network, "num_into"), _ends(network, "num_links")
    if not (ins and outs):
        raise ConfigError(
            f"map '{network.name}': needs roads that lead in and out; choose another map"
        )
    flows = "\n".join(
        f'  <flow id="{a}-{b}" from="{a}" to="{b}" begin="{period_s * n:g}" end="{seconds:g}" '
        f'period="{period_s * len(outs):g}" departLane="free" departSpeed="desired"/>'
        for a in ins
        for n, b in enumerate(outs)
        if period_s * n < seconds
    )
    path.write_text(f"<routes>\n{flows}\n</routes>\n", encoding="utf-8")
    return path


def _ends(network: RoadNetwork, links: str) -> list[str]:
    """Return the ids of roads whose lanes all have 0 in `links`, a column of the lanes."""
    lanes, edges = network.lanes, network.edges
    linked: NDArray[np.int64] = np.bincount(lanes["edge"], lanes[links], len(edges))
    return [network.edge_ids[e] for e in np.flatnonzero((linked == 0) & ~edges["internal"])]
