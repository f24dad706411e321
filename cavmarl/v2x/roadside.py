"""Roadside units: where they stand, and the maps that they send."""

from __future__ import annotations

import difflib

import numpy as np
from numpy.typing import NDArray

from cavmarl.config.v2x import EVERY_SIGNAL, RoadsideConfig
from cavmarl.core.errors import ConfigError
from cavmarl.roads.network import RoadNetwork
from cavmarl.v2x.kernels.v2x_records import FIRST_ROADSIDE_ID, UNIT
from cavmarl.v2x.v2x_messages import MAP


def make_units(config: RoadsideConfig, network: RoadNetwork) -> NDArray[np.void]:
    """UNIT (n,): one at each signal that has one, in the middle of its stop lines.

    `config`: which signals.

    Raises ConfigError: no signal of that name.
    """
    known = network.signal_ids
    names = known if config.signals == (EVERY_SIGNAL,) else config.signals
    for name in names:
        if name not in known:
            close = difflib.get_close_matches(name, known, n=1)
            meant = f"did you mean '{close[0]}'? " if close else ""
            listed = ", ".join(known[:8]) + (", …" if len(known) > 8 else "")
            raise ConfigError(
                f"v2x.roadside.signals: no signal '{name}' on the map '{network.name}'; {meant}"
                f"There are: {listed or 'none'}"
            )
    units = np.zeros(len(names), UNIT)
    for unit, name in zip(units, names, strict=True):
        signal = known.index(name)
        ends = _stop_lines(network, signal)
        unit["signal"] = signal
        if len(ends):
            unit["x"], unit["y"], unit["z"] = (ends[axis].mean() for axis in ("x", "y", "z"))
    return units


def _links(network: RoadNetwork, signal: int) -> NDArray[np.intp]:
    return np.flatnonzero(network.links["signal"] == signal)


def _stop_lines(network: RoadNetwork, signal: int) -> NDArray[np.void]:
    """POINT of the end of the lane before each link of a signal."""
    lanes = network.lanes[network.links["from_lane"][_links(network, signal)]]
    ends: NDArray[np.void] = network.points[lanes["first_point"] + lanes["num_points"] - 1]
    return ends


def map_of(network: RoadNetwork, units: NDArray[np.void], unit: int) -> NDArray[np.void]:
    """MAP (n,): the approaches that a roadside unit's phases are about; they never change."""
    signal = int(units[unit]["signal"])
    rows = _links(network, signal)
    ends = _stop_lines(network, signal)
    found = np.zeros(len(rows), MAP)
    found["sender"] = FIRST_ROADSIDE_ID + unit
    found["signal"] = signal
    found["link"] = rows
    found["letter"] = network.links["signal_index"][rows]
    for name in ("x", "y", "heading"):
        found[name] = ends[name]
    found["speed_limit"] = network.lanes["speed_mps"][network.links["from_lane"][rows]]
    return found
