"""`ReversedRoads`: the roads of `map.contraflow`, and which of them are reversed."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from cavmarl.config.env import EnvConfig
from cavmarl.core.errors import ActionError
from cavmarl.core.records.changed_lanes import CHANGED, CLASSES
from cavmarl.driving.vehicle_types import ALL_PERMISSIONS
from cavmarl.engine.world_views import WorldViews
from cavmarl.roads.contraflow_ids import contraflow_of
from cavmarl.roads.network import RoadNetwork

# States of a road. CLEARING: closed, to be reversed once it is empty. RETURNING: its contraflow
# lanes are closed, and it opens once they are empty. QUEUED: still open, to be closed once the
# reversed roads that lead to it are empty, so that their vehicles can leave.
AS_ON_MAP, CLEARING, REVERSED_NOW, RETURNING, QUEUED = range(5)
# Columns of `ReversedRoads.states`. _KEPT: bits of the lanes that stay closed when a road returns;
# for a CLEARING road, not 0 if vehicles may be on its contraflow lanes.
_STATE, _SINCE, _KEPT = range(3)
_NOT_YET = -1  # the state begins in the next step

# Minimum time between closing lanes and opening the lanes in the other direction. Vehicles that
# cannot stop before the closed lanes enter them within this time, so that they are seen there.
CLEAR_S = 10.0


class ReversedRoads:
    """The states of the C roads of `map.contraflow` in W worlds.

    Attributes:
        states: (W, C, 3) for each road: its state, the tick in which this state began, and bits
            whose meaning depends on the state; see `_KEPT`.
    """

    def __init__(self, config: EnvConfig, network: RoadNetwork, num_worlds: int) -> None:
        self._roads = tuple(sorted(set(config.map.contraflow)))
        self._clock = config.clock
        self.states = np.zeros((num_worlds, len(self._roads), 3), dtype=np.int64)
        edges = {name: row for row, name in enumerate(network.edge_ids)} if self._roads else {}
        self._ground = [_ground(network, edges[road]) for road in self._roads]
        back = [edges[contraflow_of(road)] for road in self._roads]
        self._lanes = [_lanes(network, edge) for edge in back]
        self._above = [_ground(network, edge) for edge in back]
        self._own = [_lanes(network, edges[road]) for road in self._roads]
        self._before = _roads_before(network, [edges[road] for road in self._roads])

    def check(self, edge: str) -> None:
        """Raise ActionError if a road cannot be reversed."""
        if edge not in self._roads:
            raise ActionError(
                f"edge {edge!r} cannot be reversed: give one of map.contraflow: "
                f"{', '.join(self._roads) or 'there are none; name roads there'}"
            )

    def state(self, world: int, edge: str) -> int:
        """Return the state of a road; the map's state if it cannot be reversed."""
        if edge not in self._roads:
            return AS_ON_MAP
        return int(self.states[world, self._roads.index(edge), _STATE])

    def begin(self, world: int, edge: str, state: int) -> None:
        """Let a road have another state from the next step on."""
        road = self._roads.index(edge)
        is_used = state == CLEARING and self.states[world, road, _STATE] == RETURNING
        self.states[world, road] = state, _NOT_YET, int(is_used)

    def keep_closed(self, world: int, edge: str, lanes: NDArray[np.intp]) -> None:
        """Let lanes of a road that returns stay closed; `lanes`: their indices."""
        bits = np.bitwise_or.reduce(np.int64(1) << lanes.astype(np.int64))
        self.states[world, self._roads.index(edge), _KEPT] |= bits

    def open_all(self, world: int, edge: str) -> None:
        """Undo `keep_closed`: all lanes of a road that returns open."""
        self.states[world, self._roads.index(edge), _KEPT] = 0

    def _kept(self, world: int, road: int) -> NDArray[np.bool_]:
        """Return which lanes of a road stay closed when it returns."""
        index = np.arange(len(self._own[road]))
        return np.asarray((self.states[world, road, _KEPT] >> index) & 1, dtype=np.bool_)

    def lanes(self, edge: str) -> NDArray[np.intp]:
        """Return the LANE rows of the contraflow lanes of a road."""
        return self._lanes[self._roads.index(edge)]

    def reserved(self, world: int) -> NDArray[np.intp]:
        """Return the LANE rows of lanes that will close or open to reverse roads."""
        state = self.states[world, :, _STATE]
        found = [self._lanes[road] for road in np.flatnonzero(state == CLEARING).tolist()]
        for road in np.flatnonzero(state == QUEUED).tolist():
            found += [self._own[road], self._lanes[road]]
        return np.concatenate(found) if found else np.zeros(0, dtype=np.intp)

    def to_queue(self, world: int) -> list[str]:
        """Return the closed roads that must open again, because a road before them is not empty.

        Otherwise, vehicles on the road before them could not leave it.
        """
        state = self.states[world, :, _STATE]
        waits = (self._before & ((state == QUEUED) | (state == CLEARING))).any(axis=1)
        waits &= (state == CLEARING) & (self.states[world, :, _KEPT] == 0)
        return [self._roads[road] for road in np.flatnonzero(waits).tolist()]

    def due(self, ticks: NDArray[np.int64]) -> list[tuple[int, str]]:
        """Return each world and road that closes in the next step; `ticks` as for `cleared`."""
        state = self.states[..., _STATE]
        closing = (state == QUEUED) | (state == CLEARING)
        waits = (closing[:, np.newaxis] & self._before).any(axis=2)
        runs = np.broadcast_to(ticks, len(state))[:, np.newaxis] >= 0
        return [
            (world, self._roads[road])
            for world, road in np.argwhere((state == QUEUED) & ~waits & runs).tolist()
        ]

    def wrong(self, states: NDArray[np.int64], told: NDArray[np.float64]) -> str:
        """Return what is wrong with loaded `states`; empty if they are valid.

        `told`: (W, N, 3) changed lanes that were saved beside them; see `changed_lanes`.
        """
        state, since, kept = np.moveaxis(states, -1, 0)
        if ((state < AS_ON_MAP) | (state > QUEUED)).any() or (since < _NOT_YET).any():
            return "a reversed road has an unknown state"
        most = np.where(state == RETURNING, np.iinfo(np.int64).max, state == CLEARING)
        if ((kept < 0) | (kept > most)).any():
            return "a road that does not return has lanes that stay closed"
        changed, classes = told[..., CHANGED] - 1.0, told[..., CLASSES]
        for road, (own, back) in enumerate(zip(self._own, self._lanes, strict=True)):
            opened = (np.isin(changed, back) & (classes > 0.0)).sum(axis=1)
            is_reversed = state[:, road] == REVERSED_NOW
            if (opened != np.where(is_reversed, len(back), 0)).any():
                return (
                    "contraflow lanes are open on a road that is not reversed, or closed on a "
                    "reversed road"
                )
            closed = (np.isin(changed, own) & (classes == ALL_PERMISSIONS)).sum(axis=1)
            is_shut = np.isin(state[:, road], (CLEARING, REVERSED_NOW, RETURNING))
            if (is_shut & (closed != len(own))).any():
                return "a reversed road is open"
        return ""

    def cleared(
        self, ticks: NDArray[np.int64], present: Callable[[], WorldViews]
    ) -> Iterator[tuple[int, str, bool, NDArray[np.bool_]]]:
        """Yield each road whose lanes are empty.

        Each item has the world, the road's id, whether it is reversed, and the lanes that stay
        closed. The states of the roads change. Lanes are examined once a second.

        `ticks`: (W,) of the worlds; -1: the world's episode is over.
        """
        under_way = np.isin(self.states[..., _STATE], (CLEARING, RETURNING))
        ticks_per_s = max(1, round(1.0 / self._clock.sim_dt_s))
        per_step = self._clock.ticks_per_step
        for world, road in np.argwhere(under_way).tolist():
            tick, (state, since, _) = int(ticks[world]), self.states[world, road].tolist()
            if tick < 0:
                continue
            if since == _NOT_YET:
                self.states[world, road, _SINCE] = tick
                continue
            waited_s = (tick - since) * self._clock.sim_dt_s
            if waited_s < CLEAR_S or tick % ticks_per_s >= per_step:
                continue
            taken = self._ground if state == CLEARING else self._above
            if np.isin(present().vehicles(world)["lane"], taken[road]).any():
                continue
            now = REVERSED_NOW if state == CLEARING else AS_ON_MAP
            kept = self._kept(world, road)
            self.states[world, road] = now, tick, 0
            yield world, self._roads[road], now == REVERSED_NOW, kept


def _lanes(network: RoadNetwork, edge: int) -> NDArray[np.intp]:
    first = int(network.edges["first_lane"][edge])
    return np.arange(first, first + int(network.edges["num_lanes"][edge]))


def _ground(network: RoadNetwork, edge: int) -> NDArray[np.intp]:
    """Return the LANE rows of a road, and of the movements that lead to it."""
    lanes = _lanes(network, edge)
    into = np.flatnonzero(np.isin(network.links["to_lane"], lanes))
    over = np.flatnonzero(network.lanes["internal"] & np.isin(network.lanes["link"], into))
    return np.concatenate([lanes, over])


def _roads_before(network: RoadNetwork, edges: Sequence[int]) -> NDArray[np.bool_]:
    """Return (C, C): [a, b] is true if road b leads to road a, which does not lead back to b.

    On a cycle of roads, no road waits for another.
    """
    edge, links = network.lanes["edge"], network.links
    ahead = ~np.isin(links["direction"], (ord("t"), ord("T")))
    leads = np.zeros((len(edges), len(edges)), dtype=np.bool_)
    for column, road in enumerate(edges):
        reached = edge[links["to_lane"][ahead & (edge[links["from_lane"]] == road)]]
        leads[:, column] = np.isin(edges, reached)
    reaches = leads
    for _ in range(len(edges).bit_length()):
        reaches = reaches | (reaches[:, :, np.newaxis] & reaches).any(axis=1)
    return leads & ~reaches.T
