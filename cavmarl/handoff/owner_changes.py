"""`OwnerChanges`: changes of vehicles' owners between two ticks."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from cavmarl.core.compiled import specialized
from cavmarl.core.errors import ConfigError
from cavmarl.handoff.coordinator.coordinator import Near
from cavmarl.ownership.messages import Birth, Switch
from cavmarl.shards.shard import Shard
from cavmarl.zones.kernels.borders import give_up, pass_on, take_over
from cavmarl.zones.kernels.ownership_changes import hand_over, look, release
from cavmarl.zones.kernels.zone_lookup import zone_of

if TYPE_CHECKING:
    from cavmarl.handoff.division import ZonedShards


class OwnerChanges:
    """Finds vehicles near borders, and moves their rows from owner to owner.

    Attributes:
        hand_over_all: the kernel `hand_over`, for the arrays of these worlds.
        release_all: the kernel `release`, for the arrays of these worlds.
    """

    def __init__(self, division: ZonedShards, shards: Sequence[Shard]) -> None:
        self._division = division
        self._shards = shards
        self._look = specialized(look)
        self._pass_on = specialized(pass_on)
        self._give_up = specialized(give_up)
        self._take_over = specialized(take_over)
        self.hand_over_all = specialized(hand_over)
        self.release_all = specialized(release)

    def near(self, w: int, check_all: bool) -> list[Near]:
        """Return vehicles near a border in the committed rows; `check_all`: search all rows."""
        division = self._division
        if check_all:
            self._look(
                division.zones, division.borders, division.zoned, division.side, w, True, 0,
                division.book,
            )  # fmt: skip
        num = division.book.num_near.item(w)
        if num == 0:
            return []
        return [Near(*entry) for entry in division.book.near[w, :num].tolist()]

    def find(self, w: int, vehicle: int) -> tuple[int, int]:
        """Return the zone that owns a vehicle, and its committed row in this zone."""
        for shard in self._shards:
            worlds = shard.worlds
            found = np.flatnonzero(worlds.rows["id"][w, : worlds.num_owned[w]] == vehicle)
            if len(found):
                return shard.zone, int(found[0])
        raise ConfigError(
            f"no zone of world {w} owns vehicle {vehicle}; use the id of a vehicle in this world"
        )

    def state(self, w: int, zone: int, row: int) -> bytes:
        """Return the complete state of a zone's owned vehicle, from its committed row."""
        worlds = self._shards[zone].worlds
        return self._division.codec.pack(worlds.rows, w, row, int(worlds.ticks[w]))

    def hand_over(
        self,
        w: int,
        switch: Switch,  # the vehicle, its source and its target
        hint: int = 0,  # index of the row at the source, if known: it is searched first
    ) -> int:  # the row at the target
        """Change a vehicle's owner. The target receives a copy of the source's committed row."""
        place = self._pass_on(
            switch.vehicle, switch.source, hint, switch.target, switch.epoch,
            self._division.zoned, self._division.side, w,
        )  # fmt: skip
        if place == -1:
            raise ConfigError(f"zone {switch.source} does not own vehicle {switch.vehicle}")
        if place == -2:
            raise self.unseen(switch.vehicle, switch.target)
        return place

    def give_up(self, w: int, zone: int, vehicle: int) -> None:
        """Hand a vehicle over to a zone of another process. Its row here becomes a ghost."""
        if not self._give_up(vehicle, zone, 0, self._division.zoned, self._division.side, w):
            raise ConfigError(f"zone {zone} does not own vehicle {vehicle}")

    def take_over(self, w: int, zone: int, vehicle: int, epoch: int, state: bytes) -> None:
        """Take over a vehicle from another zone. Its state replaces its ghost in this zone."""
        place = self._take_over(vehicle, zone, epoch, self._division.zoned, self._division.side, w)
        if place < 0:
            raise self.unseen(vehicle, zone)
        worlds = self._shards[zone].worlds
        self._division.codec.unpack(state, vehicle, int(worlds.ticks[w]), worlds.rows, w, place)
        row = worlds.rows[w, place]
        row["owner"], row["epoch"] = zone, epoch

    @staticmethod
    def unseen(vehicle: int, zone: int) -> ConfigError:
        """Return the error for a vehicle that enters a zone without a ghost of the vehicle."""
        return ConfigError(
            f"vehicle {vehicle} entered zone {zone}, which has no ghost of it: the halo is too "
            "narrow; increase zones.halo_m"
        )

    def settle_newborn(self, w: int, births: Sequence[Birth]) -> list[Birth]:
        """Give vehicles that are not recorded yet to the zones that contain them now."""
        settled = []
        for vehicle, zone, state in births:
            _, row = self.find(w, vehicle)
            place = self._division.owned(w, zone)[row]
            target = zone_of(self._division.zones, place["x"], place["y"])
            if target != zone:
                self.hand_over(w, Switch(vehicle, zone, target, 0, False), row)
            settled.append(Birth(vehicle, target, state))
        return settled
