"""The arrays of a demand file: elements as they stand in the file, and the orders drawn from them.

Units: metres, seconds, metres a second; times of elements are whole milliseconds as in SUMO, so
that a flow's vehicles depart at exactly SUMO's times. Indices that point at nothing are -1.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.records import record
from cavmarl.traffic.demand.element import Element

# Lanes: a LANE row (in an ORDER) or SUMO's index on the edge (in an ELEMENT), or one of these.
LANE_FIRST = -1  # the one nearest to the kerb that the class may use
LANE_RANDOM = -2
LANE_FREE = -3  # the least occupied one
LANE_ALLOWED = -4  # the least occupied one of those the class may use
LANE_BEST = -5  # the one on which the route can be followed furthest
LANE_CURRENT = -6  # arrival: whichever it drives on

POS_GIVEN = 0
POS_BASE = 1  # the rear bumper at the start of the lane (SUMO's default)
POS_RANDOM = 2
POS_FREE = 3  # the first gap
POS_RANDOM_FREE = 4  # random, and where that is taken the first gap
POS_LAST = 5  # behind the last vehicle
POS_MAX = 6  # arrival: at the end of the lane

SPEED_GIVEN = 0
SPEED_RANDOM = 1
SPEED_MAX = 2  # the most that is safe there
SPEED_DESIRED = 3  # limit times speed factor
SPEED_LIMIT = 4
SPEED_LAST = 5  # of the last vehicle on the lane
SPEED_AVERAGE = 6  # of the vehicles on the lane
SPEED_CURRENT = 7  # arrival: whichever it has

_DEPART_POS = {
    "base": POS_BASE,
    "random": POS_RANDOM,
    "free": POS_FREE,
    "random_free": POS_RANDOM_FREE,
    "last": POS_LAST,
}
_DEPART_SPEED = {
    "random": SPEED_RANDOM,
    "max": SPEED_MAX,
    "desired": SPEED_DESIRED,
    "speedLimit": SPEED_LIMIT,
    "last": SPEED_LAST,
    "avg": SPEED_AVERAGE,
}

# The words that may stand for a number, by attribute.
CODES = {
    "departLane": {
        "first": LANE_FIRST,
        "random": LANE_RANDOM,
        "free": LANE_FREE,
        "allowed": LANE_ALLOWED,
        "best": LANE_BEST,
        "best_prob": LANE_BEST,
    },
    "arrivalLane": {"current": LANE_CURRENT, "first": LANE_FIRST, "random": LANE_RANDOM},
    "departPos": _DEPART_POS,
    "arrivalPos": {"max": POS_MAX, "random": POS_RANDOM},
    "departSpeed": _DEPART_SPEED,
    "arrivalSpeed": {"current": SPEED_CURRENT},
}

UNTIL_ABSOLUTE = 0  # the clock
UNTIL_FLOW = 1  # the clock of the flow's first vehicle: later ones are as late as they depart
UNTIL_DEPARTURE = 2  # the vehicle's departure (stops of routes that stand alone)

FLOW_REGULAR = 0  # also single vehicles: flows of one
FLOW_EXPONENTIAL = 1  # gaps are exponentially distributed
FLOW_PROBABILITY = 2  # each second one with this chance

_HOW = [
    ("depart_lane", np.int32),  # LANE_* or a lane, see above
    ("depart_pos_code", np.int8),  # POS_*
    ("depart_pos", np.float64),  # m from the start of the edge, of the front bumper
    ("depart_speed_code", np.int8),  # SPEED_*
    ("depart_speed", np.float64),  # m/s
    ("arrival_lane", np.int32),
    ("arrival_pos_code", np.int8),
    ("arrival_pos", np.float64),
    ("arrival_speed_code", np.int8),
    ("arrival_speed", np.float64),
    ("speed_factor", np.float64),  # of this vehicle; NaN: drawn from its type
]

ELEMENT = record(
    ("file", np.int32),  # index in DemandReport.files
    ("line", np.int32),
    ("flow", np.bool_),  # its vehicles are called id.0, id.1, …
    ("pattern", np.int8),  # FLOW_*
    ("begin_ms", np.int64),  # departure of the first vehicle
    ("end_ms", np.int64),  # no vehicle departs at or after it
    ("period_ms", np.int64),  # of FLOW_REGULAR
    ("number", np.int64),  # at most so many vehicles
    ("rate", np.float64),  # 1/s of FLOW_EXPONENTIAL, chance a second of FLOW_PROBABILITY
    ("types", np.int32),  # choice among VTYPE rows
    ("routes", np.int32),  # choice among ROUTE rows
    ("first_stop", np.int32),  # STOP rows [first_stop, first_stop + num_stops)
    ("num_stops", np.int32),
    ("reroute", np.float64),  # chance that the vehicle looks for its way itself; -1: its type's
    ("reroute_period_ms", np.int64),  # how often; 0: once, -1: as its type
    *_HOW,
)

ORDER = record(
    ("depart", np.float64),  # s
    ("element", np.int32),  # ELEMENT row
    ("number", np.int32),  # of the vehicle in its flow, from 0
    ("vtype", np.int32),  # VTYPE row
    ("route", np.int32),  # ROUTE row
    ("first_stop", np.int32),  # STOP rows, in the order in which they are reached
    ("num_stops", np.int32),
    ("reroute", np.bool_),  # looks for its way itself when it has entered, …
    ("reroute_period_ms", np.int64),  # … and then so often; 0: not again
    *_HOW,
)

ROUTE = record(
    ("first_edge", np.int32),  # route_edges[first_edge : first_edge + num_edges]
    ("num_edges", np.int32),
    ("exact", np.bool_),  # False: edges to pass through, the way between them is to be found
    ("first_stop", np.int32),  # STOP rows that all its vehicles make
    ("num_stops", np.int32),
)

STOP = record(
    ("lane", np.int32),  # LANE row
    ("at_edge", np.int32),  # position of its edge in the route; -1 on routes to be found
    ("start", np.float64),  # m on the lane (LANE["length_m"]), where the stop begins
    ("end", np.float64),  # m on the lane, where the front bumper comes to rest
    ("duration", np.float64),  # s at least
    ("until", np.float64),  # s, not before; -1: none
    ("until_from", np.int8),  # UNTIL_*: what `until` is counted from
    ("parking", np.bool_),  # beside the road: others pass
)


class Options(NamedTuple):
    """One list to choose from: rows and their weights, in the order of the file."""

    rows: tuple[int, ...]
    weights: tuple[float, ...]


class Choices:
    """Many lists to choose from, each with probabilities, drawn from by arrays.

    Attributes:
        start: (C + 1,) options of choice c are [start[c], start[c + 1]).
        rows: (num_options,) what is chosen.
        upper: (num_options,) choice + cumulative probability: one ascending array for all.
    """

    def __init__(self, lists: Sequence[Options]) -> None:
        self.start = np.zeros(len(lists) + 1, dtype=np.int64)
        self.start[1:] = np.cumsum([len(options.rows) for options in lists])
        self.rows = np.array([row for options in lists for row in options.rows], dtype=np.int32)
        self.upper = np.zeros(len(self.rows))
        for choice, options in enumerate(lists):
            parts = np.cumsum(options.weights)
            part = slice(self.start[choice], self.start[choice + 1])
            self.upper[part] = choice + parts / parts[-1:]
        for array in (self.start, self.rows, self.upper):
            array.setflags(write=False)

    def __len__(self) -> int:
        return len(self.start) - 1

    def options(self, choice: int) -> NDArray[np.int32]:
        return self.rows[self.start[choice] : self.start[choice + 1]]

    def pick(self, choices: NDArray[np.int32], chances: NDArray[np.float64]) -> NDArray[np.int32]:
        """The rows (n,) that numbers (n,) in [0, 1) choose from lists (n,)."""
        place = np.searchsorted(self.upper, choices + chances, side="right")
        # A sum can round up to the next list's range.
        return self.rows[np.clip(place, self.start[choices], self.start[choices + 1] - 1)]


MAX_WEIGHT = 1e9


def listed(source: Element, key: str) -> list[tuple[str, float | None]]:
    """Names in one attribute, their weights in another.

    `key`: "vTypes" or "routes".

    Returns pairs of name and weight; None where `probabilities` says nothing.
    """
    names = source.attrs.get(key, "").split()
    texts = source.attrs.get("probabilities", "").split()
    if texts and len(texts) != len(names):
        raise source.error(
            f"has {len(texts)} probabilities for {len(names)} {key}", "give one for each"
        )
    weights: list[float | None] = [
        source.saying(probabilities=text).number("probabilities", 1.0, least=0.0, most=MAX_WEIGHT)
        for text in texts
    ]
    return list(zip(names, weights or [None] * len(names), strict=True))


def weighted(source: Element, found: Sequence[tuple[int, float]]) -> Options:
    """What is found to choose from, without what is never chosen.

    Raises DemandError: nothing is left.
    """
    kept = [(row, weight) for row, weight in found if weight > 0.0]
    if not kept:
        raise source.error("has nothing to choose from", "give it members with a probability")
    return Options(tuple(row for row, _ in kept), tuple(weight for _, weight in kept))
