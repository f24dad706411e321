"""`ShardGroup`: an executor that runs each phase of a tick on some shards of one process."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.compiled.bound_call import BoundCall, bind_by_name, bound, keep_last
from cavmarl.core.records.arrays import Demand, DepartureQueue
from cavmarl.shards.kernels import group_phases
from cavmarl.shards.kernels.zone_loop import FRAME, Members
from cavmarl.shards.learned_drivers import check_commands
from cavmarl.shards.shard import TICKS_IN_ORDER, Commands, Shard, common_of


class ShardGroup:
    """An executor of one shard, the shards of a worker, or all shards.

    Each phase is one kernel call for all shards. Its arguments are bound at the first call.
    """

    def __init__(
        self,
        shards: Sequence[Shard],  # shards of one process, by zones; they share clock and scratch
    ) -> None:
        self.shards = tuple(shards)
        self.first = shards[0]
        self.calls = GroupCalls(self.shards)
        # A reset may replace the departure queue.
        self.departure_calls = keep_last(lambda departures: DepartureCalls(self.calls, departures))

    @property
    def sides(self) -> tuple[int, int]:
        """The buffers of the committed and of the next rows."""
        return self.first.side, self.first.next_side

    def begin_step(self, commands: Commands) -> None:
        """Clear the sums of a step, take its actions, and let networks choose their commands.

        Raises PolicyError: a network gives NaN.
        """
        if self.calls.has_agents:
            np.copyto(self.calls.meta_actions, commands.meta_actions)
            self.calls.begin_step()
        for drive in self.calls.drive_by_networks:
            drive()
        check_commands(self.first.learned, self.first.config.traffic)

    def advance(self, commands: Commands) -> None:
        """Decide all controls from the committed rows, and move owned rows into the next rows."""
        self.turn()
        self.move(commands)

    def turn(self) -> None:
        """In a tick that sorts rows by lane, choose the other buffer for the next rows."""
        if self.first.worlds.ticks[0] % TICKS_IN_ORDER == 0:
            self.set_sides(self.first.side, 1 - self.first.side)

    def set_sides(self, side: int, next_side: int) -> None:
        """Set the buffers of the committed and of the next rows."""
        if self.sides != (side, next_side):
            for shard in self.shards:
                shard.set_sides(side, next_side)

    def move(self, commands: Commands) -> None:
        """Run `advance` without `turn`."""
        if self.calls.has_agents:
            np.copyto(self.calls.controls, commands.controls)
        self.calls.advance()

    def choose_goals(self, demand: Demand, num_goals: int, departures: DepartureQueue) -> None:
        """Give new goals to vehicles of the next rows that need one."""
        self.departure_calls(departures).choose_goals(demand, num_goals)()

    def leave(self, departures: DepartureQueue) -> None:
        """Move arrived background vehicles of the next rows to the departure queue."""
        self.departure_calls(departures).leave()

    def dismiss(self, departures: DepartureQueue) -> None:
        """Move vehicles of the next rows to the departure queue.

        These are the vehicles that SUMO or the caller removes.
        """
        self.departure_calls(departures).dismiss()

    def gather(self, touching_m: float, border_m: float) -> None:
        """Renew the ghosts of the next rows; see `zones.kernels.ghost_exchange.gather`."""
        self.calls.gather(touching_m, border_m)()

    def resolve(self) -> None:
        """Mark contacts between vehicles in the next rows."""
        self.calls.resolve()

    def rank_lanes(self, departures: DepartureQueue) -> None:
        """Count vehicles around the places in these zones where departures may enter."""
        self.departure_calls(departures).rank_lanes()

    def propose(self, demand: Demand, departures: DepartureQueue) -> None:
        """Report to the departure queue which departures find a safe gap in these zones."""
        self.departure_calls(departures).propose(demand)()

    def admit(self, departures: DepartureQueue) -> None:
        """Add departures that the departure queue has accepted, as owned rows or ghosts."""
        self.departure_calls(departures).admit()

    def commit(self) -> None:
        """Make the next rows the committed rows."""
        self.set_sides(self.first.next_side, self.first.next_side)

    def detect(self) -> None:
        """Record when owned vehicles cover the detectors of actuated signals."""
        if self.calls.has_detectors:
            self.calls.detect()

    def sense(self, chosen: NDArray[np.bool_]) -> None:
        """Write observations and terms of owned agents in the chosen worlds to the outputs."""
        calls = self.calls
        np.copyto(calls.chosen, chosen)
        calls.sense()
        if calls.has_optional:
            calls.observe_optional()
        if calls.has_messages:
            calls.observe_messages()
        for shard in self.shards:
            shard.registered.write(shard.worlds, chosen, shard.outputs)
        if calls.stacks:
            calls.fill_stacks()

    def credit(self, chosen: NDArray[np.bool_]) -> None:
        """Add the step's rewards to the episode returns of owned agents in the chosen worlds."""
        np.copyto(self.calls.chosen, chosen)
        self.calls.credit()

    def suggest(self, out: NDArray[np.float64]) -> None:
        """Write the actions that the built-in driver would take for agents to `out` (W, A, 2)."""
        for shard in self.shards:
            shard.suggest(out)

    def retire(self, departures: DepartureQueue) -> None:
        """Move the vehicles of agents whose trip has ended to the departure queue."""
        self.departure_calls(departures).retire()

    def forget(self, departures: DepartureQueue) -> None:
        """Drop the ghosts of vehicles that `retire` has removed."""
        self.departure_calls(departures).forget()


class GroupCalls:
    """The kernel calls of a group, each with its arguments.

    Attributes:
        controls: (W, A, 2) input of `advance`.
        meta_actions: (W, A) input of `begin_step`.
        chosen: (W,) input of `sense` and `credit`.
    """

    def __init__(self, shards: Sequence[Shard]) -> None:
        first = self._first = shards[0]
        config = self._config = first.config
        grids = [shard.grid for shard in shards]
        largest = max(grids, key=lambda grid: grid.newest.size)
        frames = [
            (*grid.corner.tolist(), grid.cells_per_m, grid.num_x, grid.num_y) for grid in grids
        ]
        self.members = Members(
            numbers=np.array([shard.zone for shard in shards]),
            frames=np.array(frames, dtype=FRAME),
            sides=first.row_sides,
            zones=first.zones,
            halo=first.halo,
            zoned=first.zoned,
            common=common_of(first.worlds),
            grid=largest._replace(corner=largest.corner.copy()),
        )
        self.controls = np.zeros_like(first.worlds.pending[:, :, 0])
        self.meta_actions = np.zeros(self.controls.shape[:2], dtype=np.int64)
        self.chosen = np.ones(len(self.controls), dtype=np.bool_)
        self.has_agents = config.population.agents > 0
        self.has_detectors = first.worlds.controllers.shape[1] > 0
        self.has_optional = first.optional is not None
        self.stacks = config.sensors.stack > 1
        self.gather = keep_last(self._bind_gather)

    @property
    def has_messages(self) -> bool:
        """Whether agents observe the messages that they receive."""
        return self._first.mail is not None and self._first.messages_at is not None

    @property
    def has_registered(self) -> bool:
        """Whether there are sensors or terms from outside of the package."""
        return not self._first.registered.is_empty

    @property
    def values(self) -> dict[str, Any]:
        """The arguments of the kernels by the names of their parameters."""
        first, action, clock = self._first, self._config.action, self._config.clock
        return {
            "members": self.members,
            "roads": first.roads,
            "plans": first.plans,
            "travel": first.travel,
            "lane_grid": first.lane_grid,
            "scratch": first.scratch,
            "sensors": first.sensors,
            "optional": first.optional,
            "objects": first.no_reports if first.mail is None else first.mail.objects,
            "outputs": first.outputs,
            "observations": first.outputs.observations,
            "rewards": first.outputs.rewards,
            "lane_place": first.roads.lane_place,
            "places": first.roads.places,
            "commands": self.controls,
            "meta_actions": self.meta_actions,
            "chosen": self.chosen,
            "discrete": first.discrete,
            "target_speeds": first.target_speeds,
            "accel_limit": action.acceleration_mps2,
            "steering_limit": action.steering_rad,
            "dt": clock.sim_dt_s,
            "tick_s": clock.sim_dt_s,
            "ticks_per_step": clock.ticks_per_step,
            "ticks_in_order": TICKS_IN_ORDER,
            "stack": self._config.sensors.stack,
        }

    begin_step = bound(group_phases.begin_step_each)
    turn = bound(group_phases.turn)
    advance = bound(group_phases.advance_each)
    resolve = bound(group_phases.resolve_each)
    commit = bound(group_phases.commit)
    detect = bound(group_phases.detect_each)
    sense = bound(group_phases.sense_each)
    observe_optional = bound(group_phases.observe_optional_each)
    fill_stacks = bound(group_phases.fill_stacks_each)
    credit = bound(group_phases.credit_each)

    def _bind_gather(self, touching_m: float, border_m: float) -> BoundCall[None]:
        own = {"members": self.members, "touching_m": touching_m, "border_m": border_m}
        return bind_by_name(group_phases.gather_ghosts_each, own)

    @cached_property
    def drive_by_networks(self) -> tuple[BoundCall[None], ...]:
        """One call for each network that drives background vehicles."""
        return tuple(
            bind_by_name(group_phases.drive_by_network_each, self.values | {"learned": learned})
            for learned in self._first.learned
        )

    @cached_property
    def observe_messages(self) -> BoundCall[None]:
        first, messages = self._first, self._config.sensors.messages
        assert first.messages_at is not None
        own = {
            "mail": first.mail,
            "at": first.messages_at.start,
            "objects": messages.objects,
            "events": messages.events,
            "signal": messages.signal,
            "timing": messages.timing,
            "scale_m": messages.range_m,
        }
        return bind_by_name(group_phases.observe_messages_each, self.values | own)


class DepartureCalls:
    """The kernel calls of a group that need the departure queue."""

    def __init__(self, calls: GroupCalls, departures: DepartureQueue) -> None:
        self._calls = calls
        self._departures = departures
        self.choose_goals = keep_last(self._bind_choose_goals)
        self.propose = keep_last(self._bind_propose)

    @property
    def values(self) -> dict[str, Any]:
        """The arguments of the kernels by the names of their parameters."""
        return {**self._calls.values, "departures": self._departures}

    leave = bound(group_phases.leave_background_each)
    dismiss = bound(group_phases.dismiss_each)
    rank_lanes = bound(group_phases.rank_lanes_each)
    admit = bound(group_phases.admit_each)
    retire = bound(group_phases.retire_each)
    forget = bound(group_phases.forget_each)

    def _bind_choose_goals(self, demand: Demand, num_goals: int) -> BoundCall[None]:
        own = {"demand": demand, "num_goals": num_goals}
        return bind_by_name(group_phases.choose_goals_each, self.values | own)

    def _bind_propose(self, demand: Demand) -> BoundCall[None]:
        return bind_by_name(group_phases.propose_each, self.values | {"demand": demand})
