"""`CompiledStep`: the ticks of a step as one compiled call, for plain undivided worlds.

In a small world, Python takes longer between the phases than the phases themselves take. This
module makes the calls of `Tick` in the same order; a test checks that both give the same bytes.
"""

from __future__ import annotations

import numpy as np

from cavmarl.core.compiled.bound_call import CallSequence, bind
from cavmarl.core.math.counters import any_positive, clear, totals
from cavmarl.engine.lane_component import LaneComponent
from cavmarl.engine.limit_component import LimitComponent
from cavmarl.engine.signal_component import SignalComponent
from cavmarl.engine.tick import Tick
from cavmarl.shards.shard import Commands
from cavmarl.shards.shard_group import ShardGroup

# Components that have `tick_calls` and `step_calls`, or act only in `begin`.
COMPILED = SignalComponent | LimitComponent | LaneComponent


class CompiledStep:
    """The ticks of a step and the sensing at its end, as one sequence of compiled calls."""

    def __init__(self, tick: Tick, group: ShardGroup) -> None:
        self.departures = tick.departures
        self.group = group
        self._tick = tick
        self._ticks = CallSequence()
        self._signals = [
            part for part in tick.attached if isinstance(part, SignalComponent | LimitComponent)
        ]
        for _ in range(group.first.config.clock.ticks_per_step):
            self._add_tick(self._ticks)
        for part in self._signals:
            for call in part.step_calls:
                self._ticks.call(call)
        if group.calls.has_agents:
            self._add_sense(self._ticks)

    def run(self, commands: Commands) -> None:
        """Run the step."""
        calls = self.group.calls
        for part in self._tick.attached:
            part.begin(commands)
        self._tick.begin_step(commands)
        if calls.has_agents:
            np.copyto(calls.controls, commands.controls)
            calls.chosen[:] = self._tick.shared.chosen[:] = True
        self._ticks.run()
        self.group.set_sides(*calls.members.sides.tolist())

    def _add_tick(self, sequence: CallSequence) -> None:
        """Append the phases of a tick; see `Tick.run`."""
        tick, calls = self._tick, self.group.calls
        sequence.call(calls.turn)
        sequence.call(calls.advance)
        self._add_leave(sequence)
        sequence.call(tick.division.row_count)
        sequence.call(calls.resolve)
        self._add_enter(sequence)
        sequence.call(calls.commit)
        sequence.call(tick.count_tick)
        if calls.has_detectors:
            sequence.call(calls.detect)
        if tick.shared.has_signals:
            sequence.call(tick.shared.signal_switch(tick.common))
        for part in self._signals:
            for call in part.tick_calls:
                sequence.call(call)

    def _add_leave(self, sequence: CallSequence) -> None:
        """Append the calls of `Tick.leave`."""
        tick, calls = self._tick, self.group.departure_calls(self.departures)
        worlds, traffic = tick.worlds, tick.traffic
        sequence.call(tick.occasions)
        with sequence.only_if(tick.occasions, 0):
            sequence.call(calls.choose_goals(traffic.demand, len(traffic.plans)))
        with sequence.only_if(tick.occasions, 1):
            sequence.call(calls.leave)
            some_pass = bind(any_positive, self.departures.num_passing)
            sequence.call(some_pass)
            with sequence.only_if(some_pass):
                calls_of = traffic.calls(self.departures, worlds.ticks, worlds.keys, worlds.lanes)
                sequence.call(calls_of.settle)

    def _add_enter(self, sequence: CallSequence) -> None:
        """Append the calls of `Tick._enter`."""
        tick, calls = self._tick, self.group.departure_calls(self.departures)
        departures, worlds = self.departures, tick.worlds
        traffic = tick.traffic.calls(departures, worlds.ticks, worlds.keys, worlds.lanes)
        if departures.orders.shape[1]:
            sequence.call(traffic.call_orders)
        some_wait = bind(any_positive, departures.num_queue)
        sequence.call(some_wait)
        with sequence.only_if(some_wait):
            sequence.call(calls.rank_lanes)
            sequence.call(traffic.assign_lanes)
            sequence.call(calls.propose(tick.traffic.demand))
            some_pass = bind(any_positive, departures.num_passing)
            sequence.call(some_pass)
            with sequence.only_if(some_pass):
                sequence.call(
                    bind(totals, counts=tick.division.zoned.num_owned, out=traffic.running)
                )
                sequence.call(traffic.accept)
                sequence.call(calls.admit)
                sequence.call(bind(clear, departures.num_passing))

    def _add_sense(self, sequence: CallSequence) -> None:
        """Append the calls of `Tick.sense`."""
        shared, calls = self._tick.shared, self.group.calls
        sequence.call(shared.clearing)
        sequence.call(calls.sense)
        if calls.has_optional:
            sequence.call(calls.observe_optional)
        if calls.stacks:
            sequence.call(calls.fill_stacks)
        sequence.call(shared.settling)
        sequence.call(calls.credit)


def compiled_step(tick: Tick, last: CompiledStep | None) -> CompiledStep | None:
    """Return a compiled step, or None if these worlds need phases that it does not include.

    Args:
        tick: the tick of the worlds.
        last: the result of the previous call; it is reused while its parts are the same.
    """
    group = tick.executor
    if (
        type(group) is not ShardGroup
        or len(group.shards) != 1
        or tick.coordination.needs_ghosts
        or not all(isinstance(part, COMPILED) for part in tick.attached)
        or tick.outside.sumo is not None
        or tick.traffic.rerouting is not None
        or group.calls.has_registered
    ):
        return None
    if last is None or last.departures is not tick.departures or last.group is not group:
        return CompiledStep(tick, group)
    return last
