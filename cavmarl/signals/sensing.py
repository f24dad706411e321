"""What observes the lanes of signals, made from the settings."""

from __future__ import annotations

import numpy as np

from cavmarl.config.signals import SignalsConfig
from cavmarl.roads.network import RoadNetwork
from cavmarl.roads.signal_places import place_of_signal
from cavmarl.signals.kernels.camera_counts import IN_RANGE, Cameras
from cavmarl.signals.signal_table import SignalTable


def make_cameras(
    config: SignalsConfig, network: RoadNetwork, table: SignalTable, most_vehicles: int
) -> Cameras:
    """Return the cameras of all signals, for worlds of at most `most_vehicles`."""
    places = np.array([place_of_signal(network, row) for row in table.arrays.row.tolist()])
    places[:, 2] += config.camera_height_m
    return Cameras(
        posts=table.posts,
        places=places,
        range_m=config.camera_range_m,
        misses=config.camera_misses,
        in_range=np.zeros(most_vehicles, dtype=IN_RANGE),
        first=np.zeros(len(places), dtype=np.int32),
    )
