"""`SignalTable`: the signals that agents control, with their greens, lanes and movements."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cavmarl.config.signals import SignalsConfig
from cavmarl.core.records.codes import CHOSEN_BY_AGENT, SIGNAL_GREEN_MAJOR, SIGNAL_GREEN_MINOR
from cavmarl.roads.network import RoadNetwork
from cavmarl.signals.kernels.controlled_signals import ControlledSignals, SignalTicks


class SignalSizes(NamedTuple):
    """Sizes of the arrays about the signals that agents control."""

    signals: int = 0  # S
    greens: int = 0  # G, of the signal with most greens
    lanes: int = 0  # N, lanes that lead to or from these signals
    features: int = 0  # D, of the longest observation


class SignalTable:
    """The signals that agents control, in the order of the map.

    Attributes:
        ids: ids of the signals (S,).
        greens: letters of the greens of each signal, as codes (num_greens, num_links).
        lanes: ids of the lanes before and behind the signals (N,).
        movements: for each signal, (M, 2) lanes from which and to which vehicles may drive, as
            indices of `lanes`, in the order of the signal's links; each once.
        opened: for each signal, (num_greens, M) whether a green opens a movement.
        served: for each signal, (num_greens, N) 1 for lanes that a green opens.
        green_s: (S, G) duration of each green in the map's program; 0 beyond a signal's greens.
        arrays: the same for kernels.
        sizes: sizes of the arrays.
    """

    def __init__(self, network: RoadNetwork) -> None:
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
        lane_row = np.array([*index], dtype=np.int32)
        lane_index = np.full(len(network.lanes), -1, dtype=np.int32)
        lane_index[lane_row] = np.arange(len(lane_row))
        self.lanes = tuple(network.lane_ids[row] for row in lane_row.tolist())
        self.served = [
            _served(moves, opened, len(index))
            for moves, opened in zip(self.movements, self.opened, strict=True)
        ]
        self.arrays = ControlledSignals(
            row=np.array(chosen, dtype=np.int32),
            controller=programs["controller"][used].astype(np.int32),
            first_phase=programs["first_phase"][used].astype(np.int32),
            num_greens=np.array([len(greens) for greens in self.greens], dtype=np.int32),
            incoming=_padded(incoming),
            outgoing=_padded(outgoing),
            lane_row=lane_row,
            lane_index=lane_index,
            length_m=network.lanes["length_m"][lane_row],
            speed_mps=network.lanes["speed_mps"][lane_row],
        )
        greens_max = int(self.arrays.num_greens.max(initial=0))
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


def ticks_of(config: SignalsConfig, sim_dt_s: float) -> SignalTicks:
    """Return the durations of a configuration in ticks."""
    return SignalTicks(
        decide=round(config.decide_s / sim_dt_s),
        yellow=round(config.yellow_s / sim_dt_s),
        all_red=round(config.all_red_s / sim_dt_s),
        min_green=round(config.min_green_s / sim_dt_s),
        max_green=round(config.max_green_s / sim_dt_s),
    )


def sizes_of(network: RoadNetwork) -> SignalSizes:
    """Return the sizes of the arrays about the signals that agents control."""
    return SignalTable(network).sizes


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


def _served(
    movements: NDArray[np.int64], opened: NDArray[np.bool_], num_lanes: int
) -> NDArray[np.int64]:
    """Return (num_greens, N) 1 for lanes from which a green opens a movement."""
    served = np.zeros((len(opened), num_lanes), dtype=np.int64)
    for green, is_open in enumerate(opened):
        served[green, movements[is_open, 0]] = 1
    return served


def _padded(lists: list[list[int]]) -> NDArray[np.int32]:
    found = np.full((len(lists), max(map(len, lists), default=0)), -1, dtype=np.int32)
    for row, values in enumerate(lists):
        found[row, : len(values)] = values
    return found
