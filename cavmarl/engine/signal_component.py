"""Signals whose greens are chosen, and their part of a tick."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from cavmarl.config.signals import SIGNAL_TERMS
from cavmarl.core.compiled.bound_call import bind
from cavmarl.shards.shard import Commands
from cavmarl.signals.kernels.green_choices import GREEN, HELD, KEEP, PREVIOUS, REFUSED, SINCE
from cavmarl.signals.kernels.lane_counts import COUNTS
from cavmarl.signals.kernels.signal_steps import (
    SignalOutputs,
    SignalRules,
    SignalWorlds,
    begin_signal_step,
    end_signal_step,
    end_signal_tick,
)
from cavmarl.signals.signal_table import SignalTable, ticks_of

if TYPE_CHECKING:
    from cavmarl.engine.component import ComponentContext

_MOST = 1 << 40  # ticks and counts in a saved state


class SignalComponent:
    """A `Component` that carries out the choices of greens, and observes the lanes of signals.

    Attributes:
        table: the signals whose greens are chosen.
        outputs: state of the signals, and results for their agents.
        end_tick: the call at the end of a tick.
        end_step: the call at the end of a step, after `end_tick`.
    """

    def __init__(self, host: ComponentContext) -> None:
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
        )
        rules = SignalRules(
            controlled=self.table.arrays,
            durations=ticks_of(config, host.config.clock.sim_dt_s),
            cyclic=config.action == "keep_or_next",
            dt=host.config.clock.sim_dt_s,
            weights=np.array(config.weight_of_each),
        )
        worlds = SignalWorlds(
            ticks=first.worlds.ticks,
            controllers=first.worlds.controllers,
            signal_phase=first.worlds.signal_phase,
            rows=zoned.rows,
            sides=first.row_sides,
            num_owned=zoned.num_owned,
        )
        self._decide_ticks = rules.durations.decide
        self._choices = np.full(signals, KEEP, dtype=np.int64)
        self._chosen = np.ones(num_worlds, dtype=np.bool_)
        self._rewarded = np.ones(1, dtype=np.bool_)
        self._begin_step = bind(begin_signal_step, rules, worlds, self.outputs, self._choices)
        self.end_tick = bind(end_signal_tick, rules, worlds, self.outputs, self._chosen)
        self.end_step = bind(
            end_signal_step,
            rules,
            worlds,
            self.outputs,
            self._chosen,
            self._stood,
            np.zeros(num_worlds, dtype=np.bool_),
            self._rewarded,
        )

    @property
    def reads_all(self) -> tuple[str, ...]:
        """`end` reads the vehicles of all zones before a decision; `reset` always does."""
        decides: bool = (self._ticks % self._decide_ticks == 0).any()
        return ("reset", "end") if decides else ("reset",)

    def reset(self, chosen: NDArray[np.bool_]) -> None:
        """Begin with the first green of each signal in the chosen worlds (W,)."""
        self.outputs.states[chosen] = 0
        self._stood[chosen] = 0
        self._chosen[:] = chosen
        self.end_tick()
        self._rewarded[:] = False
        self.end_step()
        self._chosen[:] = self._rewarded[:] = True

    def begin(self, commands: Commands) -> None:
        """Change the greens as chosen, in the first tick of a step."""
        if self._ticks.item(0) % self._ticks_per_step:
            return
        self._choices[:] = commands.signal_choices if commands.signal_choices.size else KEEP
        self._begin_step()

    def end(self) -> None:
        """Set the phases of the next tick, count standing vehicles, and observe after a step."""
        self.end_tick()
        if self._ticks.item(0) % self._ticks_per_step == 0:
            self.end_step()

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
