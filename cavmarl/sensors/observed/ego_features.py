"""What the sensors that tell of the way, the traffic and the messages around a vehicle observe.

The scales are those of `sensors/kernels/sense.py`, `observing_lanes.py` and
`observing_messages.py`. A sensor that is off has no features.
"""

from __future__ import annotations

from collections.abc import Iterable

from cavmarl.config.sensors import SensorsConfig
from cavmarl.sensors.kernels.observing_lanes import HALF_M
from cavmarl.sensors.observed.feature import Feature

Row = tuple[str, str, str]  # name, meaning and scale of a feature

_EGO = (
    ("speed", "speed along the heading", "40 m/s"),
    ("accel", "acceleration of the last tick", "10 m/s²"),
    ("steering", "front wheel angle, left positive", "pi/4 rad"),
    ("yaw_rate", "turning rate, left positive", "1 rad/s"),
    ("lateral_offset", "place beside the lane's middle, left positive", "4 m"),
    ("heading_error", "heading minus the lane's direction, left positive", "pi rad"),
    ("speed_limit", "limit of the lane", "40 m/s"),
    ("left_lane", "1 if there is a lane to the left", ""),
    ("right_lane", "1 if there is a lane to the right", ""),
    ("lane_change", "side that the plan asks to change to: 1 left, -1 right, 0 none", ""),
    ("room", "way that this lane can be followed before a change is needed", "200 m"),
    ("to_go", "way left to the goal", "1000 m"),
    ("target_speed", "target of the speed controller (discrete actions)", "40 m/s"),
)

_SIZE = (
    ("length", "length of the own body", "20 m"),
    ("width", "width of the own body", "4 m"),
    ("wheelbase", "way between its axles", "10 m"),
    ("most_steering", "most that its front wheels turn; 1: as the action says", "pi/4 rad"),
    ("most_accel", "most that it can accelerate; 1: as the action says", "10 m/s²"),
    ("most_decel", "most that it can brake; 1: as the action says", "10 m/s²"),
    ("most_speed", "most that it can drive", "40 m/s"),
)

# As `kernels.observing_lanes` scales ways.
_NEARNESS = f"{HALF_M:g} m / ({HALF_M:g} m + way)"
_GAPS = (
    ("ahead", "the vehicle ahead on the own way"),
    ("left_ahead", "the vehicle ahead on the lane to the left"),
    ("left_behind", "the vehicle behind on the lane to the left"),
    ("right_ahead", "the vehicle ahead on the lane to the right"),
    ("right_behind", "the vehicle behind on the lane to the right"),
)
_CROSSING = (
    ("crossing", "1 if a vehicle that goes first crosses the next junction's link", ""),
    ("crossing_way", f"how near the place is where both cross: {_NEARNESS}", ""),
    ("crossing_other", f"how near that vehicle is to it: {_NEARNESS}", ""),
    ("crossing_speed", "that vehicle's speed", "40 m/s"),
)

_SIGNAL_TIMING = (
    ("change", "how soon the signal changes: 5 s / (5 s + time)", ""),
    ("reach", "how soon the line is reached at the present speed, likewise", ""),
)

_HEARD_SIGNAL = (
    ("signal_known", "1 if the unit at the next signal was heard", ""),
    ("signal_go", "1 if it is green on the own way", ""),
    ("signal_soon", "how soon the phase ends: 5 s / (5 s + time)", ""),
    ("signal_age", "how old that is", "1 s"),
)


def _features(rows: Iterable[Row]) -> list[Feature]:
    return [Feature(*row) for row in rows]


def _numbered(count: int, subject: str, rows: Iterable[Row]) -> list[Feature]:
    """The rows of each of several things, one thing after the other."""
    listed = list(rows)
    return [
        Feature(f"{name}_{k}", f"{subject.format(k)}: {meaning}", scale)
        for k in range(count)
        for name, meaning, scale in listed
    ]


def ego(config: SensorsConfig) -> list[Feature]:
    """The vehicle itself, its lane, and what the plan asks of it."""
    if not config.ego.enabled:
        return []
    return _features((*_EGO, *(_SIZE if config.ego.size else ())))


def route(config: SensorsConfig) -> list[Feature]:
    """X (forward) and y (left) of points of the way ahead in the ego frame."""
    route = config.route
    scale = f"{route.points * route.spacing_m:g} m"
    return [
        Feature(
            f"{axis}_{k}",
            f"{side} of the point {(k + 1) * route.spacing_m:g} m along the way, ego frame",
            scale,
        )
        for k in range(route.points)
        for axis, side in (("x", "forward place"), ("y", "place to the left"))
    ]


def neighbors(config: SensorsConfig) -> list[Feature]:
    """Seven numbers of each of the nearest vehicles, nearest first; all 0 where there are fewer."""
    scale = f"{config.neighbors.range_m:g} m"
    rows = (
        ("present", "1 if there is one", ""),
        ("x", "forward place, ego frame", scale),
        ("y", "place to the left, ego frame", scale),
        ("vx", "forward velocity minus the own one, ego frame", "40 m/s"),
        ("vy", "velocity to the left minus the own one, ego frame", "40 m/s"),
        ("cos", "cosine of its heading minus the own one", ""),
        ("sin", "sine of its heading minus the own one", ""),
    )
    return _numbered(config.neighbors.count, "neighbour {}", rows)


def signal(config: SensorsConfig) -> list[Feature]:
    """The next stop line with a signal or a duty to give way; all 0 where none is within range."""
    if not config.signal.enabled:
        return []
    rows = (
        ("present", "1 if there is a line with a signal or a duty to give way", ""),
        ("distance", "way to the line", f"{config.signal.range_m:g} m"),
        ("red", "1 if its signal is red, or asks to stop first", ""),
        ("yellow", "1 if its signal is yellow", ""),
        ("green", "1 if its signal is green", ""),
        ("give_way", "1 if others have the right of way", ""),
    )
    return _features((*rows, *(_SIGNAL_TIMING if config.signal.timing else ())))


def lanes(config: SensorsConfig) -> list[Feature]:
    """Gap and relative speed of five vehicles, then the one that crosses the own way first."""
    if config.lanes.range_m == 0.0:
        return []
    rows: list[Row] = []
    for name, vehicle in _GAPS:
        rows += [
            (f"{name}_gap", f"how near {vehicle} is, along the lanes: {_NEARNESS}; 0: none", ""),
            (f"{name}_speed", f"speed of {vehicle} minus the own one; 0: none", "40 m/s"),
        ]
    return _features((*rows, *_CROSSING))


def lidar(config: SensorsConfig) -> list[Feature]:
    """Distances of all rays, then, with `speeds`, the relative speeds of what they met."""
    lidar = config.lidar
    step = 360.0 / max(lidar.rays, 1)
    told = "velocity of what the ray met minus the own one, along the ray; 0 where nothing is"
    return _features(
        (
            f"distance_{k}",
            f"distance along the ray {k * step:g}° left of straight ahead; 1 where nothing is",
            f"{lidar.range_m:g} m",
        )
        for k in range(lidar.rays)
    ) + _features((f"speed_{k}", told, "40 m/s") for k in range(lidar.rays * lidar.speeds))


def messages(config: SensorsConfig) -> list[Feature]:
    """What the vehicle has been told over the air; 0 where nothing is known.

    Eleven numbers a vehicle, eight an event, four of the signal.
    """
    messages = config.messages
    scale = f"{messages.range_m:g} m"
    vehicle = (
        ("object_present", "1 if there is one", ""),
        ("object_x", "forward place, ego frame", scale),
        ("object_y", "place to the left, ego frame", scale),
        ("object_vx", "forward velocity minus the own one, ego frame", "40 m/s"),
        ("object_vy", "velocity to the left, ego frame", "40 m/s"),
        ("object_cos", "cosine of its heading minus the own one", ""),
        ("object_sin", "sine of its heading minus the own one", ""),
        ("object_accel", "acceleration along its heading", "10 m/s²"),
        ("object_length", "length", "20 m"),
        ("object_age", "how old that is", "1 s"),
        ("object_direct", "1 if it has said so itself, 0 if others see it", ""),
    )
    event = (
        ("event_present", "1 if there is one", ""),
        ("event_x", "forward place, ego frame", scale),
        ("event_y", "place to the left, ego frame", scale),
        ("event_age", "how long ago", "10 s"),
        ("event_collision", "1 if it is a collision", ""),
        ("event_braking", "1 if a message tells of hard braking", ""),
        ("event_stationary", "1 if a message tells of a standing vehicle", ""),
        ("event_other", "1 if it is anything else", ""),
    )
    return [
        *_numbered(messages.objects, "vehicle {} that it has heard of", vehicle),
        *_numbered(messages.events, "event {}", event),
        *_features(_HEARD_SIGNAL if messages.signal else ()),
    ]
