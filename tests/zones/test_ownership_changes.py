"""Ownership changes in one call of the kernel: vehicles, order and records."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.records.arrays import ZoneState
from cavmarl.zones.kernels.borders import Borders
from cavmarl.zones.kernels.ownership_changes import (
    NOT_SEEN,
    BorderRecords,
    hand_over,
    look_on,
    make_book,
    release,
)
from tests.support.builders import vehicles
from tests.support.partitions import four
from tests.support.zoned import SIDE, exchanged

PARTITION = four(10.0, 10.0)
BORDERS = Borders(hysteresis_m=2.0, ahead_s=0.2, max_speed_mps=60.0)


def world(
    *places: tuple[float, float, float], ids: list[int], speed: float = 10.0
) -> tuple[ZoneState, BorderRecords]:
    """Create vehicles at (x, y, heading) that zone 0 owns at tick 7, with ghosts in all zones."""
    rows = vehicles(list(places), speed=speed, id=np.array(ids), epoch=4)
    book = make_book(1, 16)
    book.tick[0] = 6
    parts = [rows, *[rows[:0]] * 3]
    return exchanged(PARTITION, 60.0, parts, borders=BORDERS, book=book), book


def call(zoned: ZoneState, book: BorderRecords, check_all: bool = False, newborn: int = 0) -> int:
    arguments = (PARTITION.arrays, BORDERS, zoned, SIDE, 0)
    return int(hand_over(*arguments, check_all, newborn, book))


def next_tick(zoned: ZoneState, book: BorderRecords) -> None:
    """Begin the next tick and search for vehicles near borders; the test has moved the rows."""
    book.ms[0] += 1.0
    owned = zoned.num_owned[0, 0]
    zoned.num_border[:, 0] = [owned, 0, 0, 0]
    zoned.border[0, 0, :owned] = np.arange(owned)
    look_on(PARTITION.arrays, BORDERS, zoned, SIDE, 0, book)


def changes(book: BorderRecords) -> NDArray[np.void]:
    return book.changes[0, : book.num_changes[0]]


def coming(book: BorderRecords) -> list[tuple[int, int]]:
    turn = book.turn[0]
    entries = book.coming[0, turn, : book.num_coming[0, turn]]
    return [(int(entry["vehicle"]), int(entry["target"])) for entry in entries]


def test_vehicles_that_have_crossed_a_border_change_owners_in_the_order_of_their_ids() -> None:
    zoned, book = world((13.0, 5.0, 0.0), (5.0, 13.0, 0.0), (14.0, 5.0, 0.0), ids=[30, 20, 10])
    assert book.num_crossed[0] == 3
    assert call(zoned, book) == 3
    told = changes(book)
    assert told["vehicle"].tolist() == [10, 20, 30]
    assert told["target"].tolist() == [1, 2, 1]
    assert told["tick"].tolist() == [8, 8, 8]
    assert told["epoch"].tolist() == [5, 5, 5]
    assert told["switch_depth_m"].tolist() == [4.0, 3.0, 3.0]
    assert zoned.num_owned[:, 0].tolist() == [0, 2, 1, 0]
    for change in told:
        row = zoned.rows[SIDE, change["target"], 0, change["place"]]
        assert (row["id"], row["owner"], row["epoch"]) == (change["vehicle"], change["target"], 5)
    assert not coming(book)
    assert book.num_crossed[0] == 0


def test_a_vehicle_that_moved_into_a_freed_row_is_found() -> None:
    coming_in = vehicles([(13.0, 5.0, 0.0)], id=np.array([10]))
    leaving = vehicles([(7.0, 5.0, math.pi), (15.0, 5.0, 0.0)], id=np.array([20, 30]))
    book = make_book(1, 16)
    parts = [coming_in, leaving, coming_in[:0], coming_in[:0]]
    zoned = exchanged(PARTITION, 60.0, parts, borders=BORDERS, book=book)
    assert call(zoned, book) == 2
    assert [row["id"] for row in zoned.rows[SIDE, 1, 0, :2]] == [10, 30]
    assert changes(book)["vehicle"].tolist() == [10, 20]
    assert changes(book)["place"].tolist() == [0, 0]


def test_the_tick_of_the_approach_is_kept_until_the_owner_changes() -> None:
    zoned, book = world((9.5, 5.0, 0.0), ids=[3], speed=20.0)
    rows = zoned.rows[SIDE, 0, 0]
    for x in (11.0, 11.9, 12.5):
        assert book.num_crossed[0] == 0
        assert coming(book) == [(3, 1)]
        rows["x"][0] = zoned.rows[SIDE, 1, 0, 0]["x"] = x
        next_tick(zoned, book)
    assert call(zoned, book) == 1
    zoned.rows[SIDE, 1, 0, 0]["x"] = 14.5
    release(PARTITION.arrays, zoned, SIDE, 0, 1, 5.0, book)
    (change,) = changes(book)
    assert (change["approached"], change["tick"]) == (7, 11)
    assert change["ms"] == 5.0
    depths = [change[f"{name}_depth_m"] for name in ("prepare", "switch", "release")]
    assert depths == [-0.5, 2.5, 4.5]
    next_tick(zoned, book)
    assert book.acknowledged[0] == 4
    assert book.aborted[0] == 0


def test_a_vehicle_that_turns_away_is_counted_once_as_aborted() -> None:
    zoned, book = world((9.5, 5.0, 0.0), ids=[3], speed=20.0)
    zoned.rows[SIDE, 0, 0]["heading"][0] = math.pi
    for _ in range(3):
        next_tick(zoned, book)
        assert not coming(book)
    assert book.aborted[0] == 1


def test_a_repeated_search_in_one_tick_counts_each_vehicle_once() -> None:
    zoned, book = world((9.5, 5.0, 0.0), (9.0, 5.0, 0.0), ids=[3, 4], speed=20.0)
    next_tick(zoned, book)
    zoned.num_owned[0, 0] = 1  # the other vehicle has left
    for _ in range(3):
        assert call(zoned, book, check_all=True) == 0
        assert coming(book) == [(3, 1)]
        assert book.owned[0] == 1
    next_tick(zoned, book)
    assert (book.acknowledged[0], book.aborted[0]) == (2 + 1, 1)


def test_a_vehicle_that_has_just_entered_keeps_its_owner_for_one_tick() -> None:
    zoned, book = world((13.0, 5.0, 0.0), (14.0, 5.0, 0.0), ids=[3, 4])
    book.newborn[0, 0] = 3
    assert call(zoned, book, check_all=True, newborn=1) == 1
    assert changes(book)["vehicle"].tolist() == [4]
    next_tick(zoned, book)
    assert call(zoned, book) == 1
    assert changes(book)["vehicle"].tolist() == [4, 3]


def test_a_vehicle_that_leaves_in_the_tick_of_its_transfer_has_no_release_depth() -> None:
    zoned, book = world((13.0, 5.0, 0.0), ids=[3])
    assert call(zoned, book) == 1
    zoned.num_owned[1, 0] = 0
    release(PARTITION.arrays, zoned, SIDE, 0, 1, 1.0, book)
    assert math.isnan(changes(book)["release_depth_m"][0])


def test_a_vehicle_without_a_ghost_in_the_target_zone_is_not_handed_over() -> None:
    zoned, book = world((13.0, 5.0, 0.0), ids=[3])
    zoned.num_rows[1, 0] = 0
    assert call(zoned, book) == NOT_SEEN
    assert book.changes[0, 0]["vehicle"] == 3
    assert zoned.num_owned[:, 0].tolist() == [1, 0, 0, 0]
    assert book.num_changes[0] == 0
