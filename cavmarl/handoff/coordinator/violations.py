"""Description of a violated invariant, with the tick, the zone, the vehicle and the values.

This code runs only after the monitor has found a violation, so it may search all vehicles.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from cavmarl.core.errors import ProtocolError
from cavmarl.driving.vehicles import GHOST_FIELDS
from cavmarl.handoff.division import ZonedShards
from cavmarl.handoff.kernels.invariant_checks import KIND_FAR, KIND_TICK, CheckTime, Kept
from cavmarl.ownership.messages import Birth
from cavmarl.ownership.trace_check import Owner
from cavmarl.zones.kernels.zone_lookup import is_seen, squared_distance

Place = tuple[int, np.void]
"""A zone and a row that it owns."""


class Violations:
    """The state of a world that violates an invariant."""

    def __init__(self, division: ZonedShards, w: int, clock: CheckTime, before: Kept) -> None:
        self._division = division
        self._w = w
        self._clock = clock
        self._before = before
        self._places: dict[int, list[Place]] = {}
        for zone in range(division.count):
            for row in division.owned(w, zone):
                self._places.setdefault(int(row["id"]), []).append((zone, row))

    def explain(
        self, kind: int, vehicle: int, owners: Mapping[int, Owner], births: Sequence[Birth]
    ) -> None:
        """Raise ProtocolError with the first violation."""
        expected = {**owners, **{birth.vehicle: (birth.zone, 0) for birth in births}}
        for words in (
            self._duplicates(),
            self._finding(kind, vehicle),
            self._clocks(),
            self._owners(expected),
            self._ghosts(),
        ):
            for word in words:
                raise ProtocolError(f"tick {self._clock.tick} of world {self._w}: {word}")
        raise ProtocolError(
            f"tick {self._clock.tick} of world {self._w}: the sums of hashes differ, but the rows "
            "do not, because rows have changed during the check"
        )

    def _duplicates(self) -> Iterator[str]:
        for vehicle, places in sorted(self._places.items()):
            if len(places) > 1:
                zones = [zone for zone, _ in places]
                yield f"one owner: vehicle {vehicle} is owned by zones {zones}"

    def _finding(self, kind: int, vehicle: int) -> Iterator[str]:
        places = self._places.get(vehicle, [])
        if kind == KIND_TICK:
            zone, row = places[0]
            last = self._last(vehicle)
            should = self._clock.tick - (self._clock.new_late if last is None else last["late"])
            yield (
                f"advanced once a tick: vehicle {vehicle} of zone {zone} is at tick {row['tick']}, "
                f"but should be at tick {should}"
            )
        elif kind == KIND_FAR:
            zone, row = places[0]
            last = self._last(vehicle)
            assert last is not None
            moved_m = math.hypot(row["x"] - last["x"], row["y"] - last["y"])
            yield (
                f"continuity: vehicle {vehicle} of zone {zone} moved {moved_m:.2f} m in a tick, "
                f"from ({last['x']:.2f}, {last['y']:.2f}) to ({row['x']:.2f}, {row['y']:.2f}); "
                f"the limit is {self._clock.limit_m:.2f} m"
            )

    def _last(self, vehicle: int) -> np.void | None:
        for rows, num in zip(self._before.rows, self._before.num.tolist(), strict=True):
            for found in np.flatnonzero(rows["id"][:num] == vehicle).tolist():
                last: np.void = rows[found]
                return last
        return None

    def _clocks(self) -> Iterator[str]:
        for zone, tick in enumerate(self._division.ticks(self._w)):
            if tick != self._clock.tick:
                yield f"one clock: zone {zone} is at tick {tick}, not at {self._clock.tick}"

    def _owners(self, expected: Mapping[int, Owner]) -> Iterator[str]:
        live = sum(map(len, self._places.values()))
        count = f"there are {live} vehicles, but {len(expected)} have entered and not left"
        for vehicle in sorted(expected.keys() | self._places.keys()):
            places = self._places.get(vehicle, [])
            if not places:
                zone, epoch = expected[vehicle]
                yield (
                    f"population: vehicle {vehicle} of zone {zone}, epoch {epoch}, is lost: {count}"
                )
                continue
            zone, row = places[0]
            if vehicle not in expected:
                yield f"population: vehicle {vehicle} of zone {zone} has never entered: {count}"
            elif expected[vehicle] != (zone, row["epoch"]):
                yield (
                    f"owner on record: zone {zone} owns vehicle {vehicle} at epoch "
                    f"{row['epoch']}, but the directory has zone {expected[vehicle][0]} and epoch "
                    f"{expected[vehicle][1]}"
                )

    def _ghosts(self) -> Iterator[str]:
        halo, rects = self._division.halo, self._division.zones.rects
        for zone in range(self._division.count):
            ghosts = self._division.ghosts(self._w, zone)
            copies = Counter(ghosts["id"].tolist())
            for vehicle in sorted(self._places):
                owner, row = self._places[vehicle][0]
                squared = squared_distance(rects, zone, row["x"], row["y"])
                due = owner != zone and is_seen(halo, zone, row, squared)
                found = copies.pop(vehicle, 0)
                if found != due:
                    yield (
                        f"ghosts: zone {zone} has {found} ghosts of vehicle {vehicle}, not "
                        f"{int(due)}: the vehicle of zone {owner} is {math.sqrt(squared):.2f} m "
                        f"outside of zone {zone}, which sees up to {halo.seen_m:.2f} m"
                    )
            for vehicle in sorted(copies):
                yield f"ghosts: zone {zone} has a ghost of vehicle {vehicle}, which does not exist"
            for ghost in ghosts:
                yield from self._differences(zone, ghost)

    def _differences(self, zone: int, ghost: np.void) -> Iterator[str]:
        owner, row = self._places[int(ghost["id"])][0]
        for name in GHOST_FIELDS:
            if ghost[name].tobytes() != row[name].tobytes():
                yield (
                    f"age of ghosts: zone {zone} has a ghost of vehicle {ghost['id']} with {name} "
                    f"= {ghost[name]}, but its owner, zone {owner}, has {row[name]}"
                )
