"""`VEHICLE`: the complete state of one vehicle, as one record.

A shard (the part of a world in one zone) has one array of these records: rows that the zone owns,
then ghosts (copies of rows of other zones). A vehicle moves to another zone as a copy of its
record, and messages contain the bytes of records. So a record contains more than the next tick
needs: ownership, random stream, sensor phase and return. The delayed commands of agents are stored
in `Worlds.pending`: most vehicles have none, and every tick copies the rows.

Frames are as in `roads.network`: x, y, z is the centre of the body; the heading is
counter-clockwise from east; `s` and `d` are the centre's position on the lane, d positive to the
left. Indices that refer to nothing are -1. The codes (DRIVER_*, HOLD_*, EVENT_*) are defined in
`records.codes`. Units are metres, seconds and radians unless the name states another unit.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

RECORD_VERSION = 4

# The fields are ordered by use: fields that drivers read of other vehicles come first and share two
# cache lines; fields that are rarely read come last.
VEHICLE = np.dtype(
    [
        # position on the lane
        ("id", np.int64),  # assigned by the coordinator, unique in a run; breaks all ties
        ("s", np.float64),
        ("d", np.float64),
        ("speed", np.float64),  # m/s along the heading; negative backwards
        ("length", np.float64),
        ("lane", np.int32),
        ("side_lane", np.int32),  # neighbour lane that the body also covers
        ("vtype", np.int32),  # VTYPE row
        ("driver", np.int32),  # DRIVER_*
        ("way", np.int64),  # offset of the plan in the table of steps, see `route_following`
        # state of the driver
        ("speed_factor", np.float64),  # desired speed divided by the speed limit
        ("wait_s", np.float64),  # time since the vehicle stopped
        ("rng_key", np.uint64),  # random numbers are a function of (rng_key, id, tick, stream)
        ("link", np.int32),  # link that the vehicle is on, or that it entered last
        ("hold", np.int32),  # HOLD_*
        ("stopped_at", np.int32),  # link of the last stop; for agents, only at a stop sign
        ("blinker", np.int32),  # desired lane change: 1 left, -1 right
        ("stop", np.int32),  # STOP row of the next stop; -1 or stops_end: none
        ("stops_end", np.int32),
        ("stopped_s", np.float64),  # time spent at that stop
        ("last_change", np.int64),  # tick of the last lane change
        # kinematics
        ("x", np.float64),
        ("y", np.float64),
        ("z", np.float64),
        ("heading", np.float64),  # rad, in (-pi, pi]
        ("pitch", np.float64),  # rad, positive uphill
        ("accel", np.float64),  # m/s², in the last tick
        ("yaw_rate", np.float64),  # rad/s, in the last tick
        ("jerk", np.float64),  # m/s³, change of accel over the last tick
        ("width", np.float64),
        ("height", np.float64),
        # control
        ("throttle", np.float64),  # commanded acceleration, m/s²; negative brakes
        ("steering", np.float64),  # front wheel angle, rad
        ("target_speed", np.float64),  # target of the speed controller, m/s
        # clock and totals
        ("tick", np.int64),  # world tick to which this state belongs
        ("to_go", np.float64),  # remaining distance to the goal, along the plan, m
        ("distance_m", np.float64),  # driven since departure
        # time in s that the driven distance takes at `free_speed`: the speed limit (of background
        # vehicles: times the speed factor), but at most the type's maximum speed
        ("free_s", np.float64),
        ("step_to_go", np.float64),  # to_go at the start of the current step
        ("step_jerk", np.float64),  # integral of |jerk| over the current step, m/s²
        ("hit", np.int64),  # id of the other vehicle of a collision
        ("events", np.int32),  # EVENT_* bits of the current step
        ("target_lane", np.int32),  # target of the lane controller or of the current lane change
        # trip
        ("agent", np.int32),  # index of the PettingZoo agent that drives it
        # row of the table of plans; for vehicles of a demand file, row of their detours; for
        # scripted vehicles, the current FRAME
        ("goal", np.int32),
        ("leg", np.int32),  # number of previous routes
        # DEPARTURE row of a demand file, SUMO's number, or a caller's slot; -1: generated vehicle
        ("order", np.int32),
        ("departed", np.int64),  # tick of insertion
        ("due", np.int64),  # tick at which an agent's trip is cut off; -1: none
        # ownership and transfer
        ("owner", np.int32),  # zone that may change this row
        ("source_zone", np.int32),  # source of the transfer in progress
        ("target_zone", np.int32),
        ("epoch", np.int32),  # number of changes of owner
        ("transfer", np.int32),  # AUTHORITATIVE; other values are reserved
        # memory; sensor_phase and episode_return: agents' vehicles only
        ("sensor_phase", np.int32),  # ticks until slow sensors fire; reserved: all fire each step
        ("episode_return", np.float64),  # sum of rewards since the agent got this vehicle
        # time stopped on the current lane: LANE · 2³² + ticks; -1: not counted (`lane_counts`)
        ("lane_stood", np.int64),
        # memory of a network that drives a background vehicle: throttle, steering and speed at the
        # ends of the second-last and third-last step, scaled as in the sensor `history`
        ("throttle_1", np.float32),
        ("steering_1", np.float32),
        ("speed_1", np.float32),
        ("throttle_2", np.float32),
        ("steering_2", np.float32),
        ("speed_2", np.float32),
    ],
    align=True,
)

# Fields about the storage of the row and not about the vehicle: not part of the state's hash.
PLACEMENT_FIELDS = ("owner", "source_zone", "target_zone", "epoch", "transfer")

# Fields of the state's hash, in record order.
STATE_FIELDS = tuple(name for name in VEHICLE.names or () if name not in PLACEMENT_FIELDS)


# Fields used only by vehicles with a network (`networks.background_driver`); 0 in all others.
MEMORY_FIELDS = tuple(name for name in STATE_FIELDS if name.endswith(("_1", "_2")))

# Fields that are equal in a ghost and in the owner's row of the same tick. Contacts and rewards are
# written after ghosts are sent, and are never read from a ghost.
GHOST_FIELDS = tuple(
    name
    for name in STATE_FIELDS
    if name not in ("hit", "events", "episode_return", "lane_stood", *MEMORY_FIELDS)
)

# Fields that are -1 in a new vehicle.
_NOTHING = (
    "agent",
    "source_zone",
    "target_zone",
    "side_lane",
    "link",
    "stopped_at",
    "hit",
    "last_change",
    "due",
    "lane_stood",
    "order",
    "stop",
    "stops_end",
)


def blank_vehicle() -> NDArray[np.void]:
    """Return VEHICLE (1,): the initial record of a new vehicle, a passenger car.

    Its size is that of highway-env's car (5 m × 2 m).
    """
    blank = np.zeros(1, dtype=VEHICLE)
    for name in _NOTHING:
        blank[name] = -1
    blank["length"] = 5.0
    blank["width"] = 2.0
    blank["height"] = 1.6
    blank["speed_factor"] = 1.0
    return blank
