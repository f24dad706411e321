"""`BackendWorld`: one world whose zones are run by backends of one or several kinds."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.errors import ConfigError
from cavmarl.shards.shard_backend import ShardBackend, VehicleControl
from cavmarl.zones.kernels.zone_lookup import squared_distance, zone_of
from cavmarl.zones.partition.zone_partition import ZonePartition


class BackendWorld:
    """A world that steps its backends together, exchanges ghosts and hands vehicles over.

    A vehicle's owner changes between two ticks, when its centre is in another zone.

    Args:
        partition: the zones.
        backends: one per zone, in the order of zones.
    """

    def __init__(self, partition: ZonePartition, backends: Sequence[ShardBackend]) -> None:
        self._zones, self._count = partition.arrays, partition.count
        self.resume(backends)
        self._ghost_ids: list[set[int]] = [set() for _ in backends]  # ids of each backend's ghosts
        self._controls: dict[int, VehicleControl] = {}  # the latest control of each vehicle
        self._seen: dict[int, NDArray[np.float32]] = {}
        self.tick = 0
        self.handed_over = 0

    def reset(self, seed: int, vehicles: NDArray[np.void]) -> None:
        """Begin with the vehicles VEHICLE (n,), each owned by the zone that contains it."""
        zones = np.array([zone_of(self._zones, row["x"], row["y"]) for row in vehicles], dtype=int)
        self.tick = self.handed_over = 0
        self._controls.clear()
        for backend, shown in zip(self._backends, self._ghost_ids, strict=True):
            backend.reset(seed)
            shown.clear()
            own = vehicles[zones == backend.zone].copy()
            own["owner"] = backend.zone
            backend.spawn(own)
        self._update_ghosts()
        self._sense()

    def resume(self, backends: Sequence[ShardBackend]) -> None:
        """Replace the backends by backends that have restored their snapshots."""
        if [one.zone for one in backends] != [*range(self._count)]:
            raise ConfigError(
                f"the backends run the zones {[one.zone for one in backends]}; pass one for each "
                f"of the {self._count} zones, in their order"
            )
        self._backends = tuple(backends)

    def step(self, controls: Mapping[int, VehicleControl]) -> None:
        """Run one tick. `controls` are those of agents' vehicles, by vehicle id."""
        left = dict(controls)
        self._controls |= left
        for backend in self._backends:
            own = backend.read_vehicles()["id"].tolist()
            backend.apply_controls({one: left.pop(one) for one in own if one in left})
        if left:
            raise ConfigError(f"vehicle {min(left)} is in no zone; omit its controls")
        for backend in self._backends:
            backend.advance()
        self._update_ghosts()
        ticks = {backend.commit() for backend in self._backends}
        if len(ticks) > 1:
            raise ConfigError(
                f"the backends are at ticks {sorted(ticks)}; restore them to the same tick"
            )
        (self.tick,) = ticks
        self._sense()  # the owners of this tick have the observations
        self._hand_over()

    def vehicles(self) -> NDArray[np.void]:
        """Return the vehicles VEHICLE (n,) of all zones, in the order of their ids."""
        found = np.concatenate([backend.read_vehicles() for backend in self._backends])
        return found[np.argsort(found["id"])]

    def observations(self) -> dict[int, NDArray[np.float32]]:
        """Return the latest observation (D,) of each agent's vehicle, by vehicle id."""
        return self._seen

    def _sense(self) -> None:
        found = [backend.read_sensors() for backend in self._backends]
        self._seen = {vehicle: seen for some in found for vehicle, seen in some.items()}

    def _update_ghosts(self) -> None:
        """Update the ghosts of each backend: vehicles of other zones within its reach."""
        owned = [backend.read_vehicles() for backend in self._backends]
        for backend, shown in zip(self._backends, self._ghost_ids, strict=True):
            limit = backend.reach_m * backend.reach_m
            others = np.concatenate(
                [rows for zone, rows in enumerate(owned) if zone != backend.zone]
            )
            is_near = [
                squared_distance(self._zones.rects, backend.zone, row["x"], row["y"]) <= limit
                for row in others
            ]
            ghosts = others[np.array(is_near, dtype=np.bool_)]
            now = set(ghosts["id"].tolist())
            backend.remove_ghosts(sorted(shown - now))
            backend.upsert_ghosts(ghosts)
            shown.clear()
            shown |= now

    def _hand_over(self) -> None:
        for source in self._backends:
            for row in source.read_vehicles():
                number = zone_of(self._zones, row["x"], row["y"])
                if number == source.zone:
                    continue
                target, vehicle = self._backends[number], int(row["id"])
                state = np.array([row])
                state["owner"] = number
                state["epoch"] += 1
                source.destroy([vehicle])
                target.remove_ghosts([vehicle])
                target.spawn(state)
                if vehicle in self._controls:
                    target.apply_controls({vehicle: self._controls[vehicle]})
                source.upsert_ghosts(state)
                self._ghost_ids[number].discard(vehicle)
                self._ghost_ids[source.zone].add(vehicle)
                self.handed_over += 1
