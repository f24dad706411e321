"""`SignalTable`: the signals that agents control, with their greens, lanes and movements."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cavmarl.config.signals import SIGNAL_TERMS, SignalsConfig
from cavmarl.core.records.codes import CHOSEN_BY_AGENT, SIGNAL_GREEN_MAJOR, SIGNAL_GREEN_MINOR
from cavmarl.roads.network import RoadNetwork
from cavmarl.signals.kernels.controlled_signals import (
    ControlledSignals,
    LanePosts,
    LaneWeights,
    SignalTicks,
)


class SignalSizes(NamedTuple):
    """Sizes of the arrays for agents of signals, or for other agents beside the road."""

    signals: int = 0  # S
    greens: int = 0  # G, largest number of greens of a signal
    lanes: int = 0  # N, lanes that lead to or from these signals
    features: int = 0  # D, length of the longest observation
    terms: int = len(SIGNAL_TERMS)  # T, number of reward terms


class SignalTable:
    """The signals that agents control, in the order of the map.

    Attributes:
        ids: ids of the signals (S,).
        greens: letters of the greens of each signal, as codes (num_greens, num_links).
        lanes: ids of the lanes before and after the signals, then of the lanes that `lanes_before`
            adds for `range_m` (N,).
        movements: for each signal, (M, 2) pairs of the lanes before and after a movement, as
            indices of `lanes`, in the order of the signal's links, without repetitions.
        opened: for each signal, (num_greens, M) whether a green opens a movement.
        served: weight 1 for each lane that a green opens.
        pressure: for each movement that a green opens, weight 1 for the lane before the signal, and
            -1 for the lane after it.
        prolonging: weight 1 for each lane whose detector prolongs a green, by the rule of actuated
            programs (`roads.sumo_net.detectors`).
        green_s: (S, G) duration of each green in the map's program; 0 beyond a signal's greens.
        arrays: the table for kernels.
        posts: where each of `lanes` is observed.
        sizes: sizes of the arrays.
    """

    def __init__(self, network: RoadNetwork, range_m: float = 0.0) -> None:
        programs = network.programs
        chosen = [
            row
            for row, program in enumerate(network.signals["program"].tolist())
            if programs["detector_gap_s"][program] == CHOSEN_BY_AGENT
        ]
        self.ids = tuple(network.signal_ids[row] for row in chosen)
        used = network.signals["program"][chosen]
        self.greens = [_greens(network, row) for row in chosen]
        incoming: list[list[int]] = []
        outgoing: list[list[int]] = []
        index: dict[int, int] = {}
        self.movements: list[NDArray[np.int64]] = []
        self.opened: list[NDArray[np.bool_]] = []
        for row, greens in zip(chosen, self.greens, strict=True):
            links = network.links[network.links["signal"] == row]
            links = links[np.argsort(links["signal_index"], kind="stable")]
            from_to = [
                (int(link["from_lane"]), int(link["to_lane"]), int(link["signal_index"]))
                for link in links
            ]
            for lanes, side in ((incoming, 0), (outgoing, 1)):
                found = dict.fromkeys(one[side] for one in from_to)
                lanes.append([index.setdefault(lane, len(index)) for lane in found])
            moves: dict[tuple[int, int], list[int]] = {}
            for start, end, letter in from_to:
                moves.setdefault((index[start], index[end]), []).append(letter)
            self.movements.append(np.array([*moves], dtype=np.int64).reshape(-1, 2))
            is_green = (greens == SIGNAL_GREEN_MAJOR) | (greens == SIGNAL_GREEN_MINOR)
            opened = [is_green[:, letters].any(axis=1) for letters in moves.values()]
            self.opened.append(np.array(opened, dtype=np.bool_).T)
        upstream = {
            n: [index.setdefault(lane, len(index)) for lane in lanes_before(network, row, range_m)]
            for row, n in [*index.items()]
            if any(n in lanes for lanes in incoming)
        }
        approach = [
            [*dict.fromkeys([*lanes, *(up for n in lanes for up in upstream[n])])]
            for lanes in incoming
        ]
        lane_row = np.array([*index], dtype=np.int32)
        lane_index = np.full(len(network.lanes), -1, dtype=np.int32)
        lane_index[lane_row] = np.arange(len(lane_row))
        self.lanes = tuple(network.lane_ids[row] for row in lane_row.tolist())
        self.arrays = ControlledSignals(
            row=np.array(chosen, dtype=np.int32),
            controller=programs["controller"][used].astype(np.int32),
            first_phase=programs["first_phase"][used].astype(np.int32),
            num_greens=np.array([len(greens) for greens in self.greens], dtype=np.int32),
            incoming=_padded(incoming),
            outgoing=_padded(outgoing),
            approach=_padded(approach),
            lane_row=lane_row,
            lane_index=lane_index,
            length_m=network.lanes["length_m"][lane_row],
            speed_mps=network.lanes["speed_mps"][lane_row],
            detector=_detectors(network, incoming, self.movements, self.opened, len(index)),
        )
        self.posts = _posts(incoming, outgoing, network.lanes[lane_row])
        greens_max = int(self.arrays.num_greens.max(initial=0))
        self.served, self.pressure = (
            _weights(self.movements, self.opened, greens_max, of_each, upstream)
            for of_each in (_of_served_lanes, _of_pressure)
        )
        self.prolonging = _prolonging(network, chosen, self.arrays.detector, greens_max)
        self.green_s = np.zeros((len(chosen), greens_max))
        for s, row in enumerate(chosen):
            phases = _phases(network, row)
            durations = phases["duration_s"][phases["green"]]
            self.green_s[s, : len(durations)] = durations
        features = [
            len(greens) + 1 + 2 * len(lanes)
            for greens, lanes in zip(self.greens, incoming, strict=True)
        ]
        self.features = tuple(features)
        self.sizes = SignalSizes(len(chosen), greens_max, len(index), max(features, default=0))


def lanes_before(network: RoadNetwork, lane: int, range_m: float) -> list[int]:
    """Return the LANE rows that lead to a lane without a signal in between, nearest first.

    A row is included if the next lane outside of junctions begins less than `range_m` before the
    end of the given lane.
    """
    found: dict[int, None] = {}
    ends = [(lane, 0.0)]
    for row, end_m in ends:
        begin_m = end_m + float(network.lanes["length_m"][row])
        if begin_m >= range_m:
            continue
        for link in network.links[network.links["to_lane"] == row]:
            before = int(link["from_lane"])
            if link["signal"] >= 0 or before in found or before == lane:
                continue
            inside = int(link["next_lane"])
            while inside != row:
                found[inside] = None
                inside = int(network.lanes["successor"][inside])
            found[before] = None
            ends.append((before, begin_m + float(link["length_m"])))
    return [*found]


def ticks_of(config: SignalsConfig, sim_dt_s: float) -> SignalTicks:
    """Return the durations of a configuration in ticks."""
    return SignalTicks(
        decide=round(config.decide_s / sim_dt_s),
        yellow=round(config.yellow_s / sim_dt_s),
        all_red=round(config.all_red_s / sim_dt_s),
        min_green=round(config.min_green_s / sim_dt_s),
        max_green=round(config.max_green_s / sim_dt_s),
        longest_red=round(config.longest_red_s / sim_dt_s),
        flow_interval=round(config.flow_interval_s / sim_dt_s),
    )


def sizes_of(network: RoadNetwork, range_m: float) -> SignalSizes:
    """Return the sizes of the arrays for the signals that agents control."""
    return SignalTable(network, range_m).sizes


def _greens(network: RoadNetwork, row: int) -> NDArray[np.uint8]:
    """Return the letters (num_greens, num_links) of the greens of a signal's agent program."""
    num_links = int(network.signals["num_links"][row])
    phases = _phases(network, row)
    starts = phases["first_state"][phases["green"]]
    return np.array([network.phase_states[k : k + num_links] for k in starts.tolist()])


def _phases(network: RoadNetwork, row: int) -> NDArray[np.void]:
    program = network.programs[network.signals["program"][row]]
    first = int(program["first_phase"])
    return network.phases[first : first + program["num_phases"]]


def _detectors(
    network: RoadNetwork,
    incoming: Sequence[Sequence[int]],
    movements: Sequence[NDArray[np.int64]],
    opened: Sequence[NDArray[np.bool_]],
    num_lanes: int,
) -> NDArray[np.int32]:
    """Return the DETECTOR row of each watched lane.

    The programs of these signals are the last programs of the network, so their detectors are the
    last detectors: for each signal, one per incoming lane that a green opens (`place_detectors`).
    """
    detected = [
        lane
        for lanes, moves, greens in zip(incoming, movements, opened, strict=True)
        for lane in lanes
        if greens[:, moves[:, 0] == lane].any()
    ]
    found = np.full(num_lanes, -1, dtype=np.int32)
    count = len(network.detectors)
    found[detected] = np.arange(count - len(detected), count)
    return found


def _of_served_lanes(moves: list[tuple[int, int]]) -> dict[int, int]:
    """Return the weight of each lane from which movements start."""
    return dict.fromkeys((before for before, _ in moves), 1)


def _of_pressure(moves: list[tuple[int, int]]) -> dict[int, int]:
    """Return the weight of each lane in the pressure of movements."""
    found: dict[int, int] = {}
    for before, behind in moves:
        found[before] = found.get(before, 0) + 1
        found[behind] = found.get(behind, 0) - 1
    return {lane: weight for lane, weight in found.items() if weight}


def _weights(
    movements: Sequence[NDArray[np.int64]],
    opened: Sequence[NDArray[np.bool_]],
    greens_max: int,
    of_each: Callable[[list[tuple[int, int]]], dict[int, int]],
    upstream: Mapping[int, Sequence[int]],
) -> LaneWeights:
    """Return the weights of lanes for each green, from the movements that the green opens.

    A lane that is `upstream` of lanes with positive weights gets, in addition to its own weight,
    the largest of theirs.
    """

    def extended(found: dict[int, int]) -> dict[int, int]:
        more: dict[int, int] = {}
        for lane, weight in found.items():
            for up in upstream.get(lane, ()) if weight > 0 else ():
                more[up] = max(weight, more.get(up, 0))
        for up, weight in more.items():
            found[up] = found.get(up, 0) + weight
        return found

    lists: list[dict[int, int]] = []
    for moves, greens in zip(movements, opened, strict=True):
        lists += [
            extended(of_each(list(map(tuple, moves[is_open].tolist())))) for is_open in greens
        ]
        lists += [{}] * (greens_max - len(greens))
    return _as_table(lists)


def _prolonging(
    network: RoadNetwork, chosen: Sequence[int], detector: NDArray[np.int32], greens_max: int
) -> LaneWeights:
    lane_of = {row: lane for lane, row in enumerate(detector.tolist()) if row >= 0}
    lists: list[dict[int, int]] = []
    for row in chosen:
        phases = _phases(network, row)
        greens = phases[phases["green"]]
        for first, count in zip(greens["first_detector"], greens["num_detectors"], strict=True):
            used = network.phase_detectors[first : first + count].tolist()
            lists.append({lane_of[number]: 1 for number in used})
        lists += [{}] * (greens_max - len(greens))
    return _as_table(lists)


def _as_table(lists: Sequence[dict[int, int]]) -> LaneWeights:
    """Return the weights by lane, for each green of each signal, as one table."""
    return LaneWeights(
        first=np.cumsum([0, *map(len, lists)], dtype=np.int64),
        lanes=np.array([lane for each in lists for lane in each], dtype=np.int32),
        weights=np.array([weight for each in lists for weight in each.values()], dtype=np.int64),
    )


def _posts(
    incoming: list[list[int]], outgoing: list[list[int]], lanes: NDArray[np.void]
) -> LanePosts:
    """Return where `lanes`, LANE (N,), are observed.

    `incoming`, `outgoing`: indices of the lanes before and after each signal.
    """
    signal = np.full(len(lanes), -1, dtype=np.int32)
    leads_in = np.zeros(len(lanes), dtype=np.bool_)
    for lists, is_in in ((incoming, True), (outgoing, False)):
        for s, row in enumerate(lists):
            new = [lane for lane in row if signal[lane] < 0]
            signal[new], leads_in[new] = s, is_in
    line_m = np.where(leads_in, lanes["length_m"] - lanes["stop_back_m"], 0.0)
    return LanePosts(signal, leads_in, line_m)


def _padded(lists: list[list[int]]) -> NDArray[np.int32]:
    found = np.full((len(lists), max(map(len, lists), default=0)), -1, dtype=np.int32)
    for row, values in enumerate(lists):
        found[row, : len(values)] = values
    return found
