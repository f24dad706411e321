"""Checks of a road network from an untrusted source, before its tables are used as indices.

The reader of map files makes tables with valid indices. A packed network in a recording may have
been written by anybody.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from cavmarl.core.records.codes import SIGNAL_YELLOW_MAJOR
from cavmarl.roads.network import RoadNetwork

FARTHEST_M = 1e9  # limit of coordinates
LONGEST_LANE_M = 1e6
WIDEST_LANE_M = 1000.0
ROUNDING = 1e-6  # largest difference between the length of a direction vector and 1
LENGTH_OF_SMALL_MAPS_M = 1e7  # total length of lanes above which `MOST_M_PER_POINT` applies
MOST_M_PER_POINT = 1000.0

# Index columns: table, column, and the table of the rows; columns in `_OPTIONAL` may be -1.
_INDICES = (
    ("lanes", "left", "lanes"),
    ("lanes", "right", "lanes"),
    ("lanes", "successor", "lanes"),
    ("lanes", "link", "links"),
    ("lanes", "edge", "edges"),
    ("edges", "from_junction", "junctions"),
    ("edges", "to_junction", "junctions"),
    ("links", "from_lane", "lanes"),
    ("links", "to_lane", "lanes"),
    ("links", "first_internal", "lanes"),
    ("links", "next_lane", "lanes"),
    ("links", "junction", "junctions"),
    ("links", "signal", "signals"),
    ("conflicts", "foe", "links"),
    ("sweeps", "foe", "links"),
    ("junctions", "kind", "junction_kinds"),
    ("junctions", "signal", "signals"),
    ("signals", "program", "programs"),
    ("programs", "signal", "signals"),
    ("phases", "following", "phases"),
    ("switches", "signal", "signals"),
    ("switches", "program", "programs"),
    ("detectors", "lane", "lanes"),
)
_OPTIONAL = frozenset(
    {
        ("lanes", "left"), ("lanes", "right"), ("lanes", "successor"), ("lanes", "link"),
        ("edges", "from_junction"), ("edges", "to_junction"), ("links", "first_internal"),
        ("links", "signal"), ("junctions", "signal"), ("phases", "following"),
    }
)  # fmt: skip
# Ranges of rows: table, first row, number of rows, table of the rows, and the smallest number.
_RANGES = (
    ("lanes", "first_link", "num_links", "links", 0),
    ("lanes", "first_point", "num_points", "points", 2),
    ("lanes", "first_into", "num_into", "into", 0),
    ("edges", "first_lane", "num_lanes", "lanes", 1),
    ("links", "first_conflict", "num_conflicts", "conflicts", 0),
    ("links", "first_sweep", "num_sweeps", "sweeps", 0),
    ("signals", "first_switch", "num_switches", "switches", 0),
    ("programs", "first_phase", "num_phases", "phases", 1),
    ("phases", "first_detector", "num_detectors", "phase_detectors", 0),
)
_IDS = ("lane", "edge", "junction", "signal", "program")
_PLACES = (("points", "xyzs"), ("junctions", "xyz"))


def wrong_network(network: RoadNetwork) -> str:
    """Return a description of the first error of a network; empty if there is no error."""
    return next(filter(None, _faults(network)), "")


def _faults(network: RoadNetwork) -> Iterator[str]:
    if not len(network.lanes):
        yield "the map has no lanes"
        return
    for name in _IDS:
        ids, rows = getattr(network, f"{name}_ids"), getattr(network, f"{name}s")
        if len(ids) != len(rows):
            yield f"the map has {len(ids)} ids of {len(rows)} {name}s"
    texts = (*network.lane_ids, *network.edge_ids, *network.junction_kinds, *network.signal_ids)
    if not all(isinstance(text, str) for text in texts):
        yield "an id is not a text"
        return
    for table, column, target in _INDICES:
        rows, end = getattr(network, table)[column], len(getattr(network, target))
        least = -1 if (table, column) in _OPTIONAL else 0
        if ((rows < least) | (rows >= end)).any():
            yield f"{column} of {table} leads to no row of {target}"
    if ((network.into < 0) | (network.into >= len(network.lanes))).any():
        yield "into leads to no lane"
    detectors = network.phase_detectors
    if ((detectors < 0) | (detectors >= len(network.detectors))).any():
        yield "phase_detectors leads to no detector"
    for table, first_name, count_name, target, least in _RANGES:
        first, count = (
            getattr(network, table)[name].astype(np.int64) for name in (first_name, count_name)
        )
        end = len(getattr(network, target))
        wrong = (count < least) | ((first < 0) | (first + count > end)) & (count > 0)
        if wrong.any() or count.sum() > end:
            yield f"{first_name} and {count_name} of {table} lead to no rows of {target}"
    yield from _wrong_signals(network)
    yield from _wrong_shapes(network)


def _wrong_signals(network: RoadNetwork) -> Iterator[str]:
    links, signals = network.links, network.signals
    if (network.phase_states > SIGNAL_YELLOW_MAJOR).any():
        yield "a signal shows an unknown letter"
    signalled = links[links["signal"] >= 0]
    if not len(signals):
        return
    index = signalled["signal_index"]
    if ((index < 0) | (index >= signals["num_links"][signalled["signal"]])).any():
        yield "signal_index of links leads to no letter"
    if (signals["num_links"] < 0).any():
        yield "a signal has no number of letters"
    programs = network.programs
    last = programs["first_phase"].astype(np.int64) + programs["num_phases"] - 1
    for rows in (programs["first_phase"], np.minimum(last, len(network.phases) - 1)):
        first = network.phases["first_state"][rows].astype(np.int64)
        letters = signals["num_links"][programs["signal"]]
        if ((first < 0) | (first + letters > len(network.phase_states))).any():
            yield "first_state of phases leads to no letters"


def _wrong_shapes(network: RoadNetwork) -> Iterator[str]:
    for table, columns in _PLACES:
        rows = getattr(network, table)
        for column in columns:
            if not (np.abs(rows[column]) <= FARTHEST_M).all():
                yield f"{column} of {table} is not a number up to ±{FARTHEST_M:g} m"
    for column in ("cos", "sin"):
        if not (np.abs(network.points[column]) <= 1.0 + ROUNDING).all():
            yield f"{column} of points is not a number from -1 to 1"
    lanes = network.lanes
    for column in ("min_x", "min_y", "max_x", "max_y"):
        if not (np.abs(lanes[column]) <= FARTHEST_M).all():
            yield f"{column} of lanes is not a number up to ±{FARTHEST_M:g} m"
    for column, most in (("length_m", LONGEST_LANE_M), ("width_m", WIDEST_LANE_M)):
        if not ((lanes[column] >= 0.0) & (lanes[column] <= most)).all():
            yield f"{column} of lanes is not from 0 to {most:g} m"
    if lanes["length_m"].sum() > max(
        LENGTH_OF_SMALL_MAPS_M, MOST_M_PER_POINT * len(network.points)
    ):
        yield "the lanes are too long for their number of points"
    if not (np.abs(network.roofs) <= FARTHEST_M).all():
        yield f"a building is not within ±{FARTHEST_M:g} m"
