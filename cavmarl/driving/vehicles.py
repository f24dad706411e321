"""`VEHICLE`: everything that is known of one vehicle, as one record.

A shard holds one array of these: owned rows first, ghosts after. Migration is a row assignment, a
snapshot a copy, a halo a slice, the wire format the bytes. So the record carries more than the next
tick needs: ownership, the random stream, sensor phase and returns travel with the row. An agent's
delayed commands lie apart, in `Worlds.pending`: most vehicles have none, and every tick copies the
rows.

Frames as in `roads.network`: x, y, z is the centre of the body; heading counter-clockwise from
east; `s` and `d` are the centre's place on the lane, d positive to the left. Indices that point at
nothing are -1. The codes (DRIVER_*, HOLD_*, EVENT_*) are those of `records.codes`. Units: metres,
seconds and radians unless the name says otherwise.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

RECORD_VERSION = 2

# The order is that of use: what every driver asks of every other comes first and shares two cache
# lines, what only some ask comes last.
VEHICLE = np.dtype(
    [
        # where it is on its lane
        ("id", np.int64),  # given by the coordinator, never used twice in a run; orders all ties
        ("s", np.float64),
        ("d", np.float64),
        ("speed", np.float64),  # m/s along the heading; negative backwards
        ("length", np.float64),
        ("lane", np.int32),
        ("side_lane", np.int32),  # neighbour lane that the body also covers
        ("vtype", np.int32),  # VTYPE row: how it drives
        ("driver", np.int32),  # DRIVER_*
        ("way", np.int64),  # where the step of its lane stands, see kernels.ways
        # driver's mind (agent-logic state)
        ("speed_factor", np.float64),  # desired speed over the limit
        ("wait_s", np.float64),  # how long it has stood still
        ("rng_key", np.uint64),  # its random numbers: a function of (rng_key, id, tick, stream)
        ("link", np.int32),  # link it is on, or has entered last
        ("hold", np.int32),  # HOLD_*
        ("stopped_at", np.int32),  # link before which it has stood last; an agent's: at a stop sign
        ("blinker", np.int32),  # lane change wanted: 1 left, -1 right
        ("stop", np.int32),  # STOP row that it makes next; -1 or stops_end: none
        ("stops_end", np.int32),
        ("stopped_s", np.float64),  # how long it has stood there
        ("last_change", np.int64),  # tick of its last lane change
        # kinematics
        ("x", np.float64),
        ("y", np.float64),
        ("z", np.float64),
        ("heading", np.float64),  # rad, in (-pi, pi]
        ("pitch", np.float64),  # rad, positive uphill
        ("accel", np.float64),  # m/s², of the last tick
        ("yaw_rate", np.float64),  # rad/s, of the last tick
        ("jerk", np.float64),  # m/s³, change of accel over the last tick
        ("width", np.float64),
        ("height", np.float64),
        # control
        ("throttle", np.float64),  # commanded acceleration, m/s²; negative brakes
        ("steering", np.float64),  # front wheel angle, rad
        ("target_speed", np.float64),  # of the speed controller, m/s
        # clock and accounts
        ("tick", np.int64),  # the world's tick that this state belongs to
        ("to_go", np.float64),  # m left to the goal, along the plan
        ("distance_m", np.float64),  # driven since departure
        ("free_s", np.float64),  # s that the driven way would take at the limit; of a background
        # vehicle, times its speed factor
        ("step_to_go", np.float64),  # to_go when the current step began
        ("step_jerk", np.float64),  # integral of |jerk| over the current step, m/s²
        ("hit", np.int64),  # id of the vehicle it collided with
        ("events", np.int32),  # EVENT_* bits of the current step
        ("target_lane", np.int32),  # of the lane controller or lane change in progress
        # where it comes from and goes to
        ("agent", np.int32),  # index of the PettingZoo agent that drives it
        ("goal", np.int32),  # row of the plans' table; of demand vehicles that of their detours; of
        # scripted vehicles the FRAME that they are at
        ("leg", np.int32),  # how many ways it has had before
        ("order", np.int32),  # DEPARTURE row of the demand file's orders; -1: of the generator
        ("departed", np.int64),  # tick of insertion
        ("due", np.int64),  # tick at which an agent's trip is cut; -1: none
        # ownership and transfer
        ("owner", np.int32),  # zone that may change this row
        ("source_zone", np.int32),  # of the transfer in flight
        ("target_zone", np.int32),
        ("epoch", np.int32),  # how often it has changed owner
        ("transfer", np.int32),  # AUTHORITATIVE, or a state of the protocol
        # what an agent's vehicle carries
        ("sensor_phase", np.int32),  # ticks until slow sensors fire; reserved: all fire each step
        ("episode_return", np.float64),  # sum of rewards since it was seated
        ("memory", np.int64),  # handle of a recurrent policy's state; reserved
    ],
    align=True,
)

# Fields that say where the row lives and not what the vehicle is: not part of the state's hash.
PLACEMENT_FIELDS = ("owner", "source_zone", "target_zone", "epoch", "transfer")

# Fields of the state's hash, in record order.
STATE_FIELDS = tuple(name for name in VEHICLE.names or () if name not in PLACEMENT_FIELDS)


# Fields that a ghost has in common with its owner's row of the same tick. Contacts and rewards are
# written after ghosts are sent, and are never read from a ghost.
GHOST_FIELDS = tuple(
    name for name in STATE_FIELDS if name not in ("hit", "events", "episode_return")
)

# Fields of a new vehicle that point at nothing.
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
    "memory",
    "order",
    "stop",
    "stops_end",
)


def blank_vehicle() -> NDArray[np.void]:
    """VEHICLE (1,): the record that a new vehicle starts from, a passenger car.

    The size is highway-env's (5 m × 2 m).
    """
    blank = np.zeros(1, dtype=VEHICLE)
    for name in _NOTHING:
        blank[name] = -1
    blank["length"] = 5.0
    blank["width"] = 2.0
    blank["height"] = 1.6
    blank["speed_factor"] = 1.0
    return blank
