"""What a ray, a pixel or a cell shows, as small integers: the classes of all imaging sensors."""

from __future__ import annotations

NOTHING = 0  # the sky, or nothing in range
GROUND = 1  # beside the roads
ROAD = 2  # lanes and junctions
LANE_LINE = 3  # the edges of lanes, in the bird's-eye grid
BUILDING = 4
CAR = 5
TRUCK = 6
BUS = 7
TRAM = 8
MOTORCYCLE = 9
BICYCLE = 10
PEDESTRIAN = 11

SEMANTIC_NAMES = (
    "nothing",
    "ground",
    "road",
    "lane line",
    "building",
    "car",
    "truck",
    "bus",
    "tram",
    "motorcycle",
    "bicycle",
    "pedestrian",
)
NUM_SEMANTICS = len(SEMANTIC_NAMES)

# By SUMO's abstract vehicle class; those of one shape look the same.
SEMANTIC_OF_CLASS = {
    "passenger": CAR,
    "taxi": CAR,
    "delivery": TRUCK,
    "emergency": TRUCK,
    "truck": TRUCK,
    "bus": BUS,
    "tram": TRAM,
    "motorcycle": MOTORCYCLE,
    "bicycle": BICYCLE,
    "pedestrian": PEDESTRIAN,
}
