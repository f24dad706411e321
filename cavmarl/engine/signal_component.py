"""Signals whose greens are chosen, and their part of a tick."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from cavmarl.config.signals import SIGNAL_TERMS
from cavmarl.core.compiled.bound_call import BoundCall, bind
from cavmarl.core.errors import ConfigError
from cavmarl.shards.shard import Commands
from cavmarl.signals.kernels.camera_counts import count_by_cameras
from cavmarl.signals.kernels.green_choices import GREEN, HELD, KEEP, PREVIOUS, REFUSED, SINCE
from cavmarl.signals.kernels.lane_counts import COUNTS
from cavmarl.signals.kernels.loop_counts import DETECTED, estimate_by_loops, read_loops
from cavmarl.signals.kernels.message_counts import count_by_messages
from cavmarl.signals.kernels.signal_steps import (
    SignalOutputs,
    SignalRules,
    SignalWorlds,
    begin_signal_step,
    count_truth,
    end_signal_tick,
    observe_and_reward,
)
from cavmarl.signals.sensing import loops_shape, make_cameras, make_loops, make_unit_lanes
from cavmarl.signals.signal_table import SignalTable, ticks_of
from cavmarl.v2x.bus import Bus

if TYPE_CHECKING:
    from cavmarl.engine.component import ComponentContext
    from cavmarl.engine.v2x_component import V2xComponent

log = logging.getLogger(__name__)

_MOST = 1 << 40  # ticks and counts in a saved state


class SignalComponent:
    """A `Component` that carries out the choices of greens, and observes the lanes of signals.

    Attributes:
        table: the signals whose greens are chosen.
        outputs: state of the signals, and results for their agents.
        tick_calls: the calls at the end of a tick.
        step_calls: the calls at the end of a step, after `tick_calls`.
    """

    def __init__(self, host: ComponentContext, messages: V2xComponent | None) -> None:
        config, num_worlds = host.config.signals, host.num_worlds
        self.table = SignalTable(host.network)
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
            loops=host.zeros(loops_shape(config, num_worlds, sizes), dtype=np.int64),
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
            keys=first.worlds.keys,
            signal_phase=first.worlds.signal_phase,
            rows=zoned.rows,
            sides=first.row_sides,
            num_owned=zoned.num_owned,
        )
        self._bus: Bus | None = None
        self._told = False
        self._full = np.zeros(1, dtype=np.int64)  # inboxes that were full
        self._decide_ticks = rules.durations.decide
        self._choices = np.full(signals, KEEP, dtype=np.int64)
        self._chosen = np.ones(num_worlds, dtype=np.bool_)
        self._rewarded = np.ones(1, dtype=np.bool_)
        known = rules, worlds, self.outputs
        observed, truth = np.zeros(num_worlds, dtype=np.bool_), self.outputs.counts
        counts, readings = self.outputs.counts, self.outputs.loops
        # State of the loops; without loops, of no lanes
        self._detected = host.zeros((*readings.shape[:3], DETECTED), dtype=np.int64)
        read: list[BoundCall[None]] = []
        sense: list[BoundCall[None]] = []
        if config.sensing != "truth":
            truth = np.zeros_like(counts)
        if config.sensing == "loops":
            loops = make_loops(config, self.table, rules.dt, self._detected)
            read.append(bind(read_loops, rules, worlds, loops, self._chosen))
            estimate = bind(estimate_by_loops, rules, worlds, loops, observed, readings, counts)
            sense.append(estimate)
        elif config.sensing == "camera":
            most = zoned.rows.shape[1] * zoned.rows.shape[3]
            cameras = make_cameras(config, host.network, self.table, most)
            sense.append(bind(count_by_cameras, rules, worlds, cameras, observed, counts))
        elif config.sensing == "v2x" and messages is not None:
            self._bus = messages.bus
            units = make_unit_lanes(host.network, self.table, self._receivers(messages.bus))
            self._full = units.full
            inboxes = messages.bus.mail.objects
            sense.append(bind(count_by_messages, rules, worlds, units, inboxes, observed, counts))
        self._begin_step = bind(begin_signal_step, *known, self._choices)
        self.tick_calls = (bind(end_signal_tick, *known, self._chosen), *read)
        self.step_calls = (
            bind(count_truth, *known, self._chosen, observed, truth),
            *sense,
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
        """`end` reads the vehicles of all zones before a decision, with loops in each tick.

        `reset` always reads them.
        """
        decides: bool = self._detected.size > 0 or (self._ticks % self._decide_ticks == 0).any()
        return ("reset", "end") if decides else ("reset",)

    def reset(self, chosen: NDArray[np.bool_]) -> None:
        """Begin with the first green of each signal in the chosen worlds (W,)."""
        self.outputs.states[chosen] = 0
        for array in (self._stood, self._detected, self.outputs.loops, self.outputs.counts):
            array[chosen] = 0
        if self._bus is not None:
            self._bus.reset(chosen)  # messages of the last episode say nothing about this one
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
        """Set the phases of the next tick, count standing vehicles, and observe after a step."""
        for call in self.tick_calls:
            call()
        if self._ticks.item(0) % self._ticks_per_step == 0:
            for call in self.step_calls:
                call()
            self._tell_of_full_inboxes()

    def _receivers(self, bus: Bus) -> NDArray[np.int64]:
        """Return the row (S,) of each signal's roadside unit among the inboxes."""
        unit_of = {signal: unit for unit, signal in enumerate(bus.units["signal"].tolist())}
        rows = self.table.arrays.row.tolist()
        missing = [self.table.ids[s] for s, row in enumerate(rows) if row not in unit_of]
        if missing:
            raise ConfigError(
                f"signals.sensing = v2x: {len(missing)} signals with agents have no roadside unit, "
                f"such as {missing[0]!r}; set v2x.roadside.signals to [all]"
            )
        return np.array([bus.receiver_of_unit(unit_of[row]) for row in rows], dtype=np.int64)

    def _tell_of_full_inboxes(self) -> None:
        """Log once that roadside units may know more vehicles than they can keep."""
        if self._bus is None or self._told or not self._full[0]:
            return
        self._told = True
        log.warning(
            "signals.sensing = v2x: %d roadside units have full inboxes of %d vehicles; farther "
            "vehicles are not counted (v2x.inbox.objects, at most 64)",
            self._full[0], self._bus.mail.objects.shape[2],
        )  # fmt: skip

    def arrays(self) -> Iterator[NDArray[Any]]:
        """Return the states of the signals, and what their agents saw at the last decision."""
        outputs = self.outputs
        found = [outputs.states, self._stood, outputs.observations, outputs.counts]
        if self._detected.size:
            found += [self._detected, outputs.loops]
        return iter(found)

    def wrong(self, saved: Sequence[NDArray[Any]]) -> str:
        """Return what is wrong with saved arrays; empty if nothing."""
        states, stood, observations, counts, *loops = saved
        num_greens = self.table.arrays.num_greens
        for column in (PREVIOUS, GREEN):
            if ((states[..., column] < 0) | (states[..., column] >= num_greens)).any():
                return "a signal shows a green that it does not have"
        numbers = states[..., [SINCE, REFUSED]], stood, counts, *loops
        if any(((each < 0) | (each > _MOST)).any() for each in numbers):
            return "a time or a count of a signal is negative or too large"
        if not ((observations >= 0.0) & (observations <= 1.0)).all():
            return "an observation of a signal is out of range"
        return ""
