"""The arrays of a demand file: elements of the file, and orders drawn from the elements.

Units: m, s, m/s. Times of elements are whole milliseconds as in SUMO, so that a flow's vehicles
depart at exactly SUMO's times. Indices without a target are -1.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.records import record
from cavmarl.traffic.demand.element import Element

# Lanes: a LANE row (in an ORDER), SUMO's index on the edge (in an ELEMENT), or one of these codes.
LANE_FIRST = -1  # the lane nearest to the kerb that the class may use
LANE_RANDOM = -2
LANE_FREE = -3  # the lane with the fewest vehicles, among the lanes that the class may use
LANE_ALLOWED = -4  # treated like LANE_FREE
LANE_BEST = -5  # like LANE_FREE, among the lanes on which the route can be followed furthest
LANE_CURRENT = -6  # arrival: the present lane

POS_GIVEN = 0
POS_BASE = 1  # the rear bumper at the start of the lane (SUMO's default)
POS_RANDOM = 2  # a random place; departures draw it again in each tick until they can enter
POS_FREE = 3  # treated like POS_RANDOM
POS_RANDOM_FREE = 4  # treated like POS_RANDOM
POS_LAST = 5  # behind the last vehicle
POS_MAX = 6  # arrival: at the end of the lane
POS_CENTER = 7  # arrival: in the middle of the lane
# The end of the first stop if it is on the first edge, otherwise as POS_BASE. The resolver replaces
# this code by POS_GIVEN or POS_BASE.
POS_STOP = 8

SPEED_GIVEN = 0
SPEED_RANDOM = 1
SPEED_MAX = 2  # the highest safe speed
SPEED_DESIRED = 3  # limit times speed factor
SPEED_LIMIT = 4
SPEED_LAST = 5  # speed of the last vehicle on the lane
SPEED_AVERAGE = 6  # mean speed of the vehicles on the lane
SPEED_CURRENT = 7  # arrival: the present speed

_DEPART_POS = {
    "base": POS_BASE,
    "random": POS_RANDOM,
    "free": POS_FREE,
    "random_free": POS_RANDOM_FREE,
    "last": POS_LAST,
    "stop": POS_STOP,
    # SUMO, too, puts vehicles with these keywords at the start of the lane.
    "splitFront": POS_BASE,
    "random_location": POS_BASE,
}
_DEPART_SPEED = {
    "random": SPEED_RANDOM,
    "max": SPEED_MAX,
    "desired": SPEED_DESIRED,
    "speedLimit": SPEED_LIMIT,
    "last": SPEED_LAST,
    "avg": SPEED_AVERAGE,
}

# Keywords that may replace a number, by attribute.
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
    "arrivalPos": {"max": POS_MAX, "random": POS_RANDOM, "center": POS_CENTER},
    "departSpeed": _DEPART_SPEED,
    "arrivalSpeed": {"current": SPEED_CURRENT},
}

UNTIL_ABSOLUTE = 0  # time of the simulation
# Time of the simulation for a flow's first vehicle. For a later vehicle of the flow, the time is
# later by as much as the vehicle's departure.
UNTIL_FLOW = 1
UNTIL_DEPARTURE = 2  # time since the vehicle's departure (stops of standalone routes)

FLOW_REGULAR = 0  # also single vehicles, as flows of one
FLOW_EXPONENTIAL = 1  # gaps are exponentially distributed
FLOW_PROBABILITY = 2  # one vehicle in each second with this probability

MAX_NUMBER = 1 << 40  # number of vehicles of flows without a number: larger than every cap

_ENTRY_AND_EXIT = [
    ("depart_lane", np.int32),  # LANE_* or a lane, see above
    ("depart_pos_code", np.int8),  # POS_*
    ("depart_pos", np.float64),  # front bumper, m from the start of the edge
    ("depart_speed_code", np.int8),  # SPEED_*
    ("depart_speed", np.float64),  # m/s
    ("arrival_lane", np.int32),
    ("arrival_pos_code", np.int8),
    ("arrival_pos", np.float64),
    ("arrival_speed_code", np.int8),
    ("arrival_speed", np.float64),
    ("speed_factor", np.float64),  # speed factor of this vehicle; NaN: drawn by type
]

ELEMENT = record(
    ("file", np.int32),  # index in DemandReport.files
    ("line", np.int32),
    ("flow", np.bool_),  # whether the vehicles are called id.0, id.1, …
    ("pattern", np.int8),  # FLOW_*
    ("begin_ms", np.int64),  # departure of the first vehicle
    ("end_ms", np.int64),  # no vehicle departs at or after this time
    ("period_ms", np.int64),  # period of FLOW_REGULAR
    ("number", np.int64),  # maximum number of vehicles
    ("rate", np.float64),  # FLOW_EXPONENTIAL: 1/s; FLOW_PROBABILITY: probability per second
    ("types", np.int32),  # choice among VTYPE rows
    ("routes", np.int32),  # choice among ROUTE rows
    ("first_stop", np.int32),  # STOP rows [first_stop, first_stop + num_stops)
    ("num_stops", np.int32),
    ("reroute", np.float64),  # probability of a rerouting device; -1: as in the type
    ("reroute_period_ms", np.int64),  # period of searches; 0: one search, -1: as in the type
    *_ENTRY_AND_EXIT,
)

ORDER = record(
    ("depart", np.float64),  # s
    ("element", np.int32),  # ELEMENT row
    ("number", np.int32),  # number of the vehicle in its flow, from 0
    ("vtype", np.int32),  # VTYPE row
    ("route", np.int32),  # ROUTE row
    ("first_stop", np.int32),  # STOP rows, in the order of the route
    ("num_stops", np.int32),
    ("reroute", np.bool_),  # whether the vehicle searches for a route after entering …
    ("reroute_period_ms", np.int64),  # … and the period of further searches; 0: none
    *_ENTRY_AND_EXIT,
)

ROUTE = record(
    ("first_edge", np.int32),  # route_edges[first_edge : first_edge + num_edges]
    ("num_edges", np.int32),
    ("exact", np.bool_),  # False: the edges are waypoints of a route still to be searched
    ("first_stop", np.int32),  # STOP rows of all vehicles on the route
    ("num_stops", np.int32),
)

STOP = record(
    ("lane", np.int32),  # LANE row
    ("at_edge", np.int32),  # index of the stop's edge in the route; -1 if not `exact`
    ("start", np.float64),  # m on the lane (LANE["length_m"]) at which the stop begins
    ("end", np.float64),  # m on the lane at which the front bumper stops
    ("duration", np.float64),  # minimum duration, s
    ("until", np.float64),  # earliest end, s; -1: none
    ("until_from", np.int8),  # UNTIL_*: reference of `until`
    ("parking", np.bool_),  # whether the vehicle stops beside the road, so that others can pass
)


class Options(NamedTuple):
    """The options of a choice: rows and their weights, in the order of the file."""

    rows: tuple[int, ...]
    weights: tuple[float, ...]


class Choices:
    """Many choices with probabilities, for drawing whole arrays.

    Attributes:
        start: (C + 1,) options of choice c are [start[c], start[c + 1]).
        rows: (num_options,) the rows to choose from.
        upper: (num_options,) choice + cumulative probability, ascending over all choices.
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
        """Return the rows (n,) that random numbers (n,) in [0, 1) select from choices (n,)."""
        place = np.searchsorted(self.upper, choices + chances, side="right")
        # Rounding can move a sum into the range of the next choice.
        return self.rows[np.clip(place, self.start[choices], self.start[choices + 1] - 1)]


MAX_WEIGHT = 1e9


def listed(source: Element, key: str) -> list[tuple[str, float | None]]:
    """Return pairs of name and weight from the attributes of names and of probabilities.

    `key`: "vTypes" or "routes".

    The weight is None if there is no attribute `probabilities`.
    """
    names = source.attrs.get(key, "").split()
    texts = source.attrs.get("probabilities", "").split()
    if texts and len(texts) != len(names):
        raise source.error(
            f"has {len(texts)} probabilities for {len(names)} {key}", "give one for each"
        )
    weights: list[float | None] = [
        part.number("probabilities", 1.0, least=0.0, most=MAX_WEIGHT)
        for part in (source.with_attrs(probabilities=text) for text in texts)
    ]
    return list(zip(names, weights or [None] * len(names), strict=True))


def weighted(source: Element, found: Sequence[tuple[int, float]]) -> Options:
    """Return a choice of the members with a positive weight.

    Raises DemandError: no member has a positive weight.
    """
    kept = [(row, weight) for row, weight in found if weight > 0.0]
    if not kept:
        raise source.error("has nothing to choose from", "give it members with a probability")
    return Options(tuple(row for row, _ in kept), tuple(weight for _, weight in kept))
