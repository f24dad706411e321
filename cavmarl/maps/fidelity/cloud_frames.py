"""Clouds brought into the frame of a map."""

from __future__ import annotations

import numpy as np

from cavmarl.core.errors import ConfigError, MapError
from cavmarl.maps.fidelity.cloud_files import Cloud
from cavmarl.maps.projection import project
from cavmarl.roads.network import RoadNetwork

FRAMES = ("map", "projected", "degrees", "swapped", "left-handed")


def in_map_frame(cloud: Cloud, frame: str, network: RoadNetwork | None) -> Cloud:
    """The cloud in the map's own x, y, z.

    Args:
        cloud: as its file has it.
        frame: `map`; `projected`, the map's projection without its offset; `degrees`, longitude,
            latitude, height; `swapped`, y before x; `left-handed`, with y to the south.
        network: the map; None: only frames that need none.

    Raises:
        ConfigError: no such frame.
        MapError: the frame needs a map's projection, and there is none.
    """
    points = cloud.points.copy()
    match frame:
        case "map":
            return cloud
        case "swapped":
            points = points[:, [1, 0, 2]]
        case "left-handed":
            points[:, 1] *= -1.0
        case "projected" | "degrees":
            if network is None or network.geo is None:
                raise MapError(
                    f"{cloud.name}: is {frame}, and the map does not say where it lies: build it "
                    "with a projection, or give the cloud in the map's own frame"
                )
            geo = network.geo
            if frame == "degrees":
                points[:, :2] = project(cloud.name, points[:, :2], geo)
            else:
                points[:, :2] += np.array([geo.offset_x_m, geo.offset_y_m])
        case _:
            raise ConfigError(f"frame '{frame}': is none of {', '.join(FRAMES)}")
    return Cloud(cloud.name, points, cloud.counts)
