"""`Tick` runs one tick of W worlds, phase by phase. The order is written here, once."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.compiled import specialized
from cavmarl.core.math.tallies import count_tick, occasions
from cavmarl.core.records.arrays import Gate
from cavmarl.engine.component import Attached
from cavmarl.engine.peers import Peers
from cavmarl.engine.shared_outputs import SharedOutputs
from cavmarl.engine.step_trace import MIRROR, SUMO, Traced
from cavmarl.handoff.coordinator.coordinators import Coordination
from cavmarl.handoff.division import Division
from cavmarl.shards.executor import Executor, SerialExecutor, Together
from cavmarl.shards.shard import Commands, Shard
from cavmarl.traffic.native import NativeTraffic
from cavmarl.traffic.sumo.sumo_traffic import SumoTraffic


class Tick:
    """The phases of a tick in their order, and the parts whose calls they are.

    Attributes:
        executor: runs the phases of the shards, wherever they are hosted.
    """

    def __init__(
        self,
        shards: Sequence[Shard],  # one a zone
        division: Division,  # of all shards
        traffic: NativeTraffic,  # what comes
        shared: SharedOutputs,  # what all shards share
        gate: Gate,  # through which vehicles come and go
        attached: tuple[Attached, ...],  # what acts in each tick beside the traffic
    ) -> None:
        self.shards = shards
        self.division = division
        self.traffic = traffic
        self.shared = shared
        self.gate = gate  # through which vehicles come and go; a reset may replace it
        self.attached = attached
        self.executor: Executor = SerialExecutor(shards)
        self.coordination: Coordination | None = None  # decides ownership; None: all is one zone
        self.sumo: SumoTraffic | None = None  # beside these worlds; None: there is none
        self.peers: Peers | None = None  # hold the other zones; None: all are in this process
        self._shard = shards[0]
        self._is_undivided = len(shards) == 1
        self._everywhere = np.ones(len(self._shard.worlds.ticks), dtype=np.bool_)
        self._has_agents = self._shard.config.population.agents > 0
        self._meet: Callable[[], None] = _there
        self._gathers = False
        self._note_phase: Callable[[str], None] = _pass_over
        self._count_tick = specialized(count_tick)
        self._occasions = specialized(occasions)

    def run(self, commands: Commands, is_first: bool, is_last: bool) -> None:
        """Begin → attached → begin the step → advance … signals → attached → sense → end."""
        if self.coordination is not None:
            self.coordination.begin(commands)
        for part in self.attached:
            with self._all_rows("begin" in part.reads_all, self.division.side):
                part.begin(commands)
        if is_first:
            self.executor.each("begin_step", commands)
            if commands.inserted.size:
                self.traffic.insert(self.gate, self._shard.worlds, commands.inserted)
        self._advance(commands)
        if self.attached:
            self._meet()
        for part in self.attached:
            with self._all_rows("end" in part.reads_all, self.division.side):
                part.end()
        if is_last:
            self.sense(self._everywhere)
        self._meet()
        if self.coordination is not None:
            self.coordination.end()

    def _all_rows(self, needed: bool, side: int) -> AbstractContextManager[None]:
        """The time in which the vehicles of all zones are in this process, if that is needed."""
        if self.peers is None or not needed:
            return nullcontext()
        return self.peers.everybody(self.gate, side)

    def _advance(self, commands: Commands) -> None:
        """Advance → leave → exchange → resolve → enter → commit → signals."""
        self.executor.each("advance", commands)
        if self.sumo is not None:
            self._follow_sumo(self.sumo)
        self.leave()
        if self._is_undivided and self.coordination is None:
            self.division.count_rows()
        else:
            self.division.exchange()
        if self.peers is not None:
            self.peers.share_rows(self.gate, self.division.next_side)
            if any(self.gate.num_passing.tolist()):
                self.traffic.settle(self.gate, self._shard.worlds)
        self.executor.each("resolve")
        if self._gathers:
            self.division.note_gathered()  # others may still be about their contacts
        self._enter()
        self.executor.each("commit")
        self._count_tick(self._shard.worlds.ticks)
        self.switch_signals()

    def _follow_sumo(self, sumo: SumoTraffic) -> None:
        """SUMO takes its step; its own vehicles stand where they are then, or leave."""
        gate, worlds, side = self.gate, self._shard.worlds, self.division.next_side
        self._note_phase(SUMO)
        with self._all_rows(True, side):
            sumo.step(worlds, side)
            if not sumo.drives:
                sumo.send_on(gate, worlds, side)
                return
        self._note_phase(MIRROR)
        if sumo.mirror(worlds, side):
            for shard in self.shards:
                shard.dismiss(gate)
            self._note_left()
            sumo.forgive(gate)
        if self.peers is not None:
            self.peers.share_leavers(gate)
        if any(gate.num_passing.tolist()):
            self.traffic.settle(gate, worlds)

    def switch_signals(self) -> None:
        if self.sumo is not None:
            self.sumo.show(self._shard.worlds)
            return
        self.executor.each("detect")
        if self.peers is not None:
            self.peers.share_detections(self._shard.worlds)
        self.shared.switch_signals(self._shard.worlds)

    def sense(self, chosen: NDArray[np.bool_]) -> None:
        """Clear → sense → settle → credit, in the chosen worlds (W,)."""
        if not self._has_agents:
            return
        self.shared.clear_outputs(chosen)
        self.executor.each("sense", chosen)
        if self.peers is not None:
            self.peers.share_outputs(self.shared.outputs, chosen)
        self.shared.settle_outputs(chosen)
        self.executor.each("credit", chosen)

    def leave(self) -> None:
        """Pick new goals, let arrived vehicles leave, answer requests for ways."""
        traffic, gate, worlds = self.traffic, self.gate, self._shard.worlds
        begins_second, some_arrived = self._occasions(
            worlds.ticks, traffic.ticks_per_s, self._shard.zoned.num_through
        )
        if begins_second:
            self.executor.each("choose_goals", traffic.demand, len(traffic.plans), gate)
        if some_arrived:
            self.executor.each("leave", gate)
            if any(gate.num_passing.tolist()):
                self._note_left()
                if self.peers is None:  # else those of all zones settle together, a little later
                    traffic.settle(gate, worlds)
        if begins_second and traffic.rerouting is not None:
            with (
                self._all_rows(True, self.division.next_side),
                self.division.everybody_next() as everybody,
            ):
                traffic.rerouting.act(gate, everybody)

    def _note_left(self) -> None:
        if self.coordination is not None:
            self.coordination.left(self.gate)

    def _enter(self) -> None:
        """Waiting departures that find a gap enter `next_rows`."""
        traffic, gate, worlds = self.traffic, self.gate, self._shard.worlds
        if self.sumo is not None:
            self._meet()
            if not self.sumo.drives:
                self.sumo.order(gate, worlds)
            elif self.sumo.let_in(gate, worlds, self._running()):
                self._admit()
        traffic.call_orders(gate, worlds)
        if any(gate.num_queue.tolist()):
            self.let_in(all_phases=False)

    def let_in(self, all_phases: bool) -> None:
        """Rank → assign → propose, and if any departure has found a gap, accept → admit."""
        traffic, gate, worlds, peers = self.traffic, self.gate, self._shard.worlds, self.peers
        if peers is not None:
            peers.clear_ranks(gate)
        self.executor.each("rank_lanes", gate)
        if peers is not None:
            peers.share_ranks(gate)
        traffic.assign_lanes(gate, worlds)
        self.executor.each("propose", traffic.demand, gate)
        if peers is not None:
            peers.share_proposals(gate)
        if not (all_phases or any(gate.num_passing.tolist())):
            return
        traffic.accept(gate, self._running())
        self._admit()

    def _running(self) -> NDArray[np.int64]:
        """(W,) vehicles of each world, in all zones."""
        return self.division.running() if self.peers is None else self.peers.running()

    def _admit(self) -> None:
        """Admitted vehicles become rows of the zones that they are in."""
        self.executor.each("admit", self.gate)
        if self.coordination is not None:
            self.coordination.entered(self.gate)
        self.gate.num_passing[:] = 0

    def retire_agents(self) -> None:
        """Between two steps: take out the agents whose trip ended in the last one."""
        gate = self.gate
        self.executor.each("retire", gate)
        if any(gate.num_passing.tolist()):
            self._note_left()
        if self.peers is not None:
            self.peers.share_leavers(gate)
        if any(gate.num_passing.tolist()):
            self.executor.each("forget", gate)
            self.traffic.settle(gate, self._shard.worlds)

    def instrument(self, wrap: Callable[[Any], Any]) -> None:
        """Put `wrap(part)` in the place of each part that phases are calls of, to time them."""
        self.executor = wrap(self.executor)
        self.division = wrap(self.division)
        self.traffic = wrap(self.traffic)
        self.shared = wrap(self.shared)
        if self.coordination is not None:
            self.coordination = wrap(self.coordination)
        if self.sumo is not None:
            self.sumo = wrap(self.sumo)

    def trace(self, wrap: Callable[[Any], Any], note: Callable[[str], None]) -> None:
        """Let `wrap(executor)` note the phases, and attached parts name theirs to `note`.

        A part that has phases of its own (another simulator's step, say) has a method `trace`.
        """
        self.executor = wrap(self.executor)
        self._note_phase = note
        for part in self.attached:
            if isinstance(part, Traced):
                part.trace(note)

    def host(
        self,
        # called with the shards, and with what the phase `gather` is called with
        make: Callable[[Sequence[Shard], tuple[float, float]], Together],
    ) -> None:
        """From now on let others run the phases of the shards, as `make` returns them."""
        team = make(self.shards, self.division.gathering)
        self.executor, self._meet = team, team.meet
        self._gathers = self.division.let_gather(team)


def _there() -> None:
    """There is no wait where one process runs all phases."""


def _pass_over(phase: str) -> None:
    """Ignore the name of a phase, where there is no trace."""
