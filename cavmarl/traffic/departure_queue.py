"""`DEPARTURE`, the record of a vehicle that waits to enter, and the queue of such records."""

from __future__ import annotations

from typing import Any

import numpy as np

from cavmarl.core.records import record
from cavmarl.core.records.arrays import DepartureQueue, RoadArrays
from cavmarl.core.records.codes import NUM_COUNTS, NUM_SUMS

DEPARTURE = record(
    ("id", np.int64),  # vehicle id; the queue is sorted by it
    ("due", np.int64),  # tick of departure
    ("way", np.int64),  # as VEHICLE["way"]; the vehicle starts on the first edge
    ("agent", np.int32),  # index of the agent that will drive the vehicle, or -1
    ("order", np.int32),  # row in `DepartureQueue.orders`; -1: ordered by the generator
    ("vtype", np.int32),  # VTYPE row
    ("goal", np.int32),  # row of the table of plans; -1: the end of the vehicle's route
    ("lane", np.int32),  # LANE row where the vehicle enters, or any lane of that edge
    ("stop", np.int32),  # STOP rows [stop, stops_end)
    ("stops_end", np.int32),
    ("lane_code", np.int8),  # LANE_*
    ("pos_code", np.int8),  # POS_*
    ("speed_code", np.int8),  # SPEED_*
    ("pos", np.float64),  # position of the front bumper in m; negative: from the end of the lane
    ("speed", np.float64),  # m/s
    ("speed_factor", np.float64),  # desired speed divided by the speed limit
)


def make_departure_queue(
    num_worlds: int, capacity: int, roads: RoadArrays, vehicle: np.dtype[np.void]
) -> DepartureQueue:
    """Return empty queues for `num_worlds` worlds, each with room for `capacity` vehicles."""
    return DepartureQueue(
        orders=np.zeros((num_worlds, 0), dtype=DEPARTURE),
        num_orders=np.zeros(num_worlds, dtype=np.int64),
        next_order=np.zeros(num_worlds, dtype=np.int64),
        queue=np.zeros((num_worlds, capacity), dtype=DEPARTURE),
        num_queue=np.zeros(num_worlds, dtype=np.int64),
        next_id=np.zeros(num_worlds, dtype=np.int64),
        num_entered=np.zeros(num_worlds, dtype=np.int64),
        counts=np.zeros((num_worlds, NUM_COUNTS), dtype=np.int64),
        sums=np.zeros((num_worlds, NUM_SUMS), dtype=np.float64),
        num_passing=np.zeros(num_worlds, dtype=np.int64),
        lane_taken=np.zeros(len(roads.lanes), dtype=np.bool_),
        spare=np.zeros(1, dtype=vehicle),
        **_room(num_worlds, capacity, int(roads.edges["num_lanes"].max()), vehicle),
    )


def _room(
    num_worlds: int, waiting: int, num_lanes: int, vehicle: np.dtype[np.void]
) -> dict[str, Any]:
    return {
        "passing": np.zeros((num_worlds, waiting), dtype=vehicle),
        "places": np.zeros((num_worlds, waiting), dtype=np.int64),
        "tries": np.zeros((num_worlds, waiting), dtype=np.int32),
        "ranks": np.zeros((num_worlds, waiting, num_lanes), dtype=np.int64),
        "last_s": np.zeros((num_worlds, waiting, num_lanes)),
    }


def with_room(departures: DepartureQueue, num_orders: int) -> DepartureQueue:
    """Return the queue with room for at least `num_orders` orders, even if all of them wait."""
    num_worlds, present = departures.orders.shape
    more = num_orders - present
    if more <= 0:
        return departures
    room = np.zeros((num_worlds, more), dtype=DEPARTURE)
    queue = np.concatenate([departures.queue, room], axis=1)
    return departures._replace(
        orders=np.concatenate([departures.orders, room], axis=1),
        queue=queue,
        **_room(num_worlds, queue.shape[1], departures.ranks.shape[2], departures.passing.dtype),
    )
