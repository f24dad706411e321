"""Controllers of signals, which choose greens from what agents know about the lanes.

Each controller is for W worlds and is stateless: the history of lanes is part of the worlds' state.
A choice that the mask excludes is replaced by the current green, or by the next green if the mask
also excludes the current one.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from cavmarl.config.signals import SignalsConfig
from cavmarl.core.errors import ConfigError
from cavmarl.signals.kernels.controlled_signals import LaneWeights
from cavmarl.signals.kernels.green_choices import GREEN, KEEP, SINCE
from cavmarl.signals.kernels.green_rules import find_demanded, find_followers, plan_greens
from cavmarl.signals.kernels.green_scores import choose_best
from cavmarl.signals.kernels.lane_counts import VEHICLES
from cavmarl.signals.signal_table import SignalTable, ticks_of


class SignalView(NamedTuple):
    """The input of controllers, for W worlds.

    Attributes:
        config: durations and kind of action.
        dt: length of a tick in s.
        table: greens, lanes and movements of S signals.
        observations: (W, S, D), the agents' observations.
        ticks: (W,) since the reset.
        counts: (W, N, COUNTS) counts of the watched lanes, by the sensors that the key
            `signals.sensing` selects; see `cavmarl.signals.kernels.lane_counts`.
        states: (W, S, HELD) states of the signals; see `cavmarl.signals.kernels.green_choices`.
        masks: (W, S, G) allowed choices.
        decides: (W,) whether it is time for a decision.
        history: (W, N, HISTORY) history of the watched lanes; see
            `cavmarl.signals.kernels.lane_history`.
        loops: (W, N, 2, READINGS) readings of induction loops, see
            `cavmarl.signals.kernels.loop_counts`; without loops, (W, 0, 2, READINGS).
    """

    config: SignalsConfig
    dt: float
    table: SignalTable
    observations: NDArray[np.float32]
    ticks: NDArray[np.int64]
    counts: NDArray[np.int64]
    states: NDArray[np.int64]
    masks: NDArray[np.bool_]
    decides: NDArray[np.bool_]
    history: NDArray[np.int64]
    loops: NDArray[np.int64]


class SignalController(Protocol):
    """A controller of all signals."""

    def choose(self, view: SignalView) -> NDArray[np.int64]:
        """Return the choice (W, S) of each agent; KEEP where no decision is due."""
        ...


class ProgramController:
    """Uses the order and the durations of the greens in the map's programs."""

    def choose(self, view: SignalView) -> NDArray[np.int64]:
        """Start the next green when the current green has lasted as long as in the program."""
        return _by_durations(
            view, np.repeat(view.table.green_s[None], len(view.ticks), axis=0), 0.5 * view.dt
        )


class Webster:
    """Uses the order of the greens in the map's programs, with durations from measured flows.

    Until the first `signals.flow_interval_s` has ended, the durations are those of the programs.

    Source: Webster, "Traffic signal settings" (1958).
    """

    def choose(self, view: SignalView) -> NDArray[np.int64]:
        """Start the next green at the decision nearest to the end of the planned duration."""
        config, table = view.config, view.table
        green_s = np.repeat(view.table.green_s[None], len(view.ticks), axis=0)
        saturation = config.saturation_per_h * config.flow_interval_s / 3600.0
        change_s = config.yellow_s + config.all_red_s
        plan_greens(
            table.served,
            table.arrays.num_greens,
            np.bincount(table.served.lanes, minlength=len(table.lanes)),
            saturation,
            change_s,
            view.history,
            green_s,
        )
        return _by_durations(view, green_s, 0.5 * config.decide_s)


class Actuated:
    """Uses the order of the greens in the map's programs, and ends a green at a gap in traffic.

    The detectors, and the greens that each detector prolongs, are as in SUMO's actuated programs.
    """

    def choose(self, view: SignalView) -> NDArray[np.int64]:
        """Start the next green if the current one's detectors were free for `signals.max_gap_s`."""
        follows = np.empty(view.states.shape[:2], dtype=np.bool_)
        gap_ms = round(1e3 * view.config.max_gap_s)
        find_followers(
            view.table.prolonging, gap_ms, view.dt, view.ticks, view.states, view.history, follows
        )
        green = view.states[..., GREEN]
        return _choices(view, np.where(follows, green, (green + 1) % view.table.arrays.num_greens))


class Sotl:
    """Chooses the green that vehicles at red lights demand, without splitting platoons (SOTL).

    Sources: Gershenson, "Self-organizing traffic lights" (2005); Cools, Gershenson and D'Hooghe,
        "Self-organizing traffic lights: A realistic simulation" (2013).
    """

    def choose(self, view: SignalView) -> NDArray[np.int64]:
        """Choose the most demanded green, or keep the current green."""
        wanted = np.empty(view.states.shape[:2], dtype=np.int64)
        find_demanded(
            view.table.served,
            view.table.arrays.num_greens,
            round(view.config.sotl_vehicle_s / view.dt),
            view.config.platoon,
            view.counts,
            view.states,
            view.history,
            wanted,
        )
        return _choices(view, wanted)


class LongestQueue:
    """Chooses the green whose lanes have the most vehicles, like RESCO's controller "greedy"."""

    def choose(self, view: SignalView) -> NDArray[np.int64]:
        """Choose the green with the most vehicles on its lanes; on a tie, the current green."""
        return _best(view, view.table.served)


class MaxPressure:
    """Chooses the green with the largest pressure of the movements that it opens.

    Source: Varaiya, "Max pressure control of a network of signalized intersections" (2013), with
        equal capacities, and with the number of vehicles on a lane as the queue.
    """

    def choose(self, view: SignalView) -> NDArray[np.int64]:
        """Choose the green with the most vehicles on incoming minus those on outgoing lanes."""
        return _best(view, view.table.pressure)


CONTROLLERS: dict[str, Callable[[], SignalController]] = {  # same names as SIGNAL_CONTROLLERS
    "program": ProgramController,
    "webster": Webster,
    "actuated": Actuated,
    "sotl": Sotl,
    "longest_queue": LongestQueue,
    "max_pressure": MaxPressure,
}


def make_controller(name: str) -> SignalController:
    """Return a controller by its name.

    Raises:
        ConfigError: there is no such controller.
    """
    if name not in CONTROLLERS:
        raise ConfigError(f"no signal controller {name!r}: must be one of {', '.join(CONTROLLERS)}")
    return CONTROLLERS[name]()


def _best(view: SignalView, weights: LaneWeights) -> NDArray[np.int64]:
    """Choose the allowed green with the largest weighted number of vehicles on its lanes."""
    choices = np.empty(view.states.shape[:2], dtype=np.int64)
    choose_best(
        weights,
        VEHICLES,
        view.table.served,
        ticks_of(view.config, view.dt).longest_red,
        view.config.action == "keep_or_next",
        view.table.arrays.num_greens,
        view.counts,
        view.history,
        view.states,
        view.masks,
        view.decides,
        choices,
    )
    return choices


def _by_durations(
    view: SignalView, green_s: NDArray[np.float64], early_s: float
) -> NDArray[np.int64]:
    """Start the next green if the current green has lasted for its duration.

    `green_s`: (W, S, G) durations. `early_s`: the next green may start up to this long before
    the duration ends.
    """
    green = view.states[..., GREEN]
    change_s = view.config.yellow_s + view.config.all_red_s
    lasted_s = (view.ticks[:, None] - view.states[..., SINCE]) * view.dt - change_s
    due_s = np.take_along_axis(green_s, green[..., None], axis=2)[..., 0]
    is_over = lasted_s >= due_s - early_s
    return _choices(view, np.where(is_over, (green + 1) % view.table.arrays.num_greens, green))


def _keeps(view: SignalView) -> NDArray[np.bool_]:
    """Return whether each current green (W, S) may stay."""
    index = view.states[..., GREEN] if view.config.action == "next_phase" else 0
    index = np.broadcast_to(index, view.states.shape[:2])[..., None]
    found: NDArray[np.bool_] = np.take_along_axis(view.masks, index, axis=2)[..., 0]
    return found


def _choices(view: SignalView, wanted: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the choices that lead to the wanted greens (W, S), or allowed choices instead."""
    green = view.states[..., GREEN]
    if view.config.action == "next_phase":
        choices, keep = wanted, green
        change = (green + 1) % view.table.arrays.num_greens
    else:
        choices, keep = (wanted != green).astype(np.int64), np.zeros_like(green)
        change = np.ones_like(green)
    may = np.take_along_axis(view.masks, choices[..., None], axis=2)[..., 0]
    fallback = np.where(_keeps(view), keep, change)
    return np.where(view.decides[:, None], np.where(may, choices, fallback), KEEP)
