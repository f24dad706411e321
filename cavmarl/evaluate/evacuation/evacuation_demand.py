"""The vehicles of an evacuation: where each begins, when it departs, and its exit."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from xml.sax.saxutils import quoteattr

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.errors import ConfigError
from cavmarl.evaluate.evacuation.evacuation_plan import (
    SHORTEST_M,
    EvacuationPlan,
    edge_rows,
    roads_of,
)
from cavmarl.roads.kernels.plans import plan_goal
from cavmarl.roads.network import CARS, RoadNetwork
from cavmarl.roads.routing import PLAN
from cavmarl.traffic.kernels.way_requests import time_left

HEADWAY_S = 2.0  # time between two vehicles on a lane of an exit, to share vehicles among exits
END_M = 5.0  # least distance of a departure from both ends of its lane


@dataclass(frozen=True)
class Evacuees:
    """The vehicles of an evacuation in the order of their departures, n in all."""

    area: NDArray[np.int64]  # (n,) index of the area in the plan
    edge: NDArray[np.int64]  # (n,) EDGE row on which it begins
    exit: NDArray[np.int64]  # (n,) EDGE row of its exit
    depart_s: NDArray[np.float64]  # (n,)
    place_m: NDArray[np.float64]  # (n,) position of the departure on the lane
    notes: tuple[str, ...]  # what was left out, with counts

    def to_xml(self, plan: EvacuationPlan, network: RoadNetwork) -> str:
        """Return the vehicles as a demand file; the number of a trip is its id."""
        ids = network.edge_ids
        device = (
            '<param key="has.rerouting.device" value="true"/>'
            f'<param key="device.rerouting.period" value="{plan.reroute_s:g}"/>'
            if plan.reroute_s > 0.0
            else ""
        )
        lines = [
            "<routes>",
            f'<vType id="evacuee" vClass="passenger">{device}</vType>',
        ]
        rows = zip(self.edge.tolist(), self.exit.tolist(), self.depart_s, self.place_m, strict=True)
        for number, (edge, goal, depart_s, place_m) in enumerate(rows):
            lines.append(
                f'<trip id="{number}" type="evacuee" from={quoteattr(ids[edge])} '
                f'to={quoteattr(ids[goal])} depart="{depart_s:.2f}" departLane="best" '
                f'departPos="{place_m:.1f}" departSpeed="0"/>'
            )
        return "\n".join([*lines, "</routes>\n"])


def find_evacuees(
    plan: EvacuationPlan, exits: Sequence[str], network: RoadNetwork, seed: int
) -> Evacuees:
    """Return the vehicles of a plan.

    The vehicles of an area are spread evenly over the length of its lanes, and drawn in random
    order. Each vehicle takes the exit that it would pass earliest, on the assumption that each lane
    of an exit lets one vehicle pass every `HEADWAY_S`.

    Args:
        plan: the plan; roads in `contraflow` are closed.
        exits: ids of the exits.
        network: the map.
        seed: seed of the order of departures.

    Raises:
        ConfigError: an edge is unknown, an area has no vehicles, no road of an area has a way to an
            exit, or the events of the plan close the last way for good.
    """
    if not exits:
        raise ConfigError("exits: an evacuation needs a road over which vehicles leave; name one")
    goals = edge_rows(exits, "exits", network)
    reversed_roads = edge_rows(plan.contraflow, "contraflow", network)
    if blocked := np.intersect1d(goals, reversed_roads).tolist():
        raise ConfigError(
            f"exits: road {network.edge_ids[blocked[0]]!r} is reversed by contraflow; name another"
        )
    closed = np.isin(network.lanes["edge"], reversed_roads)
    times = _times_s(network, goals, closed)
    _refuse_closed_for_good(plan, network, goals, closed, times)
    notes: list[str] = []
    areas, edges, places = [], [], []
    for number, (name, area) in enumerate(plan.areas.items()):
        roads = roads_of(area, name, network)
        lanes = _origins(network, roads, closed)
        with_way = lanes[np.isfinite(times[:, lanes]).any(axis=0)]
        if not len(with_way):
            raise ConfigError(
                f"areas.{name}: no road of the area has a way to an exit; name other exits, or "
                "leave roads open"
            )
        total_m = float(network.lanes["length_m"][with_way].sum())
        count = area.vehicles
        if count is None:
            count = round((area.per_km or 0.0) * total_m / 1000.0)
        if count == 0:
            raise ConfigError(
                f"areas.{name}: the area has no vehicles; set vehicles or per_km higher"
            )
        left_out = len(roads) - len(np.unique(network.lanes["edge"][with_way]))
        if left_out:
            notes.append(
                f"{name}: no vehicle begins on {left_out} of {len(roads)} roads, which are shorter "
                f"than {SHORTEST_M:g} m, reversed, or without a way to an exit"
            )
        lane, place_m = _spread(network, with_way, count)
        areas.append(np.full(count, number))
        edges.append(lane)
        places.append(place_m)
    area_of, lane_of, place_of = map(np.concatenate, (areas, edges, places))
    total = len(area_of)
    order = np.random.default_rng(seed).permutation(total)
    depart_s = plan.start_s + plan.within_s * (np.arange(total) + 0.5) / total
    lane_of = lane_of[order]
    chosen = _shared_exits(times[:, lane_of], depart_s, network.edges["num_lanes"][goals])
    return Evacuees(
        area_of[order],
        network.lanes["edge"][lane_of].astype(np.int64),
        goals[chosen],
        depart_s,
        place_of[order],
        tuple(notes),
    )


def _times_s(
    network: RoadNetwork, goals: NDArray[np.intp], closed: NDArray[np.bool_]
) -> NDArray[np.float64]:
    """Return (num_exits, L) the time in s from each lane to each exit; inf: there is no way."""
    lanes = network.lanes.copy()
    lanes["permissions"][closed] = 0
    lanes.setflags(write=False)
    roads = network.arrays._replace(lanes=lanes)
    found = np.full((len(goals), len(lanes)), np.inf)
    plan = np.zeros(len(lanes), dtype=PLAN)
    starts = np.flatnonzero(~lanes["internal"] & (lanes["permissions"] & CARS != 0)).tolist()
    for row, goal in enumerate(goals.tolist()):
        plan_goal(roads, goal, CARS, 1.0, plan)
        for lane in starts:
            if plan["to_go"][lane] < np.inf:
                found[row, lane] = time_left(roads, plan, 0, lane)
    return found


def _refuse_closed_for_good(
    plan: EvacuationPlan,
    network: RoadNetwork,
    goals: NDArray[np.intp],
    closed: NDArray[np.bool_],
    times: NDArray[np.float64],
) -> None:
    """Raise ConfigError if an area has a way now, and none after the events of the plan."""
    at_last = closed.copy()
    for event in sorted(plan.events, key=lambda event: event.at_s):
        rows = edge_rows(event.edges, "events", network)
        lanes = np.isin(network.lanes["edge"], rows)
        if event.lanes is not None:
            lanes = lanes & np.isin(network.lanes["index"], event.lanes)
        if event.action in ("close", "reverse"):
            at_last[lanes] = True
        elif event.action == "open":
            at_last[lanes] = False
    if np.array_equal(at_last, closed):
        return
    later = _times_s(network, goals, at_last)
    for name, area in plan.areas.items():
        begins = _origins(network, roads_of(area, name, network), closed)
        had_way = np.isfinite(times[:, begins]).any()
        if had_way and not np.isfinite(later[:, begins]).any():
            raise ConfigError(
                f"events: they close the last way from {name} to an exit, and do not open it "
                "again; open a road later, or name another exit"
            )


def _origins(
    network: RoadNetwork, roads: NDArray[np.intp], closed: NDArray[np.bool_]
) -> NDArray[np.intp]:
    """Return the LANE rows of some roads on which vehicles may begin."""
    lanes = network.lanes
    usable = np.isin(lanes["edge"], roads) & (lanes["permissions"] & CARS != 0) & ~closed
    return np.flatnonzero(usable & (lanes["length_m"] >= SHORTEST_M))


def _spread(
    network: RoadNetwork, lanes: NDArray[np.intp], count: int
) -> tuple[NDArray[np.intp], NDArray[np.float64]]:
    """Return the lane (count,) and the place in m (count,) of vehicles at equal distances."""
    length_m = network.lanes["length_m"][lanes] - 2.0 * END_M
    ends = np.cumsum(length_m)
    at = (np.arange(count) + 0.5) / count * ends[-1]
    which = np.minimum(np.searchsorted(ends, at, side="right"), len(lanes) - 1)
    place_m = END_M + at - (ends[which] - length_m[which])
    return lanes[which], np.clip(place_m, END_M, END_M + length_m[which])


def _shared_exits(
    times_s: NDArray[np.float64], depart_s: NDArray[np.float64], lanes: NDArray[np.int32]
) -> NDArray[np.int64]:
    """Return the exit (n,) that each vehicle would pass earliest, in the order of departures.

    `times_s`: (num_exits, n) time from vehicle to exit. `lanes`: (num_exits,) lanes of each exit.
    """
    free_s = np.full(len(times_s), -np.inf)
    chosen = np.zeros(len(depart_s), dtype=np.int64)
    for number, depart in enumerate(depart_s.tolist()):
        passes_s = np.maximum(depart + times_s[:, number], free_s)
        best = int(passes_s.argmin())
        chosen[number] = best
        free_s[best] = passes_s[best] + HEADWAY_S / float(lanes[best])
    return chosen
