"""Lanes that the caller closes or slows down, and their part of a tick."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.errors import ActionError
from cavmarl.core.records.changed_lanes import apply_changes, wrong_changes
from cavmarl.engine.component import Component, ComponentContext
from cavmarl.shards.shard import Commands
from cavmarl.traffic.kernels.own_plans import renew_distances

_MOST_TICKS = 1 << 40


class LaneComponent(Component):
    """Writes the changes of the caller to `Worlds.lanes`, and renews the plans of the worlds.

    All processes of a world write the same limits, permissions and plans.
    """

    def __init__(self, host: ComponentContext) -> None:
        first = host.shards[0]
        self._map: NDArray[np.void] = host.network.arrays.lanes
        self._told: NDArray[np.float64] = host.zeros(
            (host.num_worlds, host.config.map.changed_lanes, 3)
        )
        self._speed_mps: NDArray[np.float64] = first.own_lanes["speed_mps"]
        self._permissions: NDArray[np.uint32] = first.own_lanes["permissions"]
        self._lanes: NDArray[np.void] = first.own_lanes
        self._changed_at = host.changed_at
        self._plans = host.lane_plans
        self._shards = host.shards
        self._travel = host.travel
        self._ticks = first.worlds.ticks
        self._ticks_per_step = host.config.clock.ticks_per_step

    def reset(self, chosen: NDArray[np.bool_]) -> None:
        """Give the lanes of the map to the chosen worlds (W,)."""
        self._told[chosen] = 0.0
        self._speed_mps[chosen] = self._map["speed_mps"]
        self._permissions[chosen] = self._map["permissions"]
        self._changed_at[chosen] = -1
        self.renew_plans()

    def begin(self, commands: Commands) -> None:
        """Take the changes of a step in its first tick."""
        told = commands.lane_changes
        if not told.size or self._ticks.item(0) % self._ticks_per_step:
            return
        if np.array_equal(told, self._told):
            return
        if wrong := wrong_changes(told, self._map):
            raise ActionError(wrong)
        changed = (told != self._told).any(axis=(1, 2))
        self._changed_at[changed] = self._ticks[changed]
        self._told[:] = told
        apply_changes(told, self._map, self._speed_mps, self._permissions)
        for w in self.renew_plans():
            for shard in self._shards:
                renew_distances(shard.roads, self._travel, shard.worlds, w)

    def renew_plans(self) -> list[int]:
        """Renew the plans of all worlds; return the worlds whose plans have changed."""
        if self._plans is None:
            return []
        return [w for w, lanes in enumerate(self._lanes) if self._plans.renew(w, lanes)]

    def arrays(self) -> Iterator[NDArray[Any]]:
        """Return the changes, their last tick, and the limits and permissions that follow."""
        return iter((self._told, self._changed_at, self._speed_mps, self._permissions))

    def wrong(self, saved: Sequence[NDArray[Any]]) -> str:
        """Return what is wrong with saved arrays; empty if nothing."""
        told, changed_at, speed_mps, permissions = saved
        if wrong := wrong_changes(told, self._map):
            return wrong
        if ((changed_at < -1) | (changed_at > _MOST_TICKS)).any():
            return "lanes have changed at an impossible time"
        expected = np.empty_like(speed_mps), np.empty_like(permissions)
        apply_changes(told, self._map, *expected)
        same = np.array_equal(speed_mps, expected[0]) and np.array_equal(permissions, expected[1])
        return "" if same else "the lanes do not follow from their changes"
