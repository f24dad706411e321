"""Reads an OpenDRIVE file with CARLA's own library. This program uses nothing of cavmarl.

    python client_map_reader.py map.xodr questions.json answers.json

`client_map_check` runs it with the Python of CARLA's client, in a process of its own, because the
library can abort its process. Poses are `[x, y, z, yaw]`, in m and degrees, in CARLA's frame.

Questions:
    places: a list of `[x, y, z]`.
    paths: a list of `[[x, y, z], distances_m]`.
    light_type: type of the signals that are traffic lights.
    before_lights, ahead_m: a list of `[x, y, z]`, and the distance within which lights ahead count.

Answers:
    nearest: for each place, the pose of the nearest lane for cars there, or None.
    in_junction: for each place, whether this lane is in a junction.
    reached: for each path, the poses at these distances from its place along the lanes.
    lights: for each place before lights, the number of traffic lights ahead on its lane.
    landmarks: number of traffic lights of the map.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any


def _pose(waypoint: Any) -> list[float]:
    place, rotation = waypoint.transform.location, waypoint.transform.rotation
    return [place.x, place.y, place.z, rotation.yaw]


def read(carla: Any, document: str, questions: dict[str, Any]) -> dict[str, Any]:
    """Return the answers; `carla` is the module of CARLA's client."""
    road_map = carla.Map("map", document)

    def nearest(place: list[float]) -> Any:
        return road_map.get_waypoint(carla.Location(*place), lane_type=carla.LaneType.Driving)

    waypoints = [nearest(place) for place in questions["places"]]
    starts = [(nearest(place), distances_m) for place, distances_m in questions["paths"]]
    ahead_m, light_type = questions["ahead_m"], questions["light_type"]
    return {
        "nearest": [point and _pose(point) for point in waypoints],
        "in_junction": [point is not None and point.is_junction for point in waypoints],
        "reached": [
            [_pose(point) for far_m in distances_m if start for point in start.next(far_m)]
            for start, distances_m in starts
        ],
        "lights": [
            len(point.get_landmarks_of_type(ahead_m, light_type, False)) if point else 0
            for point in map(nearest, questions["before_lights"])
        ],
        "landmarks": len(road_map.get_all_landmarks_of_type(light_type)),
    }


def main() -> None:
    import carla  # type: ignore[import-not-found, unused-ignore]

    document, questions, answers = map(Path, sys.argv[1:])
    asked = json.loads(questions.read_text(encoding="utf-8"))
    found = read(carla, document.read_text(encoding="utf-8"), asked)
    answers.write_text(json.dumps(found), encoding="utf-8")


if __name__ == "__main__":
    main()
