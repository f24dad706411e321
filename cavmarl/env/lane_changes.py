"""`LaneChanges`: roads that the caller closes, slows down or reverses, from the next step on."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cavmarl.config.env import EnvConfig
from cavmarl.config.road_events import RoadEvent
from cavmarl.core.errors import ActionError, CapacityError, ConfigError
from cavmarl.core.records.changed_lanes import CHANGED, CLASSES, LIMIT_MPS, wrong_changes
from cavmarl.driving.vehicle_types import ALL_PERMISSIONS
from cavmarl.engine.world_views import WorldViews
from cavmarl.env.reversed_roads import (
    AS_ON_MAP,
    CLEARING,
    QUEUED,
    RETURNING,
    REVERSED_NOW,
    ReversedRoads,
)
from cavmarl.roads.contraflow_ids import contraflow_of, is_contraflow
from cavmarl.roads.network import RoadNetwork
from cavmarl.roads.ways_out import shut_in_roads
from cavmarl.shards.shard import Commands

# kinds of frame events
CLOSED, OPENED, DAMAGED, REVERSED = "closed", "opened", "damaged", "reversed"

Asked = tuple[tuple[str, str], ...]


class LaneChanges:
    """The lanes that differ from the map: at most N = `map.changed_lanes` in each of W worlds.

    The changes stay until they are undone, or until the world is reset. The events of `map.events`
    apply to all worlds.

    Args:
        config: configuration of the worlds.
        network: map of the worlds.
        num_worlds: number of worlds, W.
        present: returns the worlds as they are now.

    Raises:
        ConfigError: an event of `map.events` is impossible on this map.
    """

    def __init__(
        self,
        config: EnvConfig,
        network: RoadNetwork,
        num_worlds: int,
        present: Callable[[], WorldViews],
    ) -> None:
        self._most = config.map.changed_lanes
        self._network = network
        self._present = present
        self._edges = {name: row for row, name in enumerate(network.edge_ids)} if self._most else {}
        self._told = np.zeros((num_worlds, self._most, 3))  # `Commands.lane_changes`
        self._waiting: list[Asked] = [()] * num_worlds  # changes for the next step
        self._last: list[Asked] = [()] * num_worlds  # changes of the last step
        self._reversed = ReversedRoads(config, network, num_worlds)
        self._clock = config.clock
        self._events = config.map.events
        self._check_events()

    @property
    def memory(self) -> tuple[NDArray[Any], ...]:
        """The changes that apply from the next step on, and the states of reversed roads."""
        return self._told, self._reversed.states

    @memory.setter
    def memory(self, memory: tuple[NDArray[Any], ...]) -> None:
        self._told[:], self._reversed.states[:] = memory

    def wrong(self, memory: Sequence[NDArray[Any]]) -> str:
        """Return what is wrong with a loaded `memory`; empty if it is valid."""
        told, states = memory
        return wrong_changes(told, self._network.lanes) or self._reversed.wrong(states, told)

    def close(
        self,
        world: int,
        edge: str,
        lanes: Sequence[int] | None = None,
        classes: int = ALL_PERMISSIONS,
        shuts_in: bool = False,
    ) -> None:
        """Close lanes of a road.

        Args:
            world: number of the world.
            edge: id of the road.
            lanes: indices of the lanes, from the kerb; None: all lanes.
            classes: bits of the vehicle classes that may not use them.
            shuts_in: whether to close the road even if it is the last way out of other roads.

        Raises:
            ActionError: there is no such world, road or lane; or the road is the last way out.
            CapacityError: the world already has as many changed lanes as are allowed.
            ConfigError: `map.changed_lanes` is 0.
        """
        rows = self._rows(world, edge, lanes)
        limit_mps, closed = self._now(world)
        closed[rows] |= np.uint32(classes)
        if not shuts_in:
            self._refuse_last_way(world, edge, closed)
        self._tell(world, limit_mps, closed, (CLOSED, _detail(edge, lanes)))
        if self._reversed.state(world, edge) == RETURNING:
            first = int(self._network.edges["first_lane"][self._edges[edge]])
            self._reversed.keep_closed(world, edge, rows - first)

    def open(self, world: int, edge: str, lanes: Sequence[int] | None = None) -> None:
        """Give lanes of a road the limits and permissions of the map; errors as for `close`.

        A reversed road gets its direction back, with all its lanes.
        """
        rows = self._rows(world, edge, lanes)
        state = self._reversed.state(world, edge)
        if state == QUEUED:
            self._reversed.begin(world, edge, AS_ON_MAP)
            return
        if state == RETURNING:
            self._reversed.open_all(world, edge)
            return
        if state != AS_ON_MAP:
            self._turn_back(world, edge)
            return
        limit_mps, closed = self._now(world)
        own = self._network.lanes["speed_mps"]
        if not ((closed[rows] != 0) | (limit_mps[rows] != own[rows])).any():
            raise ActionError(
                f"edge {_detail(edge, lanes)!r} is neither closed nor damaged; give the id of a "
                "changed road"
            )
        limit_mps[rows], closed[rows] = own[rows], 0
        self._tell(world, limit_mps, closed, (OPENED, _detail(edge, lanes)))

    def reverse(
        self, world: int, edge: str, lanes: Sequence[int] | None = None, shuts_in: bool = False
    ) -> None:
        """Close a road, and open its contraflow lanes once no vehicle is on it.

        If roads that are being reversed lead to this road, this road closes once those are empty.

        Raises:
            ActionError: there is no such world or road, the road is the last way out of others or
                not one of `map.contraflow`, or `lanes` does not name all of its lanes.
            CapacityError, ConfigError: see `close`.
        """
        if len(self._rows(world, edge, lanes)) < len(self._rows(world, edge, None)):
            raise ActionError(
                f"lanes = {list(lanes or ())!r}: edge {edge!r} is reversed with all its lanes; "
                "leave lanes out"
            )
        self._reversed.check(edge)
        if self._reversed.state(world, edge) in (CLEARING, REVERSED_NOW, QUEUED):
            return
        before = self._reversed.states[world].copy()
        self._reversed.begin(world, edge, CLEARING)
        try:
            self.close(world, edge, shuts_in=shuts_in)
        except (ActionError, CapacityError):
            self._reversed.states[world] = before
            raise
        for road in self._reversed.to_queue(world):
            self._queue(world, road)

    def _queue(self, world: int, edge: str) -> None:
        """Let a road that is to be reversed stay open until reversed roads before it are empty."""
        limit_mps, classes = self._now(world)
        classes[self._rows(world, edge, None)] = 0
        closing = (CLOSED, edge)
        waiting = self._waiting[world]
        self._reversed.begin(world, edge, QUEUED)
        self._tell(world, limit_mps, classes, (OPENED, edge))
        if closing in waiting:  # it has not closed yet
            self._waiting[world] = tuple(event for event in waiting if event != closing)

    def _turn_back(self, world: int, edge: str) -> None:
        """Close the contraflow lanes of a road; the road opens once no vehicle is on them."""
        limit_mps, classes = self._now(world)
        classes[self._reversed.lanes(edge)] = 0
        self._reversed.begin(world, edge, RETURNING)
        self._tell(world, limit_mps, classes, (CLOSED, contraflow_of(edge)))

    @property
    def can_advance(self) -> bool:
        """Whether there are events, or roads that can be reversed."""
        return bool(self._events) or self._reversed.states.size > 0

    def advance(self, ticks: NDArray[np.int64]) -> None:
        """Apply the events of the next step, and continue to reverse or restore roads.

        `ticks`: (W,) of the worlds, before the step.
        """
        for world, tick in enumerate(ticks.tolist() if self._events else ()):
            for k, event in enumerate(self._events):
                due = math.ceil(event.at_s / self._clock.sim_dt_s - 1e-9)
                if not tick - self._clock.ticks_per_step < due <= tick:
                    continue
                try:
                    self._happen(world, event)
                except (ActionError, CapacityError) as error:
                    raise type(error)(f"map.events.{k}, now: {error}") from error
        for world, edge in self._reversed.due(ticks):
            self._reversed.begin(world, edge, CLEARING)
            self.close(world, edge, shuts_in=True)
        for world, edge, is_reversed, kept in self._reversed.cleared(ticks, self._present):
            limit_mps, classes = self._now(world)
            road, back = self._rows(world, edge, None), self._reversed.lanes(edge)
            classes[back] = ALL_PERMISSIONS if is_reversed else 0
            classes[road] = np.where(is_reversed | kept, ALL_PERMISSIONS, 0)
            if is_reversed:
                self._tell(world, limit_mps, classes, (REVERSED, edge))
            elif not kept.all():
                opened = np.flatnonzero(~kept).tolist() if kept.any() else None
                self._tell(world, limit_mps, classes, (OPENED, _detail(edge, opened)))

    def _happen(self, world: int, event: RoadEvent) -> None:
        """Apply an event in one world, except for changes that are already in force."""
        for edge in event.edges:
            before = self._told[world].copy()
            waiting = self._waiting[world]
            if event.action == "close":
                self.close(world, edge, event.lanes, shuts_in=event.shuts_in)
            elif event.action == "damage":
                self.limit(world, edge, event.speed_mps or 0.0, event.lanes)
            elif event.action == "reverse":
                self.reverse(world, edge, shuts_in=event.shuts_in)
            elif self._differs(world, edge, event.lanes):
                self.open(world, edge, event.lanes)
            if np.array_equal(before, self._told[world]):
                self._waiting[world] = waiting

    def _differs(self, world: int, edge: str, lanes: Sequence[int] | None) -> bool:
        """Return whether lanes of a road differ from the map."""
        rows = self._rows(world, edge, lanes)
        if self._reversed.state(world, edge) != AS_ON_MAP:
            return True
        limit_mps, classes = self._now(world)
        is_slower = limit_mps[rows] != self._network.lanes["speed_mps"][rows]
        return bool((is_slower | (classes[rows] != 0)).any())

    def _check_events(self) -> None:
        """Apply all events in turn. Raises ConfigError for the first impossible event."""
        order = sorted(range(len(self._events)), key=lambda k: self._events[k].at_s)
        for k in order:
            event = self._events[k]
            try:
                if event.action == "open":
                    for edge in event.edges:
                        self._rows(0, edge, event.lanes)
                self._happen(0, event)
            except (ActionError, CapacityError) as error:
                raise ConfigError(f"map.events.{k}: {error}") from error
        self.forget(np.ones(len(self._told), dtype=np.bool_))

    def limit(
        self, world: int, edge: str, speed_mps: float, lanes: Sequence[int] | None = None
    ) -> None:
        """Set the speed limit of lanes of a road.

        Args:
            world: number of the world.
            edge: id of the road.
            speed_mps: limit in m/s, above 0 and at most the map's limit, which ends an earlier
                change.
            lanes: see `close`.

        Raises:
            ActionError: there is no such world, road or lane, or the limit is out of range.
            CapacityError, ConfigError: see `close`.
        """
        rows = self._rows(world, edge, lanes)
        most_mps = float(self._network.lanes["speed_mps"][rows].min())
        if not 0.0 < speed_mps <= most_mps:
            raise ActionError(
                f"speed_mps = {speed_mps:g}: edge {edge!r} has a limit of {most_mps:g} m/s on the "
                "map; give a speed above 0 and at most that"
            )
        limit_mps, closed = self._now(world)
        limit_mps[rows] = speed_mps
        event = DAMAGED, f"{_detail(edge, lanes)} {float(speed_mps)!r}"
        self._tell(world, limit_mps, closed, event)

    def closed(self, world: int) -> tuple[str, ...]:
        """Return the ids of the roads with a closed lane, from the next step on."""
        told = self._told[self._checked(world)]
        lanes = told[told[:, CLASSES] > 0.0, CHANGED].astype(np.int64) - 1
        lanes = lanes[self._network.lanes["permissions"][lanes] != 0]
        edges = np.unique(self._network.lanes["edge"][lanes])
        return tuple(self._network.edge_ids[edge] for edge in edges.tolist())

    def add_to(self, commands: Commands) -> Commands:
        """Return the commands with the changes of the caller."""
        return replace(commands, lane_changes=self._told.copy()) if self._most else commands

    def clear(self) -> None:
        """Store the changes of the step for `last`; the lanes stay changed."""
        if self._most:
            self._last, self._waiting = self._waiting, [()] * len(self._waiting)

    def last(self, world: int) -> Asked:
        """Return the changes in the last step."""
        return self._last[world]

    def forget(self, chosen: NDArray[np.bool_]) -> None:
        """Begin an episode in the chosen worlds (W,)."""
        self._told[chosen] = 0.0
        self._reversed.states[chosen] = 0
        for world in np.flatnonzero(chosen).tolist():
            self._waiting[world] = self._last[world] = ()

    def _checked(self, world: int) -> int:
        if not self._most:
            raise ConfigError(
                "these worlds allow no changes of lanes: set map.changed_lanes to the number of "
                "lanes that may be closed or damaged at the same time"
            )
        if not 0 <= world < len(self._told):
            raise ActionError(f"world {world}: must be from 0 to {len(self._told) - 1}")
        return world

    def _rows(self, world: int, edge: str, lanes: Sequence[int] | None) -> NDArray[np.intp]:
        """Return the LANE rows of some lanes of a road."""
        self._checked(world)
        number = self._edges.get(edge, -1)
        if number < 0 or self._network.edges["internal"][number]:
            raise ActionError(f"edge {edge!r}: the map has no such road; give the id of one")
        if is_contraflow(edge):
            raise ActionError(
                f"edge {edge!r} are contraflow lanes: reverse or open the road that has these lanes"
            )
        first = int(self._network.edges["first_lane"][number])
        count = int(self._network.edges["num_lanes"][number])
        if lanes is None:
            return np.arange(first, first + count)
        wrong = [lane for lane in lanes if isinstance(lane, bool) or not 0 <= lane < count]
        if wrong or not len(lanes):
            raise ActionError(
                f"lanes = {list(lanes)!r}: edge {edge!r} has the lanes 0 to {count - 1}, from the "
                "kerb; name at least one of them, or leave lanes out for all"
            )
        return first + np.unique(np.asarray(lanes, dtype=np.intp))

    def _now(self, world: int) -> tuple[NDArray[np.float64], NDArray[np.uint32]]:
        """Return the limit in m/s (L,) of each lane, and the classes (L,) that it is closed to.

        For contraflow lanes, return the classes that they are open to instead.
        """
        told = self._told[world]
        used = told[told[:, CHANGED] > 0.0]
        lanes = used[:, CHANGED].astype(np.int64) - 1
        limit_mps = self._network.lanes["speed_mps"].copy()
        closed = np.zeros(len(limit_mps), dtype=np.uint32)
        limit_mps[lanes] = used[:, LIMIT_MPS]
        closed[lanes] = used[:, CLASSES].astype(np.uint32)
        return limit_mps, closed

    def _tell(
        self,
        world: int,
        limit_mps: NDArray[np.float64],
        closed: NDArray[np.uint32],
        event: tuple[str, str],
    ) -> None:
        """Apply the changes from the next step on."""
        differs = np.flatnonzero((limit_mps != self._network.lanes["speed_mps"]) | (closed != 0))
        number = len(np.union1d(differs, self._reversed.reserved(world)))
        if number > self._most:
            raise CapacityError(
                f"world {world}: {number} lanes would differ from the map, but "
                f"map.changed_lanes = {self._most}; set it higher, or open a road"
            )
        told = self._told[world]
        told[:] = 0.0
        told[: len(differs), CHANGED] = differs + 1
        told[: len(differs), LIMIT_MPS] = limit_mps[differs]
        told[: len(differs), CLASSES] = closed[differs]
        self._waiting[world] = (*self._waiting[world], event)

    def _refuse_last_way(self, world: int, edge: str, closed: NDArray[np.uint32]) -> None:
        before = shut_in_roads(self._network, self._now(world)[1])
        after = shut_in_roads(self._network, closed)
        new = np.flatnonzero(after & ~before)
        if len(new):
            names = ", ".join(self._network.edge_ids[row] for row in new[:5].tolist())
            raise ActionError(
                f"edge {edge!r}: it is the last way out of {len(new)} roads, such as {names}; "
                "open another road first, or pass shuts_in=True to let vehicles wait there"
            )


def _detail(edge: str, lanes: Sequence[int] | None) -> str:
    return edge if lanes is None else f"{edge} {','.join(map(str, sorted(set(lanes))))}"
