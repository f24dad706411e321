"""`BackendWorld`: one world whose zones are run by backends, of one kind or of more."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.errors import ConfigError
from cavmarl.shards.shard_backend import ShardBackend, VehicleControl
from cavmarl.zones.kernels.zone_lookup import squared_distance, zone_of
from cavmarl.zones.partition.zone_partition import ZonePartition


class BackendWorld:
    """Keeps backends at one tick, shows them their ghosts, and hands vehicles over at borders.

    A vehicle's owner changes between two ticks, when its centre is in another zone.

    Args:
        partition: the zones.
        backends: one a zone, in their order.
    """

    def __init__(self, partition: ZonePartition, backends: Sequence[ShardBackend]) -> None:
        self._zones, self._count = partition.arrays, partition.count
        self.resume(backends)
        self._shown: list[set[int]] = [set() for _ in backends]  # ghosts of each
        self._controls: dict[int, VehicleControl] = {}  # the last ones
        self._seen: dict[int, NDArray[np.float32]] = {}
        self.tick = 0
        self.handed_over = 0

    def reset(self, seed: int, vehicles: NDArray[np.void]) -> None:
        """Begin with the vehicles VEHICLE (n,), each in the zone that it is in."""
        zones = np.array([zone_of(self._zones, row["x"], row["y"]) for row in vehicles], dtype=int)
        self.tick = self.handed_over = 0
        self._controls.clear()
        for backend, shown in zip(self._backends, self._shown, strict=True):
            backend.reset(seed)
            shown.clear()
            own = vehicles[zones == backend.zone].copy()
            own["owner"] = backend.zone
            backend.spawn(own)
        self._share()
        self._sense()

    def resume(self, backends: Sequence[ShardBackend]) -> None:
        """Go on with other backends, which are where those before were: from their snapshots."""
        if [one.zone for one in backends] != [*range(self._count)]:
            raise ConfigError(
                f"backends of zones {[one.zone for one in backends]}: must be one for each of the "
                f"{self._count} zones, in their order"
            )
        self._backends = tuple(backends)

    def step(self, controls: Mapping[int, VehicleControl]) -> None:
        """One tick; `controls` are of vehicles of agents, by their ids."""
        left = dict(controls)
        self._controls |= left
        for backend in self._backends:
            own = backend.read_vehicles()["id"].tolist()
            backend.apply_controls({one: left.pop(one) for one in own if one in left})
        if left:
            raise ConfigError(f"vehicle {min(left)}: is in no zone; leave it out")
        for backend in self._backends:
            backend.advance()
        self._share()
        ticks = {backend.commit() for backend in self._backends}
        if len(ticks) > 1:
            raise ConfigError(f"backends are at ticks {sorted(ticks)}: all must be at one")
        (self.tick,) = ticks
        self._sense()  # by those that have owned them in this tick
        self._hand_over()

    def vehicles(self) -> NDArray[np.void]:
        """VEHICLE (n,) of all zones, by rising ids."""
        found = np.concatenate([backend.read_vehicles() for backend in self._backends])
        return found[np.argsort(found["id"])]

    def observations(self) -> dict[int, NDArray[np.float32]]:
        """(D,) of each agent's vehicle that has sensed, by its id."""
        return self._seen

    def _sense(self) -> None:
        found = [backend.read_sensors() for backend in self._backends]
        self._seen = {vehicle: seen for some in found for vehicle, seen in some.items()}

    def _share(self) -> None:
        """Show each backend the vehicles of others that it may ask about."""
        owned = [backend.read_vehicles() for backend in self._backends]
        for backend, shown in zip(self._backends, self._shown, strict=True):
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
                self._shown[number].discard(vehicle)
                self._shown[source.zone].add(vehicle)
                self.handed_over += 1
