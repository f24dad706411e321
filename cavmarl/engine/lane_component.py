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
    """Writes the changes of the caller, and limits of roadside units, to `Worlds.lanes`.

    The component also renews the plans of the worlds. All processes of a world write the same
    limits, permissions and plans.
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
        limited = len(self._map) if host.config.limits.are_controlled else 0
        # limits of roadside units, infinite where there are none; (W, 0): there are no units
        self._unit_mps: NDArray[np.float64] = host.zeros((host.num_worlds, limited))
        self._ticks = first.worlds.ticks
        self._ticks_per_step = host.config.clock.ticks_per_step

    def reset(self, chosen: NDArray[np.bool_]) -> None:
        """Give the lanes of the map to the chosen worlds (W,)."""
        self._told[chosen] = 0.0
        self._speed_mps[chosen] = self._map["speed_mps"]
        self._permissions[chosen] = self._map["permissions"]
        self._unit_mps[chosen] = np.inf
        self._changed_at[chosen] = -1
        self.renew_plans()

    def limit(self, unit_mps: NDArray[np.float64]) -> None:
        """Apply limits (W, L) where they are below the present limits, until the next call."""
        if not np.array_equal(unit_mps, self._unit_mps):
            self._unit_mps[:] = unit_mps
            self._follow()

    def _follow(self) -> None:
        """Write the results of changes and units: limits, permissions, plans, distances."""
        self._apply(self._told, self._unit_mps, self._speed_mps, self._permissions)
        for w in self.renew_plans():
            for shard in self._shards:
                renew_distances(shard.roads, self._travel, shard.worlds, w)

    def _apply(
        self,
        told: NDArray[np.float64],
        unit_mps: NDArray[np.float64],
        speed_mps: NDArray[np.float64],
        permissions: NDArray[np.uint32],
    ) -> None:
        """Write the limits and permissions (W, L) that follow from changes and units."""
        apply_changes(told, self._map, speed_mps, permissions)
        if unit_mps.size:
            np.minimum(speed_mps, unit_mps, out=speed_mps)

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
        self._follow()

    def renew_plans(self) -> list[int]:
        """Renew the plans of all worlds; return the worlds whose plans have changed."""
        if self._plans is None:
            return []
        return [w for w, lanes in enumerate(self._lanes) if self._plans.renew(w, lanes)]

    def arrays(self) -> Iterator[NDArray[Any]]:
        """Return the changes, their last tick, and the limits and permissions that follow."""
        held = (self._told, self._unit_mps, self._changed_at)
        return iter((*held, self._speed_mps, self._permissions))

    def wrong(self, saved: Sequence[NDArray[Any]]) -> str:
        """Return the fault of saved arrays; empty if they are valid."""
        told, unit_mps, changed_at, speed_mps, permissions = saved
        if wrong := wrong_changes(told, self._map):
            return wrong
        if ((changed_at < -1) | (changed_at > _MOST_TICKS)).any():
            return "lanes have changed at an impossible time"
        expected = np.empty_like(speed_mps), np.empty_like(permissions)
        if not (unit_mps > 0.0).all():
            return "a speed limit of a roadside unit is not above 0"
        self._apply(told, unit_mps, *expected)
        same = np.array_equal(speed_mps, expected[0]) and np.array_equal(permissions, expected[1])
        return "" if same else "the lanes do not match their changes"
