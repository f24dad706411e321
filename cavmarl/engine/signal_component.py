"""Signals whose greens are chosen, and their part of a tick."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from cavmarl.config.signals import SIGNAL_TERMS
from cavmarl.core.compiled.bound_call import bind
from cavmarl.engine.signal_sensing import SignalSensing
from cavmarl.shards.shard import Commands
from cavmarl.signals.kernels.green_choices import GREEN, HELD, KEEP, PREVIOUS, REFUSED, SINCE
from cavmarl.signals.kernels.lane_counts import COUNTS
from cavmarl.signals.kernels.lane_history import FLOW, HISTORY, NOT_MEASURED
from cavmarl.signals.kernels.signal_steps import (
    SignalOutputs,
    SignalRules,
    SignalWorlds,
    begin_signal_step,
    count_truth,
    end_signal_tick,
    observe_and_reward,
)
from cavmarl.signals.sensing import loops_shape
from cavmarl.signals.signal_table import SignalTable, ticks_of

if TYPE_CHECKING:
    from cavmarl.engine.component import ComponentContext
    from cavmarl.engine.v2x_component import V2xComponent

_MOST = 1 << 40  # limit of ticks and counts in a saved state


class SignalComponent:
    """A `Component` that applies the choices of greens, and observes the lanes of signals.

    Attributes:
        table: the signals whose greens are chosen.
        outputs: state of the signals, and results for their agents.
        tick_calls: the calls at the end of a tick.
        step_calls: the calls at the end of a step, after `tick_calls`.
    """

    def __init__(self, host: ComponentContext, messages: V2xComponent | None) -> None:
        config, num_worlds = host.config.signals, host.num_worlds
        self.table = SignalTable(host.network, config.range_m)
        sizes = self.table.sizes
        signals = (num_worlds, sizes.signals)
        first, zoned = host.shards[0], host.division.zoned
        self._ticks = first.worlds.ticks
        self._ticks_per_step = host.config.clock.ticks_per_step
        self._stood: NDArray[np.int64] = host.zeros(signals, dtype=np.int64)
        self.outputs = SignalOutputs(
            observations=host.zeros((*signals, sizes.features), dtype=np.float32),
            rewards=host.zeros(signals, dtype=np.float32),
            terms=host.zeros((*signals, len(SIGNAL_TERMS)), dtype=np.float32),
            masks=host.zeros((*signals, sizes.greens), dtype=np.bool_),
            decides=host.zeros(num_worlds, dtype=np.bool_),
            counts=host.zeros((num_worlds, sizes.lanes, COUNTS), dtype=np.int64),
            states=host.zeros((*signals, HELD), dtype=np.int64),
            history=host.zeros((num_worlds, sizes.lanes, HISTORY), dtype=np.int64),
            loops=host.zeros(loops_shape(config, num_worlds, sizes), dtype=np.int64),
        )
        rules = SignalRules(
            controlled=self.table.arrays,
            served=self.table.served,
            durations=ticks_of(config, host.config.clock.sim_dt_s),
            cyclic=config.action == "keep_or_next",
            dt=host.config.clock.sim_dt_s,
            near_m=config.platoon_m,
            weights=np.array(config.weight_of_each),
        )
        worlds = SignalWorlds(
            ticks=first.worlds.ticks,
            controllers=first.worlds.controllers,
            keys=first.worlds.keys,
            signal_phase=first.worlds.signal_phase,
            detected_s=first.worlds.detected_s,
            lanes=first.worlds.lanes,
            rows=zoned.rows,
            sides=first.row_sides,
            num_owned=zoned.num_owned,
        )
        self._decide_ticks = rules.durations.decide
        self._choices = np.full(signals, KEEP, dtype=np.int64)
        self._chosen = np.ones(num_worlds, dtype=np.bool_)
        self._rewarded = np.ones(1, dtype=np.bool_)
        known = rules, worlds, self.outputs
        observed = np.zeros(num_worlds, dtype=np.bool_)
        self._sensing = SignalSensing(
            host, messages, self.table, *known, chosen=self._chosen, observed=observed
        )
        truth = self._sensing.truth
        self._begin_step = bind(begin_signal_step, *known, self._choices)
        self.tick_calls = (bind(end_signal_tick, *known, self._chosen), *self._sensing.tick_calls)
        self.step_calls = (
            bind(count_truth, *known, self._chosen, observed, truth),
            *self._sensing.step_calls,
            bind(
                observe_and_reward,
                *known,
                self._chosen,
                observed,
                truth,
                self._stood,
                self._rewarded,
            ),
        )

    @property
    def reads_all(self) -> tuple[str, ...]:
        """`reset` reads all zones; `end` does so if a decision is due or sensors need each tick."""
        decides: bool = self._sensing.reads_ticks or (self._ticks % self._decide_ticks == 0).any()
        return ("reset", "end") if decides else ("reset",)

    def reset(self, chosen: NDArray[np.bool_]) -> None:
        """Begin with the first green of each signal in the chosen worlds (W,)."""
        self.outputs.states[chosen] = 0
        self.outputs.history[chosen] = 0
        self.outputs.history[chosen, :, FLOW] = NOT_MEASURED
        self._stood[chosen] = 0
        self._sensing.reset(chosen)
        self._chosen[:] = chosen
        self._rewarded[:] = False
        for call in (*self.tick_calls, *self.step_calls):
            call()
        self._chosen[:] = self._rewarded[:] = True

    def begin(self, commands: Commands) -> None:
        """Change the greens as chosen, in the first tick of a step."""
        if self._ticks.item(0) % self._ticks_per_step:
            return
        self._choices[:] = commands.signal_choices if commands.signal_choices.size else KEEP
        self._begin_step()

    def end(self) -> None:
        """Set the phases of the next tick, count stopped vehicles, and observe after a step."""
        for call in self.tick_calls:
            call()
        if self._ticks.item(0) % self._ticks_per_step == 0:
            for call in self.step_calls:
                call()
            self._sensing.tell_of_full_inboxes()

    def arrays(self) -> Iterator[NDArray[Any]]:
        """Return the states of the signals, and what their agents saw at the last decision."""
        outputs = self.outputs
        kept = (
            outputs.states,
            self._stood,
            outputs.observations,
            outputs.counts,
            outputs.history,
        )
        return iter((*kept, *self._sensing.kept))

    def wrong(self, saved: Sequence[NDArray[Any]]) -> str:
        """Return the fault of saved arrays; empty if they are valid."""
        states, stood, observations, counts, history, *loops = saved
        num_greens = self.table.arrays.num_greens
        for column in (PREVIOUS, GREEN):
            if ((states[..., column] < 0) | (states[..., column] >= num_greens)).any():
                return "a signal shows a green that it does not have"
        least = np.where(np.arange(HISTORY) == FLOW, NOT_MEASURED, 0)
        numbers = states[..., [SINCE, REFUSED]], stood, counts, history - least, *loops
        if any(((each < 0) | (each > _MOST)).any() for each in numbers):
            return "a time or a count of a signal is negative or too large"
        if not ((observations >= 0.0) & (observations <= 1.0)).all():
            return "an observation of a signal is out of range"
        return ""
