"""`ShardGroup`: the shards of one process, which runs each phase of a tick on all of them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.compiled import specialized
from cavmarl.core.records.arrays import Demand, Gate
from cavmarl.core.records.codes import INSERT_OPEN
from cavmarl.shards.kernels.group_phases import (
    FRAME,
    Members,
    admit_each,
    advance_each,
    begin_step_each,
    choose_goals_each,
    credit_each,
    detect_each,
    drive_on_each,
    forget_each,
    gather_each,
    propose_each,
    rank_lanes_each,
    resolve_each,
    retire_each,
    sense_each,
)
from cavmarl.shards.shard import TICKS_IN_ORDER, Commands, Shard, common_of


class ShardGroup:
    """Runs the phases of some shards, whichever they are: one, those of a worker, or all.

    Phases that every tick has are one call for all shards, with what does not change put together
    once. Others, and those which have nothing to do in most ticks, go from shard to shard.
    """

    def __init__(
        self,
        shards: Sequence[Shard],  # of one process, by rising zones; they share clock and scratch
    ) -> None:
        self._shards = tuple(shards)
        first = shards[0]
        self._first = first
        self._config = first.config
        self._roads = first.roads
        self._travel = first.travel
        self._scratch = first.scratch
        grids = [shard.grid for shard in shards]
        largest = max(grids, key=lambda grid: grid.newest.size)
        self._grid = largest._replace(corner=largest.corner.copy())
        frames = [
            (*grid.corner.tolist(), grid.cells_per_m, grid.num_x, grid.num_y) for grid in grids
        ]
        self._members = Members(
            numbers=np.array([shard.zone for shard in shards]),
            frames=np.array(frames, dtype=FRAME),
            zones=first.zones,
            halo=first.halo,
            zoned=first.zoned,
            common=common_of(first.worlds),
        )
        self._controls = np.zeros_like(first.worlds.pending[:, :, 0])
        self._advance = specialized(advance_each)
        self._gather = specialized(gather_each)
        self._resolve = specialized(resolve_each)
        self._choose_goals = specialized(choose_goals_each)
        self._rank_lanes = specialized(rank_lanes_each)
        self._propose = specialized(propose_each)
        self._admit = specialized(admit_each)
        self._meta_actions = np.zeros(self._controls.shape[:2], dtype=np.int64)
        self._begin_step = specialized(begin_step_each)
        self._drive_on = specialized(drive_on_each)
        self._detect = specialized(detect_each)
        self._sense = specialized(sense_each)
        self._credit = specialized(credit_each)
        self._retire = specialized(retire_each)
        self._forget = specialized(forget_each)

    @property
    def sides(self) -> tuple[int, int]:
        """Where the rows are, and the next ones."""
        return self._first.side, self._first.next_side

    def each(self, phase: str, *arguments: Any) -> None:
        """Run a phase on every shard: a method of this class or of `Shard`, by its name."""
        together = getattr(self, phase, None)
        if together is not None:
            together(*arguments)
            return
        for shard in self._shards:
            getattr(shard, phase)(*arguments)

    def begin_step(self, commands: Commands) -> None:
        """Open the accounts of a step, take its meta-actions, let barriers drive on."""
        first, inserted = self._first, commands.inserted
        if inserted.size and (inserted[..., 0] == INSERT_OPEN).any():
            first_stop = len(self._travel.stops) - len(self._roads.lanes)
            self._drive_on(self._members, first.side, np.array(inserted), first_stop)
        if self._config.population.agents == 0:
            return
        np.copyto(self._meta_actions, commands.meta_actions)
        self._begin_step(
            self._members, first.side, self._roads,
            first.discrete, self._meta_actions, first.target_speeds,
        )  # fmt: skip

    def advance(self, commands: Commands) -> None:
        """Decide every control from the committed rows and move the owned ones into next ones."""
        self.turn()
        self.move(commands)

    def turn(self) -> None:
        """Let the next rows be on the other side, in a tick that puts rows in order."""
        if self._first.worlds.ticks[0] % TICKS_IN_ORDER == 0:
            for shard in self._shards:
                shard.turn()

    def face(self, side: int, next_side: int) -> None:
        if self.sides != (side, next_side):
            for shard in self._shards:
                shard.face(side, next_side)

    def move(self, commands: Commands) -> None:
        """`advance`, where the rows' sides are known."""
        first, action = self._first, self._config.action
        if self._controls.size:
            np.copyto(self._controls, commands.controls)
        self._advance(
            self._members,
            first.side,
            first.next_side,
            self._roads,
            first.plans,
            self._travel,
            first.lane_grid,
            self._scratch,
            self._controls,
            action.kind == "discrete",
            action.acceleration_mps2,
            action.steering_rad,
            self._config.clock.sim_dt_s,
        )

    def gather(self, touching_m: float, border_m: float) -> None:
        """Renew the ghosts of the next rows, as `kernels.exchange.gather` says."""
        self._gather(self._members, self._first.next_side, touching_m, border_m)

    def resolve(self) -> None:
        first = self._first
        self._resolve(self._members, first.side, first.next_side, self._scratch, self._grid)

    def choose_goals(self, demand: Demand, num_goals: int, gate: Gate) -> None:
        """Give the vehicles of the next rows that need it another goal."""
        first, dt = self._first, self._config.clock.sim_dt_s
        self._choose_goals(
            self._members, first.side, first.next_side,
            demand, self._roads, self._travel, num_goals, gate, dt,
        )  # fmt: skip

    def leave(self, gate: Gate) -> None:
        """Hand the background vehicles of the next rows that have arrived to the gate."""
        if not any(map(any, self._first.zoned.num_through.tolist())):
            return
        for shard in self._shards:
            shard.leave(gate)

    def rank_lanes(self, gate: Gate) -> None:
        """Count vehicles around the places of these zones where departures may enter."""
        first = self._first
        self._rank_lanes(
            self._members, first.side, first.next_side,
            self._roads, self._travel, gate, self._scratch,
        )  # fmt: skip

    def propose(self, demand: Demand, gate: Gate) -> None:
        """Tell the gate which departures find a safe gap in these zones."""
        first = self._first
        self._propose(
            self._members, first.side, first.next_side,
            demand, self._roads, self._travel, gate, self._scratch,
        )  # fmt: skip

    def admit(self, gate: Gate) -> None:
        """Take in departures that the gate has accepted, as owned or as ghosts."""
        first = self._first
        self._admit(self._members, first.side, first.next_side, gate)

    def commit(self) -> None:
        if self._first.next_side != self._first.side:
            for shard in self._shards:
                shard.commit()

    def detect(self) -> None:
        """Note when owned bodies were over the detectors of actuated signals."""
        if self._first.worlds.controllers.shape[1] == 0:
            return
        self._detect(self._members, self._first.side, self._roads, self._config.clock.sim_dt_s)

    def sense(self, chosen: NDArray[np.bool_]) -> None:
        """Write observations and terms of the chosen worlds' owned agents into the outputs."""
        first, clock = self._first, self._config.clock
        self._sense(
            self._members, first.side, self._roads, first.plans, self._travel, self._grid,
            first.sensors, clock.sim_dt_s, clock.ticks_per_step, chosen, first.outputs,
        )  # fmt: skip
        for shard in self._shards:
            shard.complete_observations(chosen)

    def credit(self, chosen: NDArray[np.bool_]) -> None:
        """Add the step's rewards to the episode's of the chosen worlds' owned agents."""
        first = self._first
        self._credit(self._members, first.side, first.outputs.rewards, chosen)

    def retire(self, gate: Gate) -> None:
        """Hand the agents' vehicles of the committed rows whose trip has ended to the gate."""
        ticks = self._config.clock.ticks_per_step
        self._retire(self._members, self._first.side, gate, ticks)

    def forget(self, gate: Gate) -> None:
        """Drop the ghosts of vehicles that have been retired."""
        self._forget(self._members, self._first.side, gate)
