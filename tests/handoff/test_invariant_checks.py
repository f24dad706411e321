"""The check of the rows of a world by the monitor, compared with its plain version."""

from __future__ import annotations

from collections import Counter
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from cavmarl.core.records.arrays import ZoneState
from cavmarl.driving.vehicles import GHOST_FIELDS, VEHICLE
from cavmarl.handoff.coordinator.row_digests import digest_tables
from cavmarl.handoff.kernels.invariant_checks import (
    FINDING,
    KIND_FAR,
    KIND_NONE,
    KIND_SUMS,
    KIND_TICK,
    TALLY,
    CheckTime,
    make_kept,
    make_strays,
    owner_hash,
    watch,
)
from cavmarl.shards.shard import make_zone_state
from cavmarl.zones.kernels.zone_lookup import Halo, zone_of
from cavmarl.zones.partition.zone_halo import zone_halo
from cavmarl.zones.partition.zone_partition import ZonePartition
from tests.naive import monitor as naive
from tests.naive.zones import distance

# In uncompiled kernels, NumPy warns of products that overflow, which is intended here.
pytestmark = pytest.mark.filterwarnings("ignore:overflow encountered in scalar:RuntimeWarning")

CAPACITY = 40
HALO_M = 30.0
LIMIT_M = 5.0
RECTS = [(0, 0, 100, 60), (100, 0, 160, 60), (0, 60, 100, 100), (100, 60, 160, 100)]
NAMES = {"tick": KIND_TICK, "far": KIND_FAR}

PARTITION = ZonePartition((0.0, 0.0, 160.0, 100.0), np.array(RECTS, dtype=np.float64))
HALO: Halo = zone_halo(PARTITION, HALO_M)
MASKS, FACTORS = digest_tables(GHOST_FIELDS)


class Looks:
    """A world that the kernel and its plain version check in every tick."""

    def __init__(self) -> None:
        self.zoned: ZoneState = make_zone_state(PARTITION.count, 1, CAPACITY)
        self.words = self.zoned.rows.view(np.uint64).reshape(*self.zoned.rows.shape, len(MASKS))
        self.kept, self.unused = (make_kept(PARTITION.count, CAPACITY) for _ in range(2))
        self.strays = make_strays(PARTITION.count, CAPACITY)
        self.found = np.zeros(1, dtype=FINDING)
        self.tallies = np.zeros(PARTITION.count, dtype=TALLY)
        self.foreign = np.zeros(
            PARTITION.count, dtype=np.uint64
        )  # added to the expected sums, to make them wrong
        self.before: dict[int, naive.Kept] = {}

    def put(self, zones: list[naive.Zone]) -> None:
        for z, zone in enumerate(zones):
            rows = np.concatenate([zone.owned, zone.ghosts])
            self.zoned.rows[0, z, 0, : len(rows)] = rows
            self.zoned.num_owned[z, 0], self.zoned.num_rows[z, 0] = len(zone.owned), len(rows)

    def look(
        self,
        zones: list[naive.Zone],
        tick: int,
        expected: NDArray[np.uint64],
        new_late: int = 1,
        missing: int = 0,
    ) -> int:
        """Run the kernel; return the kind (KIND_*) of its finding."""
        self.put(zones)
        told = watch(
            PARTITION.arrays, HALO, self.zoned, self.words, 0, 0,
            CheckTime(tick, new_late, LIMIT_M), MASKS, FACTORS, self.kept, self.unused, self.strays,
            sum(len(zone.owned) for zone in zones) + missing, expected,
            self.tallies, self.found,
        )  # fmt: skip
        self.kept, self.unused = self.unused, self.kept
        return told

    def compare(
        self, zones: list[naive.Zone], tick: int, new_late: int = 1, missing: int = 0
    ) -> dict[int, str]:
        """Check that kernel and plain version agree; `missing` more vehicles are expected."""
        masks, factors = MASKS.tolist(), FACTORS.tolist()
        tallies = naive.tallies(zones, PARTITION.reaching, HALO_M, masks, factors)
        expected = np.array([owned for _, owned, _, _ in tallies], dtype=np.uint64)
        told = self.look(zones, tick, expected + self.foreign, new_late, missing)
        wrong = naive.findings(zones, self.before, tick, new_late, LIMIT_M)
        kind, vehicle, _, _ = self.found[0].tolist()
        assert (kind == KIND_NONE) == (not wrong)
        sums_hold = not missing and not self.foreign.any()
        sums_hold = sums_hold and all(due == seen for _, _, due, seen in tallies)
        assert told == (kind if wrong or sums_hold else KIND_SUMS)
        if wrong:
            assert vehicle == min(wrong)
            assert kind == NAMES[wrong[vehicle]]
        assert self.tallies.tolist() == tallies
        vehicles = [int(row["id"]) for zone in zones for row in zone.owned]
        appeared = Counter(vehicles) - Counter(self.before.keys())
        assert self.entered() == sorted(appeared.elements())
        left = self.strays.left[: self.found["left"].item()].tolist()
        assert sorted(left) == sorted(self.before.keys() - set(vehicles))
        assert not self.strays.table["state"].any()
        self.before = {
            int(row["id"]): naive.Kept(row["x"], row["y"], int(tick - row["tick"]))
            for zone in zones
            for row in zone.owned
        }
        return wrong

    def entered(self) -> list[int]:
        """Return the vehicles that are new since the previous check."""
        return sorted(self.strays.entered[: self.found["entered"].item()].tolist())


def draw_vehicles(rng: np.random.Generator, number: int, tick: int) -> NDArray[np.void]:
    """Draw vehicles at random places; the rows of odd ids are one tick late."""
    rows = np.zeros(number, dtype=VEHICLE)
    rows["id"] = rng.choice(10_000, number, replace=False)
    rows["x"], rows["y"] = rng.uniform(0, 160, number), rng.uniform(0, 100, number)
    rows["speed"], rows["epoch"] = rng.uniform(0, 30, number), rng.integers(0, 9, number)
    rows["tick"] = tick - rows["id"] % 2
    return rows


def assign_to_zones(rows: NDArray[np.void]) -> list[naive.Zone]:
    """Assign each vehicle to the zone that contains it, with the ghosts that zones must have."""
    owners = np.array([zone_of(PARTITION.arrays, row["x"], row["y"]) for row in rows])
    result = []
    for z, rect in enumerate(PARTITION.reaching):
        near = np.array([distance(rect, row["x"], row["y"]) <= HALO_M for row in rows])
        result.append(naive.Zone(rows[owners == z], rows[near & (owners != z)]))
    return result


def move(rng: np.random.Generator, rows: NDArray[np.void], furthest_m: float) -> NDArray[np.void]:
    after = rows.copy()
    after["x"] += rng.uniform(-furthest_m, furthest_m, len(rows))
    after["tick"] += 1
    return after


def start(seed: int) -> tuple[Looks, np.random.Generator, NDArray[np.void]]:
    """Return a world at tick 10, the random generator, and the rows of the world."""
    rng = np.random.default_rng(seed)
    looks, rows = Looks(), draw_vehicles(rng, 25, 10)
    rows["tick"] = 10
    assert not looks.compare(assign_to_zones(rows), 10, new_late=0)
    return looks, rng, rows


@pytest.mark.parametrize("stay", [0.0, 0.8, 1.0], ids=["rows change", "few do", "rows stay"])
@pytest.mark.parametrize("seed", range(3))
def test_the_check_of_a_run_equals_its_plain_version(seed: int, stay: float) -> None:
    looks, rng, rows = start(seed)
    kinds: Counter[str] = Counter()
    for tick in range(11, 70):
        rows = move(rng, rows[rng.random(len(rows)) > 0.1], LIMIT_M + 0.1)
        new = draw_vehicles(rng, min(3, CAPACITY - len(rows)), tick)
        rows = np.concatenate([rows, new[~np.isin(new["id"], rows["id"])]])
        rows["tick"][rng.random(len(rows)) < 0.01] += 1
        if rng.random() > stay:
            rows = rng.permutation(rows)
        kinds.update(looks.compare(assign_to_zones(rows), tick).values())
    assert kinds["tick"] > 5
    assert kinds["far"] > 2


@pytest.mark.parametrize("name", ["x", "y"])
def test_a_vehicle_without_a_valid_position_is_detected(name: str) -> None:
    looks, rng, rows = start(7)
    zones = assign_to_zones(move(rng, rows, 1.0))
    lost = zones[2].owned[0]
    lost[name] = np.nan
    assert looks.look(zones, 11, looks.foreign) == KIND_FAR
    assert looks.found["vehicle"] == lost["id"]


def test_expected_and_present_sums_of_a_correct_state_are_equal() -> None:
    looks, rng, rows = start(7)
    assert not looks.compare(assign_to_zones(move(rng, rows, 1.0)), 11)
    assert (looks.tallies["due"] == looks.tallies["seen"]).all()
    assert looks.tallies["seen"].all()
    for z, zone in enumerate(assign_to_zones(rows)):
        hashes = (int(owner_hash(int(row["id"]), int(row["epoch"]))) for row in zone.owned)
        assert sum(hashes) % (1 << 64) == int(looks.tallies["owned"][z])


def test_a_zone_with_a_wrong_sum_of_owned_vehicles_is_detected() -> None:
    looks, rng, rows = start(7)
    looks.foreign[2] = 1
    assert not looks.compare(assign_to_zones(move(rng, rows, 1.0)), 11)


def test_a_missing_vehicle_is_detected() -> None:
    looks, rng, rows = start(7)
    assert not looks.compare(assign_to_zones(move(rng, rows, 1.0)), 11, missing=1)


def test_a_vehicle_with_two_owners_is_reported_as_entering_again() -> None:
    looks, rng, rows = start(8)
    zones = assign_to_zones(move(rng, rows, 1.0))
    doubled = zones[0].owned[:1]
    zones[2] = naive.Zone(np.concatenate([zones[2].owned, doubled]), zones[2].ghosts)
    looks.compare(zones, 11, new_late=0)
    assert looks.entered() == doubled["id"].tolist()


def test_a_vehicle_that_moves_into_two_zones_enters_once() -> None:
    looks, rng, rows = start(8)
    zones = assign_to_zones(move(rng, rows, 1.0))
    doubled = zones[0].owned[-1:]
    zones[0] = naive.Zone(zones[0].owned[:-1], zones[0].ghosts)
    for z in (1, 2):
        zones[z] = naive.Zone(np.concatenate([zones[z].owned, doubled]), zones[z].ghosts)
    looks.compare(zones, 11, new_late=0)
    assert looks.entered() == doubled["id"].tolist()


@pytest.mark.parametrize("name", ["x", "speed", "tick", "lane"])
def test_a_ghost_that_differs_from_the_owned_row_changes_the_sum(name: str) -> None:
    looks, rng, rows = start(9)
    zones = assign_to_zones(move(rng, rows, 1.0))
    ghosts: Any = zones[1].ghosts
    ghosts[name][0] += 1
    assert not looks.compare(zones, 11)
    assert (looks.tallies["due"] != looks.tallies["seen"]).tolist() == [False, True, False, False]


@pytest.mark.parametrize("name", ["hit", "events", "episode_return", "epoch"])
def test_fields_that_ghosts_do_not_need_may_differ(name: str) -> None:
    looks, rng, rows = start(9)
    zones = assign_to_zones(move(rng, rows, 1.0))
    zones[1].ghosts[name][0] += 1
    looks.compare(zones, 11)
    assert (looks.tallies["due"] == looks.tallies["seen"]).all()
