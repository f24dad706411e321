"""Transforms clouds to the frame of a map."""

from __future__ import annotations

import numpy as np

from cavmarl.core.errors import ConfigError, MapError
from cavmarl.maps.fidelity.cloud_files import Cloud
from cavmarl.maps.projection import project
from cavmarl.roads.network import RoadNetwork

FRAMES = ("map", "projected", "degrees", "swapped", "left-handed")


def in_map_frame(cloud: Cloud, frame: str, network: RoadNetwork | None) -> Cloud:
    """Return the cloud in the map's own x, y, z.

    Args:
        cloud: the cloud as read from its file.
        frame: `map`; `projected`, the map's projection without its offset; `degrees`, longitude,
            latitude, height; `swapped`, y before x; `left-handed`, with y to the south.
        network: the map; None: only frames that need no map are allowed.

    Raises:
        ConfigError: the frame is unknown.
        MapError: the frame needs a map with a projection.
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
                    f"{cloud.name}: frame '{frame}' needs a map with a georeference: build the map "
                    "with a projection, or give the cloud in the map's own frame"
                )
            geo = network.geo
            if frame == "degrees":
                points[:, :2] = project(cloud.name, points[:, :2], geo)
            else:
                points[:, :2] += np.array([geo.offset_x_m, geo.offset_y_m])
        case _:
            raise ConfigError(f"frame '{frame}': must be one of {', '.join(FRAMES)}")
    return Cloud(cloud.name, points, cloud.counts)
