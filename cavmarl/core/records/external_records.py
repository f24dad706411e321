"""`EXTERNAL`: commands to vehicles that the caller poses or drives."""

from __future__ import annotations

import numpy as np

# EXTERNAL["kind"]
EXTERNAL_NONE = 0.0  # no new command; in the state: no vehicle
EXTERNAL_POSED = 1.0  # at the given pose at the end of the step
EXTERNAL_DRIVEN = 2.0  # kinematic bicycle, driven by throttle and steering
EXTERNAL_REMOVED = 3.0

# Ids of external vehicles begin here, so that the ids of other vehicles do not depend on them. The
# lowest 31 bits, which are the ids of ROS markers, are also unique.
FIRST_EXTERNAL_ID = (1 << 40) + (1 << 30)


def first_external_id(tick: int, slots: int) -> int:
    """Return the id of a vehicle that enters slot 0 in a tick; `slots`: number of all slots."""
    return FIRST_EXTERNAL_ID + int(tick) * slots


# All fields are float64, so that commands are plain arrays (W, E, K) between processes. A vehicle
# enters with the first command of its slot, at the pose of that command and with its body.
EXTERNAL = np.dtype(
    [
        (name, np.float64)
        for name in (
            "kind",  # EXTERNAL_*
            "x",  # position of the centre, m
            "y",
            "z",  # m; NaN: the height of the lane
            "heading",  # rad
            "pitch",  # rad; NaN: the slope of the lane
            "speed",  # m/s along the heading; NaN: speed of the move to the pose
            "throttle",  # m/s², of a driven vehicle
            "steering",  # rad, of a driven vehicle
            "vtype",  # VTYPE row
            "length",  # m
            "width",
            "height",
            "observes",  # 1: it carries the sensors of `rig`, and is an agent; 0: it does not
        )
    ]
)
EXTERNAL_FIELDS = len(EXTERNAL.names or ())
