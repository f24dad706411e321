"""Vehicles that the caller poses or drives: their commands and ids, and their part of a tick.

The replayed road users of a logged scene are such vehicles, too. Their slots follow the caller's
slots, and their commands come from a table. The slots of SUMO's persons come last, and SUMO's step
determines their poses.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.compiled import specialized
from cavmarl.core.errors import ActionError
from cavmarl.core.records.codes import DRIVER_EXTERNAL
from cavmarl.core.records.external_records import (
    EXTERNAL,
    EXTERNAL_DRIVEN,
    EXTERNAL_FIELDS,
    EXTERNAL_NONE,
    EXTERNAL_POSED,
    EXTERNAL_REMOVED,
    FIRST_EXTERNAL_ID,
    first_external_id,
)
from cavmarl.driving.kernels.motion.motion import MAX_SPEED_MPS
from cavmarl.driving.vehicles import blank_vehicle
from cavmarl.engine.component import Component, ComponentContext
from cavmarl.engine.outside_traffic import OutsideTraffic
from cavmarl.engine.peers import Peers
from cavmarl.shards.row_check import MOST_IDS, diagonals_m
from cavmarl.shards.shard import Commands
from cavmarl.traffic.kernels.external_rows import add_external, move_external

if TYPE_CHECKING:
    from cavmarl.engine.tick import Tick

_POSE = ("x", "y", "z", "heading", "pitch", "speed")
_CONTROLS = ("throttle", "steering")
LARGEST = 1e12  # limit of all numbers of a command or a vehicle


class ExternalComponent(Component):
    """The slots of the vehicles that the caller poses or drives.

    A slot keeps its last command. All processes of a world have the same slots.

    Attributes:
        ids: (W, E) id of each slot's vehicle; -1: none.
        leaving: (W, E) slots whose vehicles leave in this tick.
        coming: (W, E) slots whose vehicles enter in this tick.
        has_news: whether this is the first tick of a step with new commands.
        first_person: the first slot of SUMO's persons.
    """

    def __init__(self, host: ComponentContext) -> None:
        self._num_told = host.config.population.external
        none = np.zeros((1, 0), dtype=EXTERNAL)
        self._replayed = none if host.replayed is None else host.replayed
        self.first_person = self._num_told + self._replayed.shape[1]
        shape = (host.num_worlds, self.first_person + host.num_persons)
        self._held = host.zeros((*shape, EXTERNAL_FIELDS))
        self.ids: NDArray[np.int64] = host.zeros(shape, dtype=np.int64)
        self.ids[:] = -1
        self.leaving = np.zeros(shape, dtype=np.bool_)
        self.coming = np.zeros(shape, dtype=np.bool_)
        self.has_news = False
        self._told = np.zeros((*shape, EXTERNAL_FIELDS))
        self._ticks = host.shards[0].worlds.ticks
        self._ticks_per_step = host.config.clock.ticks_per_step
        self._types = host.travel.types

    @property
    def held(self) -> NDArray[np.void]:
        """EXTERNAL (W, E): the present command of each slot."""
        return records_of(self._held)

    def reset(self, chosen: NDArray[np.bool_]) -> None:
        """Empty the slots of the chosen worlds (W,), except for road users replayed from tick 0."""
        self._held[chosen] = EXTERNAL_NONE
        self.ids[chosen] = -1
        first, num_slots = self._replayed[0], self.ids.shape[1]
        slots = np.flatnonzero(first["kind"] == EXTERNAL_POSED)
        for w in np.flatnonzero(chosen).tolist():
            self.held[w, self._num_told + slots] = first[slots]
            own = self._num_told + slots
            self.ids[w, own] = first_external_id(self._ticks[w], num_slots) + own

    def begin(self, commands: Commands) -> None:
        """Take the commands of a step in its first tick."""
        self.leaving[:] = self.coming[:] = self.has_news = False
        is_told = commands.external.size or self._replayed.shape[1]
        if not is_told or self._ticks.item(0) % self._ticks_per_step:
            return
        told, held = self._commands_of(commands), self.held
        held["speed"][held["kind"] == EXTERNAL_POSED] = np.nan  # they have reached their poses
        self.has_news = bool(told["kind"].any())
        if not self.has_news:
            return
        is_held = held["kind"] != EXTERNAL_NONE
        is_posed, is_driven = told["kind"] == EXTERNAL_POSED, told["kind"] == EXTERNAL_DRIVEN
        self.coming[:] = (is_posed | is_driven) & ~is_held
        if (told["length"][self.coming] <= 0.0).any():
            w, slot = np.argwhere(self.coming & (told["length"] <= 0.0))[0].tolist()
            raise ActionError(
                f"world {w}, external vehicle {slot}: it does not exist; spawn it first"
            )
        if self.coming.any() and (wrong := wrong_bodies(told[self.coming], self._types)):
            raise ActionError(f"{wrong}; pass commands that `ExternalCommands` has made")
        self.leaving[:] = (told["kind"] == EXTERNAL_REMOVED) & is_held
        held[self.coming] = told[self.coming]
        for changed, names in ((is_posed & is_held, _POSE), (is_driven & is_held, _CONTROLS)):
            for name in ("kind", *names):
                held[name][changed] = told[name][changed]
        held[self.leaving] = np.zeros((), dtype=EXTERNAL)

    def _commands_of(self, commands: Commands) -> NDArray[np.void]:
        """Return EXTERNAL (W, E), the commands of the caller and of the table."""
        self._told[:] = 0.0
        if commands.external.size:
            self._told[:, : self._num_told] = commands.external
        told = records_of(self._told)
        if self._replayed.shape[1]:
            steps = np.minimum(self._ticks // self._ticks_per_step + 1, len(self._replayed) - 1)
            told[:, self._num_told : self.first_person] = self._replayed[steps]
        return told

    def see_people(self, w: int, people: NDArray[np.void], vtype: int) -> None:
        """Take the poses of SUMO's persons in a world, SEEN (p,), after SUMO's step.

        `vtype`: VTYPE row of persons.
        """
        persons = slice(self.first_person, None)
        held = self.held[w, persons]
        is_here = np.zeros(len(held), dtype=np.bool_)
        slots = -1 - people["number"]
        is_here[slots] = True
        was_here = held["kind"] == EXTERNAL_POSED
        self.coming[w, persons], self.leaving[w, persons] = is_here & ~was_here, was_here & ~is_here
        poses = np.zeros(len(people), dtype=EXTERNAL)
        poses["kind"], poses["vtype"] = EXTERNAL_POSED, vtype
        for name in ("x", "y", "z", "speed"):
            poses[name] = people[name]
        poses["heading"] = np.radians(90.0 - people["angle"])
        poses["pitch"] = np.nan
        poses["length"], poses["width"] = people["pos"], people["lat"]
        poses["height"] = self._types["height"][vtype]
        held[...] = np.zeros((), dtype=EXTERNAL)
        held[slots] = poses

    def arrays(self) -> Iterator[NDArray[Any]]:
        """Return the commands and the ids of all slots."""
        return iter((self._held, self.ids))

    def wrong(self, saved: Sequence[NDArray[Any]]) -> str:
        """Return the fault of saved arrays; empty if they are valid."""
        held, ids = records_of(saved[0]), saved[1]
        is_held = held["kind"] != EXTERNAL_NONE
        slots = np.arange(ids.shape[1])
        is_own = (ids >= FIRST_EXTERNAL_ID) & (ids < MOST_IDS)
        is_own &= (ids - FIRST_EXTERNAL_ID) % max(len(slots), 1) == slots
        if (is_own != is_held).any() or (ids[~is_held] != -1).any():
            return "an external vehicle has an invalid id"
        kinds = EXTERNAL_POSED, EXTERNAL_DRIVEN
        held = held[is_held]
        return wrong_commands(held, kinds) or wrong_bodies(held, self._types)

    def wrong_rows(self, ids: NDArray[np.int64], rows: NDArray[np.void], is_whole: bool) -> str:
        """Return what is wrong with the ids (E,) of a world's slots and rows VEHICLE (n,).

        `is_whole`: whether these are the rows of all zones, which contain each slot's vehicle.
        """
        rows = rows[rows["driver"] == DRIVER_EXTERNAL]
        slots = rows["order"]
        lacks = is_whole and len(rows) != np.count_nonzero(ids >= 0)
        if lacks or len(np.unique(slots)) < len(slots) or (ids[slots] != rows["id"]).any():
            return "external vehicles and their slots do not match"
        return ""


class ExternalPhases(OutsideTraffic):
    """The phases of a tick in worlds with vehicles that the caller poses or drives."""

    def __init__(self, part: ExternalComponent, tick: Tick) -> None:
        self._part = part
        self._taken = np.zeros(len(part.ids), dtype=np.int64)
        self._move_external = specialized(move_external)
        self._add_external = specialized(add_external)
        self._blank = blank_vehicle()
        self._roads, self._grid = tick.shards[0].roads, tick.shards[0].lane_grid
        config = tick.shards[0].config
        self._dt, self._ticks_per_step = config.clock.sim_dt_s, config.clock.ticks_per_step
        self._limits = config.action.acceleration_mps2, config.action.steering_rad

    def follow(self, tick: Tick) -> None:
        """Move the vehicles. Removed vehicles leave; vehicles with a far new pose re-enter."""
        part = self._part
        # A pose that is farther than any vehicle drives in a step is a jump.
        reach_m = MAX_SPEED_MPS * self._dt * self._ticks_per_step if part.has_news else math.inf
        gone = self._move(tick, (0, part.first_person), self._ticks_per_step, reach_m)
        if part.has_news:
            self._dismiss(tick, gone)

    def mirror_people(self, tick: Tick, people: Sequence[NDArray[np.void]]) -> None:
        """Move SUMO's persons to their places after SUMO's step; `people`: SEEN of each world."""
        part, end = self._part, self._part.ids.shape[1]
        if part.first_person == end:
            return
        vtype = tick.traffic.type_rows["pedestrian"]
        for w, seen in enumerate(people):
            part.see_people(w, seen, vtype)
        self._dismiss(tick, self._move(tick, (part.first_person, end), 1, math.inf))

    def _move(self, tick: Tick, slots: tuple[int, int], ticks_per_step: int, reach_m: float) -> int:
        """Move the vehicles of the slots [first, end); return how many leave."""
        gone: int = self._move_external(
            self._roads,
            tick.traffic.travel,
            self._grid,
            self._part.held,
            self._part.leaving,
            *slots,
            tick.division.zoned,
            tick.division.next_side,
            tick.worlds.ticks,
            ticks_per_step,
            reach_m,
            *self._limits,
            self._dt,
        )
        return gone

    def _dismiss(self, tick: Tick, gone: int) -> None:
        """Remove the vehicles that leave. `gone`: their number in this process."""
        part, departures = self._part, tick.departures
        if gone:
            tick.executor.dismiss(departures)
            tick.coordination.left(departures)
        tick.peers.share_leavers(departures)
        for w, num in enumerate(departures.num_passing.tolist()):
            slots = departures.passing["order"][w, :num]
            part.ids[w, slots] = -1
            part.coming[w, slots] = ~part.leaving[w, slots]
        departures.num_passing[:] = 0  # these vehicles have made no trips

    def let_in(self, tick: Tick) -> None:
        """Add the vehicles that enter."""
        part = self._part
        tick.finish_phase()
        self._taken[:] = tick.peers.running() + np.count_nonzero(part.ids < 0, axis=1)
        if not part.coming.any():
            return
        self._add_external(
            self._roads,
            self._grid,
            part.held,
            part.coming,
            part.ids,
            self._blank,
            tick.traffic.nowhere,
            tick.departures,
            tick.worlds.ticks,
            tick.worlds.keys,
        )
        tick.admit()

    def running(self, peers: Peers) -> NDArray[np.int64]:
        """Return the number (W,) of places that vehicles take or that are reserved for slots."""
        return self._taken


def records_of(commands: NDArray[np.float64]) -> NDArray[np.void]:
    """Return commands (W, E, K) as EXTERNAL (W, E), a view."""
    return commands.view(EXTERNAL)[..., 0]


def wrong_commands(told: NDArray[np.void], kinds: Sequence[float]) -> str:
    """Return what is wrong with the kinds and the numbers of commands EXTERNAL (n,)."""
    if not np.isin(told["kind"], kinds).all():
        return "a command to an external vehicle has an unknown kind"
    for name in EXTERNAL.names or ():
        usual = np.abs(told[name]) <= LARGEST
        if name in ("z", "pitch", "speed"):
            usual |= np.isnan(told[name])
        if not usual.all():
            return f"an external vehicle has an invalid {name}"
    return ""


def wrong_bodies(told: NDArray[np.void], types: NDArray[np.void]) -> str:
    """Return what is wrong with the types and the sizes of commands EXTERNAL (n,)."""
    if not np.isin(told["vtype"], np.arange(len(types))).all():
        return "an external vehicle has an unknown type"
    most_m = float(diagonals_m(types).max())
    sizes = np.stack([told["length"], told["width"], told["height"]])
    wrong = (sizes <= 0.0).any(axis=0) | (told["height"] > types["height"].max())
    if (wrong | (diagonals_m(told) > most_m)).any():
        return "an external vehicle is larger than all types, or has no size"
    return ""
