"""pufferlib's `drive` observation: the vehicle, others within 50 m, road segments around it."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from cavmarl.config.env import SensorsConfig
from cavmarl.roads.network import RoadNetwork
from cavmarl.sensors.kernels.puffer_drive_kernel import (
    CELL_M,
    PARTNERS_RANGE_M,
    ROAD_SEGMENT,
    SPIRAL_CELLS,
)
from cavmarl.sensors.kernels.sensor_arrays import PufferDrive, RoadSegments
from cavmarl.sensors.observed.feature import Feature
from cavmarl.sensors.observed.road_segments import road_segments

__all__ = ["features", "reach_m", "settings"]

# The vehicle's own cell and ten more, along both axes, in units of 50 m.
_FURTHEST = math.hypot(1.0, 1.0) * (SPIRAL_CELLS + 1) / 2 * float(CELL_M) / 50.0

_OWN = (
    ("goal_x", "forward place of the goal, ego frame", "200 m", -math.inf, math.inf),
    ("goal_y", "place of the goal to the left, ego frame", "200 m", -math.inf, math.inf),
    ("speed", "speed", "100 m/s", 0.0, 1.0),
    ("width", "width", "15 m", 0.0, math.inf),
    ("length", "length", "30 m", 0.0, math.inf),
    ("collided", "1 if it touched another in this step", "", 0.0, 1.0),
)
_PARTNER = (
    ("x", "forward place, ego frame", "50 m", -1.0, 1.0),
    ("y", "place to the left, ego frame", "50 m", -1.0, 1.0),
    ("width", "width", "15 m", 0.0, math.inf),
    ("length", "length", "30 m", 0.0, math.inf),
    ("cos", "cosine of its heading minus the own one", "", -1.0, 1.0),
    ("sin", "sine of its heading minus the own one", "", -1.0, 1.0),
    ("speed", "speed", "100 m/s", 0.0, 1.0),
)
_SEGMENT = (
    ("x", "forward place of its middle, ego frame", "50 m", -_FURTHEST, _FURTHEST),
    ("y", "place of its middle to the left, ego frame", "50 m", -_FURTHEST, _FURTHEST),
    ("length", "half its length", "100 m", 0.0, 1.0),
    ("width", "0.1 m", "100 m", 0.0, 1.0),
    ("cos", "cosine of its direction minus the own heading", "", -1.0, 1.0),
    ("sin", "sine of its direction minus the own heading", "", -1.0, 1.0),
    ("type", "0 middle of a lane, 1 line between lanes, 2 edge of a road", "", 0.0, 2.0),
)


def features(config: SensorsConfig) -> list[Feature]:
    """6 numbers of its own, 7 a partner, 7 a segment; all 0 where there are fewer."""
    drive = config.puffer_drive
    if not drive.enabled:
        return []
    return [
        *(Feature(*own) for own in _OWN),
        *(
            Feature(f"{kind}_{name}_{k}", f"{kind} {k}: {meaning}", scale, low, high)
            for kind, count, rows in (
                ("partner", drive.partners, _PARTNER),
                ("segment", drive.segments, _SEGMENT),
            )
            for k in range(count)
            for name, meaning, scale, low, high in rows
        ),
    ]


def reach_m(config: SensorsConfig) -> float:
    """How far partners are seen, if it is on."""
    return PARTNERS_RANGE_M if config.puffer_drive.enabled else 0.0


def settings(
    config: SensorsConfig, at: int, network: RoadNetwork, goals: NDArray[np.float64]
) -> PufferDrive:
    """What the kernel takes; `goals` are the places of `highway.goal_places`.

    Raises:
        ConfigError: the map is too large.
    """
    drive = config.puffer_drive
    on = drive.enabled
    return PufferDrive(
        on=on,
        at=at,
        destinations=goals,
        roads=road_segments(network, drive.spacing_m, drive.segments) if on else _no_segments(),
        near_body=np.zeros(drive.partners, dtype=np.int64),
    )


def _no_segments() -> RoadSegments:
    list_start = np.zeros(2, dtype=np.int64)
    lists = np.zeros(0, dtype=np.uint32)
    segments = np.zeros(0, dtype=ROAD_SEGMENT)
    for array in (list_start, lists, segments):
        array.setflags(write=False)
    return RoadSegments(0.0, 0.0, 1, 1, list_start, lists, segments)
