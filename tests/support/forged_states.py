"""Values of fields of saved states that no table and no kernel allows."""

from __future__ import annotations

import numpy as np

MANY = 1 << 30
MOST = (1 << 63) - 1
ROW = {
    "lane": (-1, MANY),
    "lane_stood": (-2, MANY << 32),
    "side_lane": (-2, MANY),
    "target_lane": (-2, MANY),
    "vtype": (-1, 1),
    "driver": (-1, 2, 4, 5, 6),
    "link": (-2, MANY),
    "stopped_at": (-2, MANY),
    "hold": (-1, 4),
    "blinker": (-2, 2),
    "stop": (-2, MANY),
    "stops_end": (-2, MANY),
    "agent": (-2, 6),
    "goal": (-2, MANY),
    "leg": (-1,),
    "order": (-2, 0),
    "way": (-MANY, MANY, MOST, -MOST - 1),
    "id": (-1, MANY),
    "owner": (-1,),
    "epoch": (-1,),
    "transfer": (1,),
    "tick": (-1,),
    "x": (np.nan, np.inf, 1e30),
    "s": (np.nan, -np.inf, -1.0),
    "speed": (np.nan,),
    "heading": (np.inf,),
    "to_go": (np.nan,),
    "length": (0.0, -1.0, 100.0, np.nan),
    "height": (30.0,),
    "speed_factor": (0.0, -1.0),
    "wait_s": (-1.0,),
    "distance_m": (-1.0,),
    "throttle_1": (np.nan, np.inf),
    "speed_2": (np.nan, np.inf),
}
WAITING = {
    "lane": (-1, MANY),
    "vtype": (-1, 1),
    "agent": (-2, 6),
    "goal": (-2, MANY),
    "order": (-2, 0),
    "way": (-MANY, MANY, MOST, -MOST - 1),
    "stop": (-2, MANY),
    "id": (-1, MANY),
    "lane_code": (-6, 1),
    "pos_code": (-1, 6),
    "speed_code": (-1, 7),
    "pos": (np.nan,),
    "speed_factor": (np.inf, 0.0),
}
