"""Lanes that the caller closes or slows down, and their part of a tick."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.errors import ActionError
from cavmarl.core.records.lane_changes import apply_changes, wrong_changes
from cavmarl.engine.component import Component, ComponentContext
from cavmarl.shards.shard import Commands


class LaneComponent(Component):
    """Writes the changes of the caller to `Worlds.lanes`.

    All processes of a world write the same limits and permissions.
    """

    def __init__(self, host: ComponentContext) -> None:
        first = host.shards[0]
        self._map: NDArray[np.void] = host.network.arrays.lanes
        self._told: NDArray[np.float64] = host.zeros(
            (host.num_worlds, host.config.map.changed_lanes, 3)
        )
        self._speed_mps: NDArray[np.float64] = first.own_lanes["speed_mps"]
        self._permissions: NDArray[np.uint32] = first.own_lanes["permissions"]
        self._ticks = first.worlds.ticks
        self._ticks_per_step = host.config.clock.ticks_per_step

    def reset(self, chosen: NDArray[np.bool_]) -> None:
        """Give the lanes of the map to the chosen worlds (W,)."""
        self._told[chosen] = 0.0
        self._speed_mps[chosen] = self._map["speed_mps"]
        self._permissions[chosen] = self._map["permissions"]

    def begin(self, commands: Commands) -> None:
        """Take the changes of a step in its first tick."""
        told = commands.lane_changes
        if not told.size or self._ticks.item(0) % self._ticks_per_step:
            return
        if np.array_equal(told, self._told):
            return
        if wrong := wrong_changes(told, self._map):
            raise ActionError(wrong)
        self._told[:] = told
        apply_changes(told, self._map, self._speed_mps, self._permissions)

    def arrays(self) -> Iterator[NDArray[Any]]:
        """Return the changes, and the limits and permissions that follow from them."""
        return iter((self._told, self._speed_mps, self._permissions))

    def wrong(self, saved: Sequence[NDArray[Any]]) -> str:
        """Return what is wrong with saved arrays; empty if nothing."""
        told, speed_mps, permissions = saved
        if wrong := wrong_changes(told, self._map):
            return wrong
        expected = np.empty_like(speed_mps), np.empty_like(permissions)
        apply_changes(told, self._map, *expected)
        same = np.array_equal(speed_mps, expected[0]) and np.array_equal(permissions, expected[1])
        return "" if same else "the lanes do not follow from their changes"
