"""`Tick` runs one tick of W worlds, phase by phase, and defines the order of the phases.

`compiled_step.py` makes the same calls in the same order for plain undivided worlds.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.compiled.bound_call import bind
from cavmarl.core.math.counters import count_tick, occasions
from cavmarl.core.records.arrays import DepartureQueue, Worlds
from cavmarl.engine.component import Component
from cavmarl.engine.outside_traffic import OutsideTraffic, SumoPhases
from cavmarl.engine.peers import Peers
from cavmarl.engine.shared_outputs import SharedOutputs
from cavmarl.engine.step_trace import Traced
from cavmarl.handoff.coordinator.coordinators import OwnershipRuntime
from cavmarl.handoff.division import ZonedShards
from cavmarl.shards.executor import Executor, TeamExecutor
from cavmarl.shards.shard import Commands, Shard, common_of
from cavmarl.shards.shard_group import ShardGroup
from cavmarl.traffic.native import NativeTraffic


class Tick:
    """The phases of a tick in their order, and the parts that run them.

    Attributes:
        executor: runs the phases of the shards, in this process or in several.
        departures: the queue through which vehicles enter and leave; a reset may replace it.
        coordination: decides which zone owns which vehicle.
        peers: the processes that run the other zones.
        outside: the phases of vehicles that SUMO or the caller moves; by default, they do nothing.
        common: ticks, keys and signals of the worlds, which all zones share.
    """

    def __init__(
        self,
        shards: Sequence[Shard],  # one per zone
        division: ZonedShards,  # of all shards
        traffic: NativeTraffic,  # departures, routes and arrivals
        shared: SharedOutputs,  # signals and outputs of all shards
        departures: DepartureQueue,
        attached: tuple[Component, ...],  # components that act in each tick
    ) -> None:
        self.shards = shards
        self.division = division
        self.traffic = traffic
        self.shared = shared
        self.departures = departures
        self.attached = attached
        self.executor: Executor = ShardGroup(shards)
        self.coordination = OwnershipRuntime()
        self.peers = Peers(division)
        self.outside = OutsideTraffic()
        self.finish_phase: Callable[[], None] = _no_wait
        self.note_phase: Callable[[str], None] = _ignore
        self._shard = shards[0]
        self._everywhere = np.ones(len(self._shard.worlds.ticks), dtype=np.bool_)
        self._has_agents = self._shard.config.population.agents > 0
        self._gathers = False
        worlds = self._shard.worlds
        self.common = common_of(worlds)
        self.count_tick = bind(count_tick, worlds.ticks)
        self.occasions = bind(
            occasions,
            ticks=worlds.ticks,
            ticks_per_s=traffic.ticks_per_s,
            num_through=self._shard.zoned.num_through,
        )

    @property
    def worlds(self) -> Worlds:
        """The rows of the first zone, and the state that all zones share."""
        return self._shard.worlds

    def run(self, commands: Commands, is_first: bool, is_last: bool) -> None:
        """Run begin → components → begin the step → advance … signals → components → sense → end.

        Args:
            commands: the commands of the step.
            is_first: whether this is the first tick of the step.
            is_last: whether this is the last tick of the step, in which agents sense.
        """
        self.coordination.begin(commands)
        for part in self.attached:
            with self.all_rows("begin" in part.reads_all, self.division.side):
                part.begin(commands)
        if is_first:
            self.begin_step(commands)
        self._advance(commands)
        if self.attached:
            self.finish_phase()
        for part in self.attached:
            with self.all_rows("end" in part.reads_all, self.division.side):
                part.end()
        if is_last:
            self.sense(self._everywhere)
        self.finish_phase()
        self.coordination.end()

    def all_rows(self, needed: bool, side: int) -> AbstractContextManager[None]:
        """Return a context in which this process has the vehicles of all zones, if needed."""
        return self.peers.all_zones(self.departures, side) if needed else nullcontext()

    def begin_step(self, commands: Commands) -> None:
        """Clear the sums of the step, and queue the vehicles that the caller inserts."""
        self.executor.begin_step(commands)
        if commands.inserted.size:
            self.traffic.insert(self.departures, self.worlds, commands.inserted)

    def _advance(self, commands: Commands) -> None:
        """Run advance → outside → leave → exchange → resolve → enter → commit → signals."""
        self.executor.advance(commands)
        self.outside.follow(self)
        self.leave()
        if self.coordination.needs_ghosts:
            self.division.exchange()
        else:
            self.division.count_rows()
        self.peers.share_rows(self.departures, self.division.next_side)
        if any(self.departures.num_passing.tolist()):
            self.traffic.settle(self.departures, self.worlds)
        self.executor.resolve()
        if self._gathers:
            self.division.note_gathered()  # other workers may still be resolving contacts
        self._enter()
        self.executor.commit()
        self.count_tick()
        self.outside.switch_signals(self)

    def sense(self, chosen: NDArray[np.bool_]) -> None:
        """Run clear → sense → settle → credit in the chosen worlds (W,)."""
        if not self._has_agents:
            return
        self.shared.clear_outputs(chosen)
        self.executor.sense(chosen)
        self.peers.share_outputs(self.shared.outputs, chosen)
        self.shared.settle_outputs(chosen)
        self.executor.credit(chosen)

    def leave(self) -> None:
        """Choose new goals, let arrived vehicles leave, answer requests for routes."""
        traffic, departures, worlds = self.traffic, self.departures, self.worlds
        begins_second, some_arrived = self.occasions()
        if begins_second:
            self.executor.choose_goals(traffic.demand, len(traffic.plans), departures)
        if some_arrived:
            self.executor.leave(departures)
            if any(departures.num_passing.tolist()):
                self.coordination.left(departures)
                if self.peers.are_none:  # with peers, all zones settle after `share_rows`
                    traffic.settle(departures, worlds)
        if begins_second and traffic.rerouting is not None:
            with (
                self.all_rows(True, self.division.next_side),
                self.division.all_next_rows() as all_zones,
            ):
                traffic.rerouting.act(departures, all_zones)

    def _enter(self) -> None:
        """Add departures that find a gap to `next_rows`."""
        self.outside.let_in(self)
        self.traffic.call_orders(self.departures, self.worlds)
        if any(self.departures.num_queue.tolist()):
            self.let_in()

    def let_in(self) -> None:
        """Run rank → assign → propose and, if any departure has found a gap, accept → admit."""
        traffic, departures, worlds, peers = self.traffic, self.departures, self.worlds, self.peers
        peers.clear_ranks(departures)
        self.executor.rank_lanes(departures)
        peers.share_ranks(departures)
        traffic.assign_lanes(departures, worlds)
        self.executor.propose(traffic.demand, departures)
        peers.share_proposals(departures)
        if any(departures.num_passing.tolist()):
            traffic.accept(departures, worlds, self.outside.running(peers))
            self.admit()

    def admit(self) -> None:
        """Add admitted vehicles to the rows of their zones."""
        self.executor.admit(self.departures)
        self.coordination.entered(self.departures)
        self.departures.num_passing[:] = 0

    def retire_agents(self) -> None:
        """Remove the agents whose trip ended in the last step. Call between two steps."""
        departures = self.departures
        self.executor.retire(departures)
        if any(departures.num_passing.tolist()):
            self.coordination.left(departures)
        self.peers.share_leavers(departures)
        if any(departures.num_passing.tolist()):
            self.executor.forget(departures)
            self.traffic.settle(departures, self.worlds)

    def instrument(self, wrap: Callable[[Any], Any]) -> None:
        """Replace each part that runs phases by `wrap(part)`, to time the phases."""
        self.executor = wrap(self.executor)
        self.division = wrap(self.division)
        self.traffic = wrap(self.traffic)
        self.shared = wrap(self.shared)
        self.coordination = wrap(self.coordination)
        if isinstance(self.outside, SumoPhases):
            self.outside = SumoPhases(wrap(self.outside.sumo), self.outside.callers)

    def trace(self, wrap: Callable[[Executor], Executor], note: Callable[[str], None]) -> None:
        """Report each phase when it begins; see `Simulation.trace`.

        A component with phases of its own has a method `trace`.
        """
        self.executor = wrap(self.executor)
        self.note_phase = note
        for part in self.attached:
            if isinstance(part, Traced):
                part.trace(note)

    def host(
        self,
        # called with the shards, and with the arguments of the phase `gather`
        make: Callable[[Sequence[Shard], tuple[float, float]], TeamExecutor],
    ) -> None:
        """Let the executor that `make` returns run the shards' phases in several processes."""
        team = make(self.shards, self.division.gathering)
        self.executor, self.finish_phase = team, team.finish_phase
        self._gathers = self.division.let_gather(team)


def _no_wait() -> None:
    """Do nothing: one process runs all phases."""


def _ignore(phase: str) -> None:
    """Do nothing: there is no trace."""
