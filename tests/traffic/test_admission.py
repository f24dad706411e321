"""The departure queue accepts or rejects the departures that the zones propose."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
from numpy.typing import NDArray

from cavmarl.core.records import codes
from cavmarl.core.records.arrays import DepartureQueue
from cavmarl.driving.vehicles import VEHICLE
from cavmarl.shards.shard import make_worlds
from cavmarl.traffic.departure_queue import make_departure_queue
from cavmarl.traffic.kernels.admission import accept, admit, assign_lanes
from cavmarl.zones.partition.zone_halo import zone_halo
from tests.support.builders import vehicles
from tests.support.partitions import four
from tests.support.traffic import network, travel

ROADS = network("merge")
MAIN = [ROADS.lane_ids.index(f"main_in_{k}") for k in range(2)]
FIRST_ID = 50


def queue_of(num_queue: int) -> DepartureQueue:
    """Return a departure queue of this length; the vehicle at position q has the id 50 + q."""
    departures = make_departure_queue(1, 12, ROADS.arrays, VEHICLE)
    departures.queue[0]["id"] = FIRST_ID + np.arange(12)
    departures.queue[0]["lane"] = MAIN[0]
    departures.queue[0]["lane_code"] = codes.LANE_GIVEN
    departures.num_queue[0] = num_queue
    return departures


def offer(departures: DepartureQueue, xs: Sequence[tuple[int, float]]) -> None:
    """Propose the departures (position in the queue, x) in the given order."""
    for n, (q, x) in enumerate(xs):
        departures.passing[0, n] = vehicles([(x, 0.0, 0.0)], id=FIRST_ID + q)[0]
        departures.places[0, n] = q
    departures.num_passing[0] = len(xs)


def passing(departures: DepartureQueue) -> list[int]:
    return [int(k) for k in departures.passing[0, : departures.num_passing[0]]["id"]]


def waiting(departures: DepartureQueue) -> list[int]:
    return [int(k) for k in departures.queue[0, : departures.num_queue[0]]["id"]]


def running(number: int) -> NDArray[np.int64]:
    return np.array([number], dtype=np.int64)


def test_proposals_are_accepted_in_the_order_of_the_queue() -> None:
    departures = queue_of(6)
    offer(departures, [(3, 300.0), (5, 500.0), (0, 0.0), (2, 200.0)])
    accept(departures, running(0), 100)
    assert passing(departures) == [50, 52, 53, 55]
    assert waiting(departures) == [51, 54]
    assert departures.counts[0, codes.COUNT_DEPARTED] == 4


@pytest.mark.parametrize("order", [(1, 0), (0, 1)])
def test_if_two_departures_would_touch_over_a_border_the_first_in_the_queue_enters(
    order: tuple[int, int],
) -> None:
    departures = queue_of(3)
    offer(departures, [(q, 4.0 * q) for q in order])
    accept(departures, running(0), 100)
    assert passing(departures) == [50]
    assert waiting(departures) == [51, 52]


@pytest.mark.parametrize(("present", "enter"), [(8, 2), (9, 1), (10, 0)])
def test_a_nearly_full_world_accepts_only_as_many_departures_as_fit(
    present: int, enter: int
) -> None:
    departures = queue_of(4)
    offer(departures, [(3, 300.0), (1, 100.0), (2, 200.0)])
    accept(departures, running(present), 10)
    assert passing(departures) == [51, 52][:enter]
    assert len(waiting(departures)) == 4 - enter
    assert waiting(departures) == sorted(waiting(departures))


def test_one_vehicle_per_tick_tries_to_enter_each_lane() -> None:
    departures = queue_of(4)
    departures.queue[0, :4]["lane"] = [MAIN[0], MAIN[0], MAIN[1], MAIN[0]]
    worlds = make_worlds(1, 12, ROADS)
    assign_lanes(ROADS.arrays, travel("merge"), departures, worlds.keys, worlds.lanes)
    assert departures.tries[0, :4].tolist() == [MAIN[0], -1, MAIN[1], -1]


def test_an_entered_vehicle_has_one_owner_and_is_a_ghost_nearby() -> None:
    # Four zones meet at (10, 20), with a halo of 5 m. The vehicles enter near that corner, near one
    # border, and far from all borders.
    partition = four()
    halo = zone_halo(partition, 5.0)
    entering = vehicles([(9.0, 19.0, 0.0), (12.0, 40.0, 0.0), (-30.0, -20.0, 0.0)], id=[7, 8, 9])
    owned: list[list[int]] = []
    ghosts: list[list[int]] = []
    for zone in range(4):
        worlds = make_worlds(1, 12, ROADS)
        worlds.next_rows[0, :2] = vehicles([(0.0, 0.0, 0.0)] * 2, id=[1, 2])
        worlds.num_owned[0], worlds.num_rows[0] = 1, 2
        departures = queue_of(0)
        departures.passing[0, :3] = entering
        departures.num_passing[0] = 3
        admit(partition.arrays, halo, zone, departures, worlds)
        ids = worlds.next_rows[0, : worlds.num_rows[0]]["id"].tolist()
        assert ids[0] == 1
        assert 2 in ids[worlds.num_owned[0] :]
        owned.append(sorted(ids[1 : worlds.num_owned[0]]))
        ghosts.append(sorted(set(ids[worlds.num_owned[0] :]) - {2}))
    assert owned == [[7, 9], [], [], [8]]
    assert ghosts == [[], [7], [7, 8], [7]]
