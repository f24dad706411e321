"""`ReversedRoads`: the roads of `map.contraflow`, and which of them are reversed."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
from numpy.typing import NDArray

from cavmarl.config.env import EnvConfig
from cavmarl.core.errors import ActionError
from cavmarl.engine.world_views import WorldViews
from cavmarl.roads.contraflow_ids import contraflow_of
from cavmarl.roads.network import RoadNetwork

# States of a road: as on the map; closed, to be reversed once it is empty; reversed; its
# contraflow lanes are closed, and it opens once they are empty.
AS_ON_MAP, CLEARING, REVERSED_NOW, RETURNING = range(4)
_STATE, _SINCE = 0, 1  # columns of `ReversedRoads.states`
_NOT_YET = -1  # the order belongs to the next step

# Least time between closing lanes and opening those in the other direction. Vehicles that cannot
# stop before closed lanes are on them by then.
CLEAR_S = 10.0


class ReversedRoads:
    """The states of the C roads of `map.contraflow` in W worlds.

    Attributes:
        states: (W, C, 2) state of each road, and the tick in which it began.
    """

    def __init__(self, config: EnvConfig, network: RoadNetwork, num_worlds: int) -> None:
        self._roads = tuple(sorted(set(config.map.contraflow)))
        self._clock = config.clock
        self.states = np.zeros((num_worlds, len(self._roads), 2), dtype=np.int64)
        edges = {name: row for row, name in enumerate(network.edge_ids)} if self._roads else {}
        self._ground = [_ground(network, edges[road]) for road in self._roads]
        back = [edges[contraflow_of(road)] for road in self._roads]
        self._lanes = [_lanes(network, edge) for edge in back]
        self._above = [_ground(network, edge) for edge in back]

    def check(self, edge: str) -> None:
        """Raise ActionError if a road cannot be reversed."""
        if edge not in self._roads:
            raise ActionError(
                f"edge {edge!r} cannot be reversed: give one of map.contraflow: "
                f"{', '.join(self._roads) or 'there are none; name roads there'}"
            )

    def state(self, world: int, edge: str) -> int:
        """Return the state of a road; that of the map if it cannot be reversed."""
        if edge not in self._roads:
            return AS_ON_MAP
        return int(self.states[world, self._roads.index(edge), _STATE])

    def begin(self, world: int, edge: str, state: int) -> None:
        """Let a road have another state from the next step on."""
        self.states[world, self._roads.index(edge)] = state, _NOT_YET

    def lanes(self, edge: str) -> NDArray[np.intp]:
        """Return the LANE rows of the contraflow lanes of a road."""
        return self._lanes[self._roads.index(edge)]

    def reserved(self, world: int) -> int:
        """Return the number of contraflow lanes that will open."""
        waiting = np.flatnonzero(self.states[world, :, _STATE] == CLEARING)
        return sum(len(self._lanes[road]) for road in waiting.tolist())

    def cleared(
        self, ticks: NDArray[np.int64], present: Callable[[], WorldViews]
    ) -> Iterator[tuple[int, str, bool]]:
        """Yield each road whose lanes are empty: its world, its id, and whether it is reversed.

        Their states change. Lanes are examined once a second.

        `ticks`: (W,) of the worlds; -1: the world's episode is over.
        """
        under_way = np.isin(self.states[..., _STATE], (CLEARING, RETURNING))
        ticks_per_s = max(1, round(1.0 / self._clock.sim_dt_s))
        per_step = self._clock.ticks_per_step
        for world, road in np.argwhere(under_way).tolist():
            tick, (state, since) = int(ticks[world]), self.states[world, road].tolist()
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
            self.states[world, road] = now, tick
            yield world, self._roads[road], now == REVERSED_NOW


def _lanes(network: RoadNetwork, edge: int) -> NDArray[np.intp]:
    first = int(network.edges["first_lane"][edge])
    return np.arange(first, first + int(network.edges["num_lanes"][edge]))


def _ground(network: RoadNetwork, edge: int) -> NDArray[np.intp]:
    """Return the LANE rows of a road, and of the movements that lead to it."""
    lanes = _lanes(network, edge)
    into = np.flatnonzero(np.isin(network.links["to_lane"], lanes))
    over = np.flatnonzero(network.lanes["internal"] & np.isin(network.lanes["link"], into))
    return np.concatenate([lanes, over])


def wrong_reversals(states: NDArray[np.int64]) -> str:
    """Return what is wrong with `ReversedRoads.states` from outside; empty if nothing."""
    state, since = states[..., _STATE], states[..., _SINCE]
    if ((state < AS_ON_MAP) | (state > RETURNING)).any() or (since < _NOT_YET).any():
        return "a reversed road has an unknown state"
    return ""
