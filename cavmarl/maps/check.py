"""Checks whether vehicles can drive on a map: statistics, and places that look wrong.

Lengths are taken from the map (SUMO's `length`), so sums are equal to sumolib's. Unless the name
says otherwise, edges and lanes are the edges and lanes open to passenger cars.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cavmarl.maps.components import strong_components
from cavmarl.roads.cache import load_network
from cavmarl.roads.default_horizon import horizon_of
from cavmarl.roads.held_signals import held_signals, held_signals_note
from cavmarl.roads.network import CARS, SIGNAL_STATES, RoadNetwork

# A limit below walking speed or above the speed of any car probably has a wrong unit.
_SPEED_RANGE_MPS = (1.0, 70.0)
_STEEP = 0.15
_ROUNDING = 0.005  # tolerance of grades, because positions are rounded to the centimetre
_STUB_M = 1.0  # shorter lanes do not allow an estimate of the grade
_WELL_CONNECTED = 0.9
_GREEN = [SIGNAL_STATES.index(letter) for letter in "gGosOY"]


@dataclass(frozen=True)
class MapReport:
    """The result of `check_map`."""

    name: str  # name of the network
    source_hash: str
    road_km: float  # total length of all edges; `lane_km`: of all lanes
    lane_km: float
    edges: int
    lanes: int
    junctions: int  # number of places where more than two edges meet
    junctions_by_type: dict[str, int]  # number of nodes of the map by SUMO's type
    signals: int  # traffic lights
    programs: int  # programs of all traffic lights
    actuated_signals: int  # traffic lights with an actuated program
    extent_m: tuple[float, float, float, float]  # min x, min y, max x, max y of the lanes
    elevation_m: tuple[float, float]  # lowest and highest point of the lanes
    max_grade: float  # steepest slope of a lane, as a ratio
    connected_edges: int  # edges in the largest strongly connected part
    connected_share: float  # `connected_edges` as a share of all edges
    horizon_s: float  # default duration of an episode, if only the map is given
    dead_ends: tuple[str, ...]  # edges that lead nowhere
    lanes_without_successor: tuple[str, ...]  # lanes that lead nowhere, except on dead ends
    junctions_without_right_of_way: tuple[str, ...]  # junctions where lanes meet without a rule
    signals_without_lanes: tuple[str, ...]  # traffic lights that control no lane
    lanes_never_green: tuple[str, ...]  # lanes whose signal never opens any movement
    # signal programs (signal/program) that are simplified: delay-based programs, NEMA programs and
    # programs with several possible next phases run with their stated durations; parameters such as
    # `linkMaxDur` and `coordinated` are ignored
    programs_simplified: tuple[str, ...]
    signals_held: tuple[str, ...]  # signals that show red for 1,000 s or more in one phase
    self_loops: tuple[str, ...]  # edges that end where they begin
    steep_lanes: tuple[str, ...]  # lanes that climb more than 15 %, the steepest first
    speed_outliers: tuple[str, ...]  # lanes with a speed limit below 1 or above 70 m/s
    problems: tuple[str, ...]  # reasons why cars cannot drive on the map; empty if they can
    notes: tuple[str, ...]  # other remarks

    @property
    def drivable(self) -> bool:
        return not self.problems

    def to_dict(self) -> dict[str, Any]:
        return asdict(self) | {"drivable": self.drivable}


def check_map(source: str | Path | RoadNetwork) -> MapReport:
    """Collect statistics of a SUMO network, and find problems for driving.

    Raises MapError: the network cannot be read; see `read_network`.
    """
    network = source if isinstance(source, RoadNetwork) else load_network(source)
    cars = _Cars(network)
    grades = _grades(network)
    findings = {
        "dead_ends": cars.dead_ends(),
        "lanes_without_successor": cars.lanes_without_successor(),
        "junctions_without_right_of_way": tuple(
            network.junction_ids[row] for row in np.flatnonzero(network.junctions["unruled"])
        ),
        "signals_without_lanes": _idle_signals(network),
        "lanes_never_green": _lanes_never_green(network),
        "programs_simplified": _simplified_programs(network),
        "self_loops": cars.self_loops(),
        "steep_lanes": _steep_lanes(network, grades),
        "speed_outliers": cars.speed_outliers(),
    }
    connected = cars.largest_component()
    share = connected / len(cars.edges) if len(cars.edges) else 0.0
    heights = (float(network.points["z"].min()), float(network.points["z"].max()))
    grade = float(grades.max(initial=0.0))
    return MapReport(
        name=network.name,
        source_hash=network.source_hash,
        road_km=float(network.edges["length_m"][cars.edges].sum()) / 1e3,
        lane_km=float(network.edges["length_m"][cars.edge_of_lane].sum()) / 1e3,
        edges=len(cars.edges),
        lanes=len(cars.lanes),
        junctions=_crossroads(network),
        junctions_by_type=_junctions_by_type(network),
        signals=len(network.signals),
        programs=len(network.programs),
        actuated_signals=int(
            (network.programs["controller"][network.signals["program"]] >= 0).sum()
        ),
        extent_m=network.extent_m,
        elevation_m=heights,
        max_grade=grade,
        connected_edges=connected,
        connected_share=share,
        horizon_s=horizon_of(network),
        **findings,
        signals_held=held_signals(network),
        problems=tuple(cars.problems()),
        notes=tuple(_notes(network, findings, share, grade)),
    )


class _Cars:
    """The part of a network that passenger cars may use."""

    def __init__(self, network: RoadNetwork) -> None:
        self.network = network
        allowed = network.lanes["permissions"] & CARS != 0
        self.lanes = np.flatnonzero(allowed & ~network.lanes["internal"])
        self.edge_of_lane = network.lanes["edge"][self.lanes]
        self.edges = np.unique(self.edge_of_lane)
        links = network.links
        passable = (
            allowed[links["from_lane"]] & allowed[links["to_lane"]] & allowed[links["next_lane"]]
        )
        self.links = links[passable]

    def largest_component(self) -> int:
        if not len(self.edges):
            return 0
        of_lane = self.network.lanes["edge"]
        arcs = np.stack([of_lane[self.links["from_lane"]], of_lane[self.links["to_lane"]]], axis=1)
        component = strong_components(len(self.network.edges), arcs)[self.edges]
        return int(np.bincount(component).max())

    def dead_ends(self) -> tuple[str, ...]:
        leads_on = self.network.lanes["edge"][self.links["from_lane"]]
        return self._edge_ids(np.setdiff1d(self.edges, leads_on))

    def lanes_without_successor(self) -> tuple[str, ...]:
        leads_on = np.unique(self.network.lanes["edge"][self.links["from_lane"]])
        closed = np.setdiff1d(self.lanes, self.links["from_lane"])
        closed = closed[np.isin(self.network.lanes["edge"][closed], leads_on)]
        return self._lane_ids(closed)

    def self_loops(self) -> tuple[str, ...]:
        edges = self.network.edges[self.edges]
        return self._edge_ids(self.edges[edges["from_junction"] == edges["to_junction"]])

    def speed_outliers(self) -> tuple[str, ...]:
        low, high = _SPEED_RANGE_MPS
        speed = self.network.lanes["speed_mps"][self.lanes]
        return self._lane_ids(self.lanes[(speed < low) | (speed > high)])

    def problems(self) -> list[str]:
        if not len(self.edges):
            return [
                "no edge is open to passenger cars: check permissions (netconvert's "
                "--keep-edges.by-vclass)"
            ]
        if not len(self.links) and len(self.edges) > 1:
            return ["no edge leads to another edge: the map has no connections: build it again"]
        return []

    def _edge_ids(self, rows: NDArray[np.int64]) -> tuple[str, ...]:
        return tuple(self.network.edge_ids[row] for row in rows)

    def _lane_ids(self, rows: NDArray[np.int64]) -> tuple[str, ...]:
        return tuple(self.network.lane_ids[row] for row in rows)


def _crossroads(network: RoadNetwork) -> int:
    normal = network.edges[~network.edges["internal"]]
    ends = np.concatenate([normal["from_junction"], normal["to_junction"]])
    return int((np.bincount(ends) > 2).sum())


def _junctions_by_type(network: RoadNetwork) -> dict[str, int]:
    counts = np.bincount(network.junctions["kind"], minlength=len(network.junction_kinds))
    return {kind: int(count) for kind, count in zip(network.junction_kinds, counts, strict=True)}


def _grades(network: RoadNetwork) -> NDArray[np.float64]:
    """Return the steepest slope of each lane, as a ratio."""
    slopes = np.abs(network.points["slope"])
    steepest = np.maximum.reduceat(slopes, network.lanes["first_point"])
    return np.where(network.lanes["length_m"] >= _STUB_M, steepest, 0.0)


def _steep_lanes(network: RoadNetwork, grades: NDArray[np.float64]) -> tuple[str, ...]:
    ranked = np.argsort(-grades, kind="stable")
    steep = ranked[grades[ranked] > _STEEP + _ROUNDING]
    return tuple(f"{network.lane_ids[row]} {grades[row]:.0%}" for row in steep)


def _idle_signals(network: RoadNetwork) -> tuple[str, ...]:
    rows = np.setdiff1d(np.arange(len(network.signals)), network.links["signal"])
    return tuple(network.signal_ids[row] for row in rows)


def _simplified_programs(network: RoadNetwork) -> tuple[str, ...]:
    return tuple(
        f"{network.signal_ids[network.programs['signal'][row]]}/{network.program_ids[row]}"
        for row in np.flatnonzero(network.programs["simplified"])
    )


def _lanes_never_green(network: RoadNetwork) -> tuple[str, ...]:
    shut: set[int] = set()
    for link in network.links[network.links["signal"] >= 0]:
        signal = network.signals[link["signal"]]
        program = network.programs[signal["program"]]
        first = program["first_phase"]
        phases = network.phases[first : first + program["num_phases"]]
        letters = network.phase_states[phases["first_state"] + link["signal_index"]]
        if not np.isin(letters, _GREEN).any():
            shut.add(int(link["from_lane"]))
    return tuple(network.lane_ids[row] for row in sorted(shut))


def _notes(
    network: RoadNetwork, findings: dict[str, tuple[str, ...]], share: float, grade: float
) -> list[str]:
    notes = [*network.notes, *filter(None, [held_signals_note(network)])]
    if share < _WELL_CONNECTED:
        notes.append(
            f"only {share:.0%} of the edges are in the largest connected part: trips from other "
            "edges may end at the map's border"
        )
    for name, ids in findings.items():
        if ids:
            shown = ", ".join(ids[:5]) + (", …" if len(ids) > 5 else "")
            notes.append(f"{len(ids)} {name.replace('_', ' ')}: {shown}")
    if grade > _STEEP + _ROUNDING:
        notes.append(f"the steepest lane climbs {grade:.0%}: check the heights")
    return notes
