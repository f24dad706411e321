"""Signals that agents control, and their part of a tick."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cavmarl.config.signals import SIGNAL_TERMS
from cavmarl.core.compiled import specialized
from cavmarl.shards.shard import Commands
from cavmarl.signals.kernels.green_choices import (
    GREEN,
    HELD,
    KEEP,
    PREVIOUS,
    REFUSED,
    SINCE,
    choose_greens,
    mask_choices,
    show_greens,
)
from cavmarl.signals.kernels.lane_counts import COUNTS, count_lanes, count_standing
from cavmarl.signals.kernels.signal_observations import observe_signals, reward_signals
from cavmarl.signals.signal_table import SignalTable, ticks_of

if TYPE_CHECKING:
    from cavmarl.engine.component import ComponentContext


_MOST = 1 << 40  # ticks and counts in a saved state


class SignalOutputs(NamedTuple):
    """Outputs for the agents of S signals at the end of a step.

    Observations and counts are those of the last decision. G is the number of greens of the signal
    that has most, N the number of watched lanes, T the number of terms.
    """

    observations: NDArray[np.float32]  # (W, S, D)
    rewards: NDArray[np.float32]  # (W, S) 0 in steps that do not end an interval of decisions
    terms: NDArray[np.float32]  # (W, S, T)
    masks: NDArray[np.bool_]  # (W, S, G) choices that are allowed in the next step
    decides: NDArray[np.bool_]  # (W,) whether choices count in the next step
    counts: NDArray[np.int64]  # (W, N, COUNTS) see `signals.kernels.lane_counts`
    states: NDArray[np.int64]  # (W, S, HELD) see `signals.kernels.green_choices`


class SignalComponent:
    """A `Component` that carries out the choices of greens, and observes the lanes of signals.

    Attributes:
        table: the signals that agents control.
        outputs: results for their agents.
    """

    def __init__(self, host: ComponentContext) -> None:
        config, num_worlds = host.config.signals, host.num_worlds
        self.table = SignalTable(host.network)
        sizes = self.table.sizes
        signals = (num_worlds, sizes.signals)
        self._division = host.division
        self._worlds = host.shards[0].worlds
        self._dt = host.config.clock.sim_dt_s
        self._ticks_per_step = host.config.clock.ticks_per_step
        self._durations = ticks_of(config, self._dt)
        self._cyclic = config.action == "keep_or_next"
        self._weights = np.array(config.weight_of_each)
        self._stood: NDArray[np.int64] = host.zeros(signals, dtype=np.int64)
        self.outputs = SignalOutputs(
            observations=host.zeros((*signals, sizes.features), dtype=np.float32),
            rewards=host.zeros(signals, dtype=np.float32),
            terms=host.zeros((*signals, len(SIGNAL_TERMS)), dtype=np.float32),
            masks=host.zeros((*signals, sizes.greens), dtype=np.bool_),
            decides=host.zeros(num_worlds, dtype=np.bool_),
            counts=host.zeros((num_worlds, sizes.lanes, COUNTS), dtype=np.int64),
            states=host.zeros((*signals, HELD), dtype=np.int64),
        )
        self._keep = np.full(signals, KEEP, dtype=np.int64)
        self._no_worlds = np.zeros(num_worlds, dtype=np.bool_)
        self._choose_greens = specialized(choose_greens)
        self._show_greens = specialized(show_greens)
        self._mask_choices = specialized(mask_choices)
        self._count_standing = specialized(count_standing)
        self._count_lanes = specialized(count_lanes)
        self._observe_signals = specialized(observe_signals)
        self._reward_signals = specialized(reward_signals)

    @property
    def reads_all(self) -> tuple[str, ...]:
        """`end` reads the vehicles of all zones if it observes; `reset` always does."""
        return ("reset", "end") if self._is_observed().any() else ("reset",)

    def reset(self, chosen: NDArray[np.bool_]) -> None:
        """Begin with the first green of each signal in the chosen worlds (W,)."""
        self.outputs.states[chosen] = 0
        self._stood[chosen] = 0
        self._show()
        self._count_standing(self._rows, self._division.zoned.num_owned, self._lane_index)
        self._observe(chosen, self._no_worlds)

    def begin(self, commands: Commands) -> None:
        """Change the greens as agents have chosen, in the first tick of a step."""
        if self._worlds.ticks.item(0) % self._ticks_per_step:
            return
        choices = commands.signal_choices
        self._choose_greens(
            self.table.arrays,
            self._durations,
            self._cyclic,
            choices if choices.size else self._keep,
            self._worlds.ticks,
            self.outputs.states,
        )
        self._show()

    def end(self) -> None:
        """Set the phases of the next tick, count standing vehicles, and observe after a step."""
        self._show()
        self._count_standing(self._rows, self._division.zoned.num_owned, self._lane_index)
        if self._worlds.ticks.item(0) % self._ticks_per_step == 0:
            observed = self._is_observed()
            self._observe(observed, observed)

    def arrays(self) -> Iterator[NDArray[Any]]:
        """Return the states of the signals, and what their agents saw at the last decision."""
        outputs = self.outputs
        return iter((outputs.states, self._stood, outputs.observations, outputs.counts))

    def wrong(self, saved: Sequence[NDArray[Any]]) -> str:
        """Return what is wrong with saved arrays; empty if nothing."""
        states, stood, observations, counts = saved
        num_greens = self.table.arrays.num_greens
        for column in (PREVIOUS, GREEN):
            if ((states[..., column] < 0) | (states[..., column] >= num_greens)).any():
                return "a signal shows a green that it does not have"
        numbers = states[..., [SINCE, REFUSED]], stood, counts
        if any(((each < 0) | (each > _MOST)).any() for each in numbers):
            return "a time or a count of a signal is negative or too large"
        if not ((observations >= 0.0) & (observations <= 1.0)).all():
            return "an observation of a signal is out of range"
        return ""

    @property
    def _rows(self) -> NDArray[np.void]:
        rows: NDArray[np.void] = self._division.zoned.rows[self._division.side]
        return rows

    @property
    def _lane_index(self) -> NDArray[np.int32]:
        return self.table.arrays.lane_index

    def _is_observed(self) -> NDArray[np.bool_]:
        """Return the worlds (W,) in which the next choices count."""
        observed: NDArray[np.bool_] = self._worlds.ticks % self._durations.decide == 0
        return observed

    def _show(self) -> None:
        worlds = self._worlds
        self._show_greens(
            self.table.arrays,
            self._durations,
            self._dt,
            worlds.ticks,
            self.outputs.states,
            worlds.controllers,
            worlds.signal_phase,
        )

    def _observe(self, observed: NDArray[np.bool_], rewarded: NDArray[np.bool_]) -> None:
        """Write the outputs of a step in the observed worlds (W,), and rewards in some of them."""
        table, outputs, ticks = self.table.arrays, self.outputs, self._worlds.ticks
        self._mask_choices(
            table,
            self._durations,
            self._cyclic,
            ticks,
            outputs.states,
            outputs.decides,
            outputs.masks,
        )
        num_owned = self._division.zoned.num_owned
        self._count_lanes(table, self._rows, num_owned, observed, outputs.counts)
        self._observe_signals(
            table,
            self._durations,
            ticks,
            observed,
            outputs.states,
            outputs.counts,
            outputs.observations,
        )
        self._reward_signals(
            table,
            self._dt,
            self._weights,
            rewarded,
            outputs.counts,
            self._stood,
            outputs.terms,
            outputs.rewards,
        )
