"""Positions of the detectors of actuated signals, and the phases that they prolong.

SUMO puts one induction loop on every lane with a green in an actuated phase. The loop prolongs a
phase only if all movements from its lane have green (SUMO's documentation, Simulation/Traffic
Lights, "actuated").
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.errors import MapError
from cavmarl.roads.network import DETECTOR, VEHICLE_CLASSES
from cavmarl.roads.sumo_net.programs import SignalProgram
from cavmarl.roads.sumo_net.signal_rows import DETECTOR_GAP_S, SignalRows, parameter

# SUMO's defaults for actuated programs, s.
MAX_GAP_S = 3.0
PASSING_TIME_S = 1.9
# Length that a stopped vehicle occupies in a queue, m.
QUEUE_SPACING_M = 7.5

NO_DETECTOR = "NO_DETECTOR"

_MOTORIZED = ~np.uint32(1 << VEHICLE_CLASSES.index("bicycle"))
_TURNAROUND = (ord("t"), ord("T"))


class DetectorRoads(NamedTuple):
    """The parts of a network that detectors depend on."""

    lanes: NDArray[np.void]
    edges: NDArray[np.void]
    links: NDArray[np.void]
    conflicts: NDArray[np.void]
    into: NDArray[np.int32]
    lane_ids: tuple[str, ...]


def place_detectors(
    rows: SignalRows, roads: DetectorRoads, first_row: int = 0
) -> tuple[NDArray[np.void], NDArray[np.int32]]:
    """Return the detectors of the actuated programs in `rows.specs`, and add them to their phases.

    `rows`: updated with the detectors of each phase. `first_row`: row of the first detector.

    Returns DETECTOR (D,), and phase_detectors including the entries of `rows`.
    Raises MapError: a parameter is not a number, or names a custom detector.
    """
    detectors: list[tuple[int, float, float]] = []
    for row, program in rows.specs.items():
        own = _Approaches(program, roads, int(rows.programs[row][0]))
        number = {}
        for lane in own.lanes:
            if (shortest := own.shortest_green_s(lane)) is not None:
                number[lane] = first_row + len(detectors)
                detectors.append((*own.place(lane, shortest), own.max_gap_s(lane)))
        for phase in range(len(program.phases)):
            usable = [number[lane] for lane in own.usable(phase, number)]
            rows.set_detectors(row, phase, usable)
    found = np.zeros(len(detectors), DETECTOR)
    found[:] = detectors
    return found, np.array(rows.phase_detectors, dtype=np.int32)


class _Approaches:
    """The lanes before one signal, as needed by one actuated program."""

    def __init__(self, program: SignalProgram, roads: DetectorRoads, signal: int) -> None:
        self.program = program
        self.roads = roads
        links = roads.links[roads.links["signal"] == signal]
        self.links = links
        self.lanes: list[int] = [
            int(lane)
            for lane in dict.fromkeys(
                links["from_lane"][np.argsort(links["signal_index"], kind="stable")].tolist()
            )
            if program.params.get(roads.lane_ids[lane]) != NO_DETECTOR
        ]
        self.indices = {
            lane: sorted(set(links["signal_index"][links["from_lane"] == lane].tolist()))
            for lane in self.lanes
        }
        numbers = range(len(program.phases[0].state))
        self.never_major = {
            index for index in numbers if all(p.state[index] != "G" for p in program.phases)
        }
        at = {index: links[links["signal_index"] == index] for index in numbers}
        self.lanes_at = {index: set(at[index]["from_lane"].tolist()) for index in numbers}
        self.turnaround = {
            index for index in numbers if np.isin(at[index]["direction"], _TURNAROUND).all()
        }
        self.one_lane = {
            index for index in numbers if any(self._alone(lane) for lane in self.lanes_at[index])
        }

    def _alone(self, lane: int) -> bool:
        """Return whether the lane's edge has only one lane for motor vehicles."""
        edge = self.roads.edges[self.roads.lanes["edge"][lane]]
        first = edge["first_lane"]
        beside = self.roads.lanes["permissions"][first : first + edge["num_lanes"]]
        return int((beside & _MOTORIZED != 0).sum()) == 1

    def shortest_green_s(self, lane: int) -> float | None:
        """Return the shortest minimum duration of the actuated phases with green for the lane."""
        shortest = [
            phase.min_s
            for phase in self.program.phases
            if phase.min_s != phase.max_s
            and any(phase.state[index] in "gG" for index in self.indices[lane])
        ]
        return min(shortest, default=None)

    def place(self, lane: int, shortest_s: float) -> tuple[int, float]:
        """Return the position of a lane's detector: (LANE, s in m).

        The detector is `detector-gap` seconds before the stop line, but no farther than the queue
        that the shortest green clears. If the lane is too short, the detector is on the previous
        lane, provided that there is only one.
        """
        custom = self.program.params.get(self.roads.lane_ids[lane])
        if custom is not None:
            raise MapError(
                f"{self.program.place}: lane '{self.roads.lane_ids[lane]}' has the custom detector "
                f"'{custom}', which is not supported: remove this <param>"
            )
        passing = parameter(self.program, "passing-time", PASSING_TIME_S)
        if passing <= 0.0:
            raise MapError(f"{self.program.place} has passing-time='0': set a positive number")
        gap = parameter(self.program, "detector-gap", DETECTOR_GAP_S)
        lanes = self.roads.lanes
        distance = min(
            gap * float(lanes["speed_mps"][lane]), (shortest_s / passing + 0.5) * QUEUE_SPACING_M
        )
        s = float(lanes["length_m"][lane]) - distance
        while s < 0.0 and lanes["num_into"][lane] == 1:
            before = int(self.roads.into[lanes["first_into"][lane]])
            link = lanes["link"][before]
            if link >= 0 and self.roads.links["signal"][link] >= 0:
                break
            lane = before
            s += float(lanes["length_m"][lane])
        return lane, max(s, 0.0)

    def max_gap_s(self, lane: int) -> float:
        default = parameter(self.program, "max-gap", MAX_GAP_S)
        return parameter(self.program, f"max-gap:{self.roads.lane_ids[lane]}", default)

    def usable(self, phase: int, detected: dict[int, int]) -> list[int]:
        """Return the lanes of `detected` whose detectors prolong a phase."""
        stated = self.program.phases[phase]
        if stated.min_s == stated.max_s:
            return []
        state = stated.state
        major = {
            lane for i, letter in enumerate(state) if letter == "G" for lane in self.lanes_at[i]
        }
        open_links = {
            index
            for index, letter in enumerate(state)
            if letter == "G" or (letter == "g" and self._counts(index, state, major))
        }
        shut = {lane for lane in detected if not open_links.issuperset(self.indices[lane])}
        return [
            lane
            for lane in detected
            if lane not in shut and not shut.intersection(self._next_lanes(lane))
        ]

    def _counts(self, index: int, state: str, major: set[int]) -> bool:
        """Return whether a green with a duty to yield (`g`) counts as a green without it (`G`)."""
        unimportant = index in self.never_major or index in self.turnaround
        if index in self.one_lane or (unimportant and major & self.lanes_at[index]):
            return True
        return not any(
            self._gives_way(link, state) for link in self.links[self.links["signal_index"] == index]
        )

    def _gives_way(self, link: np.void, state: str) -> bool:
        """Return whether motor vehicles from another road may cross a link in this state."""
        first = link["first_conflict"]
        foes = self.roads.conflicts["foe"][first : first + link["num_conflicts"]]
        for foe in self.roads.links[foes]:
            if foe["signal"] == link["signal"] and state[foe["signal_index"]] in "gG":
                source, target, own = self.roads.lanes[
                    [foe["from_lane"], foe["to_lane"], link["from_lane"]]
                ]
                open_to = source["permissions"] & target["permissions"] & _MOTORIZED
                if open_to and source["edge"] != own["edge"]:
                    return True
        return False

    def _next_lanes(self, lane: int) -> list[int]:
        """Return the lanes after the junction; they may end at another line of the same signal."""
        ahead = self.links[self.links["from_lane"] == lane]
        on = ahead[~np.isin(ahead["direction"], _TURNAROUND)]
        return [int(row) for row in on["to_lane"]]
