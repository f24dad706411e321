"""`LimitTable`: the units that set speed limits, with their lanes and their observed sections."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from cavmarl.config.limits import LIMIT_TERMS, LimitsConfig
from cavmarl.core.errors import ConfigError
from cavmarl.limits.kernels.limit_steps import OF_SECTION, LimitPlaces, LimitRules
from cavmarl.roads.network import RoadNetwork
from cavmarl.signals.signal_table import SignalSizes


class LimitTable:
    """The U units that set limits, in the order of the configuration.

    Attributes:
        ids: names of the units (U,).
        sections: names of the sections (M,).
        speeds_mps: (C,) the limits to choose from.
        lanes: for each unit, the LANE rows to which its limit applies.
        arrays: the sections for kernels.
        sizes: sizes of the arrays.

    Raises:
        ConfigError: an edge is not on the map.
    """

    def __init__(self, network: RoadNetwork, config: LimitsConfig) -> None:
        self.ids = config.chosen
        self.sections = tuple(config.sections)
        self.speeds_mps = np.array(config.speeds_mps)
        rows = _lanes_by_edge(network)
        self.lanes = [_lanes(rows, "units", name, config.units) for name in self.ids]
        section = np.full(len(network.lanes), -1, dtype=np.int32)
        length_m = np.zeros(len(self.sections))
        for m, name in enumerate(self.sections):
            lanes = _lanes(rows, "sections", name, config.sections)
            section[lanes] = m
            length_m[m] = network.lanes["length_m"][lanes].sum()
        self.arrays = LimitPlaces(section, network.lanes["speed_mps"].copy(), length_m)
        self.sizes = limit_sizes(config)

    def limits_mps(self, choices: NDArray[np.int64]) -> NDArray[np.float64]:
        """Return the limit (W, L) of each lane for choices (W, U); infinite without a unit."""
        found = np.full((len(choices), len(self.arrays.section)), np.inf)
        for u, lanes in enumerate(self.lanes):
            found[:, lanes] = self.speeds_mps[choices[:, u], None]
        return found


def limit_sizes(config: LimitsConfig) -> SignalSizes:
    """Return the sizes of the arrays of the units."""
    choices = len(config.speeds_mps)
    features = choices + OF_SECTION * len(config.sections)
    return SignalSizes(len(config.chosen), choices, 0, features, len(LIMIT_TERMS))


def limit_rules(config: LimitsConfig, tick_s: float) -> LimitRules:
    """Return the rules for kernels; durations are in ticks of `tick_s`."""
    return LimitRules(
        decide=round(config.decide_s / tick_s),
        most_change=config.most_change,
        num_choices=len(config.speeds_mps),
        dt=tick_s,
        weights=np.array(config.weight_of_each),
    )


def _lanes_by_edge(network: RoadNetwork) -> dict[str, list[int]]:
    found: dict[str, list[int]] = {}
    for row, edge in enumerate(network.lanes["edge"].tolist()):
        found.setdefault(network.edge_ids[edge], []).append(row)
    return found


def _lanes(
    rows: Mapping[str, list[int]], key: str, name: str, named: Mapping[str, tuple[str, ...]]
) -> list[int]:
    for edge in named[name]:
        if edge not in rows:
            raise ConfigError(
                f"limits.{key}.{name}: no edge {edge!r} on the map; it has "
                f"{', '.join(edge for edge in list(rows)[:8] if not edge.startswith(':'))}"
            )
    return [row for edge in named[name] for row in rows[edge]]
