"""Roadside units that set speed limits, and their part of a tick."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cavmarl.config.limits import LIMIT_TERMS
from cavmarl.core.compiled.bound_call import bind
from cavmarl.engine.component import Component, ComponentContext
from cavmarl.engine.lane_component import LaneComponent
from cavmarl.limits.kernels.limit_steps import (
    SUMS,
    LimitOutputs,
    choose_limits,
    count_sections,
    observe_limits,
)
from cavmarl.limits.limit_table import LimitTable, limit_rules
from cavmarl.shards.shard import Commands
from cavmarl.signals.kernels.green_choices import GREEN, HELD, KEEP, PREVIOUS, REFUSED, SINCE

_MOST = 1 << 60  # limit of ticks and sums in a saved state


class LimitComponent(Component):
    """A `Component` that sets the chosen limits, and observes the sections.

    A section is a list of edges whose vehicles are counted together, see `limits.sections`. An
    episode begins with the highest limit of `limits.speeds_mps`.

    Attributes:
        table: the units that set limits.
        outputs: state of the units, and results for their agents.
        tick_calls: the calls at the end of a tick.
        step_calls: the calls at the end of a step, after `tick_calls`.
    """

    reads_all = ("reset", "end")

    def __init__(self, host: ComponentContext, lanes: LaneComponent) -> None:
        config, num_worlds = host.config.limits, host.num_worlds
        self.table = LimitTable(host.network, config)
        sizes = self.table.sizes
        units = (num_worlds, sizes.signals)
        first, zoned = host.shards[0], host.division.zoned
        self._lanes = lanes
        self._ticks = first.worlds.ticks
        self._ticks_per_step = host.config.clock.ticks_per_step
        self._rules = limit_rules(config, host.config.clock.sim_dt_s)
        self._sums: NDArray[np.int64] = host.zeros(
            (num_worlds, len(self.table.sections), SUMS), dtype=np.int64
        )
        self.outputs = LimitOutputs(
            observations=host.zeros((*units, sizes.features), dtype=np.float32),
            rewards=host.zeros(units, dtype=np.float32),
            terms=host.zeros((*units, len(LIMIT_TERMS)), dtype=np.float32),
            masks=host.zeros((*units, sizes.greens), dtype=np.bool_),
            decides=host.zeros(num_worlds, dtype=np.bool_),
            states=host.zeros((*units, HELD), dtype=np.int64),
        )
        self._choices = np.full(units, KEEP, dtype=np.int64)
        self._chosen = np.ones(num_worlds, dtype=np.bool_)
        self._rewarded = np.ones(1, dtype=np.bool_)
        states = self.outputs.states
        self._choose = bind(choose_limits, self._rules, self._choices, self._ticks, states)
        self.tick_calls = (
            bind(
                count_sections,
                self.table.arrays,
                zoned.rows,
                first.row_sides,
                zoned.num_owned,
                self._chosen,
                self._sums,
            ),
        )
        self.step_calls = (
            bind(
                observe_limits,
                self.table.arrays,
                self._rules,
                self.outputs,
                self._ticks,
                self._chosen,
                self._rewarded,
                self._sums,
            ),
        )

    def reset(self, chosen: NDArray[np.bool_]) -> None:
        """Begin with the highest limit in the chosen worlds (W,)."""
        states = self.outputs.states
        states[chosen] = 0
        for column in (PREVIOUS, GREEN):
            states[chosen, :, column] = self._rules.num_choices - 1
        self._sums[chosen] = 0
        self._set_limits()
        self._chosen[:] = chosen
        self._rewarded[:] = False
        for call in self.step_calls:
            call()
        self._chosen[:] = self._rewarded[:] = True

    def begin(self, commands: Commands) -> None:
        """Change the limits as chosen, in the first tick of a step."""
        if self._ticks.item(0) % self._ticks_per_step:
            return
        if not (self._ticks % self._rules.decide == 0).any():
            return
        self._choices[:] = commands.signal_choices if commands.signal_choices.size else KEEP
        self._choose()
        self._set_limits()

    def end(self) -> None:
        """Count the vehicles of the sections, and observe after a step."""
        for call in self.tick_calls:
            call()
        if self._ticks.item(0) % self._ticks_per_step == 0:
            for call in self.step_calls:
                call()

    def _set_limits(self) -> None:
        self._lanes.limit(self.table.limits_mps(self.outputs.states[..., GREEN]))

    def arrays(self) -> Iterator[NDArray[Any]]:
        """Return the states of the units, the sums, and what agents saw at the last decision."""
        return iter((self.outputs.states, self._sums, self.outputs.observations))

    def wrong(self, saved: Sequence[NDArray[Any]]) -> str:
        """Return the fault of saved arrays; empty if they are valid."""
        states, sums, observations = saved
        choices = states[..., [PREVIOUS, GREEN]]
        if ((choices < 0) | (choices >= self._rules.num_choices)).any():
            return "a speed limit is not one of the choices"
        numbers = states[..., [SINCE, REFUSED]], sums
        if any(((each < 0) | (each > _MOST)).any() for each in numbers):
            return "a time or a sum of a unit with a speed limit is negative or too large"
        if not ((observations >= 0.0) & (observations <= 1.0)).all():
            return "an observation of a unit with a speed limit is out of range"
        return ""
