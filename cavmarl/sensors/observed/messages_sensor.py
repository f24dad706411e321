"""The `messages` sensor: V2X messages that the agent's vehicle has received."""

from __future__ import annotations

from cavmarl.config.sensors import SensorsConfig
from cavmarl.sensors.observed.feature import Feature, Reading, Sensor, Sides, features_of, numbered

_HEARD_SIGNAL = (
    ("signal_known", "1 if a message of the next signal's roadside unit was received", ""),
    ("signal_go", "1 if the signal is green for the ego path", ""),
    ("signal_soon", "how soon the phase ends: 5 s / (5 s + time)", ""),
    ("signal_age", "age of the message", "1 s"),
)
_TIMING = (
    ("signal_distance", "distance to the line of that signal; 0: no message", "300 m"),
    ("signal_change", "how soon it opens or closes: 5 s / (5 s + time); 0: not known", ""),
    ("signal_return", "the same for the change after that", ""),
)


def features(config: SensorsConfig) -> list[Feature]:
    """List the features of received messages; features without a message are 0.

    There are eleven numbers per vehicle, eight per event, four for the signal, and three for its
    timing.
    """
    messages = config.messages
    scale = f"{messages.range_m:g} m"
    vehicle = (
        ("object_present", "1 if there is a vehicle", ""),
        ("object_x", "longitudinal position, ego frame", scale),
        ("object_y", "lateral position, left positive, ego frame", scale),
        ("object_vx", "longitudinal velocity minus the ego speed, ego frame", "40 m/s"),
        ("object_vy", "lateral velocity, left positive, ego frame", "40 m/s"),
        ("object_cos", "cosine of its heading relative to the ego heading", ""),
        ("object_sin", "sine of its heading relative to the ego heading", ""),
        ("object_accel", "acceleration along its heading", "10 m/s²"),
        ("object_length", "length", "20 m"),
        ("object_age", "age of the message", "1 s"),
        ("object_direct", "1 if reported by the vehicle itself, 0 if perceived by another", ""),
    )
    event = (
        ("event_present", "1 if there is an event", ""),
        ("event_x", "longitudinal position, ego frame", scale),
        ("event_y", "lateral position, left positive, ego frame", scale),
        ("event_age", "time since the event", "10 s"),
        ("event_collision", "1 if the event is a collision", ""),
        ("event_braking", "1 if the event is hard braking", ""),
        ("event_stationary", "1 if the event is a stationary vehicle", ""),
        ("event_other", "1 if the event has another cause", ""),
    )
    return [
        *numbered(messages.objects, "reported vehicle {}", vehicle),
        *numbered(messages.events, "event {}", event),
        *features_of(_HEARD_SIGNAL if messages.signal else ()),
        *features_of(_TIMING if messages.timing else ()),
    ]


# The sensor has no reach: messages come from the bus, which is the same for all zones.
def reads(config: SensorsConfig) -> list[Reading]:
    own = config.messages
    counts = ((own.objects, "vehicles"), (own.events, "events"))
    found = [f"{count} {what}" for count, what in counts if count]
    if own.signal:
        found.append("the next signal" + (" and its times of change" if own.timing else ""))
    return [Reading("V2X", f"messages about {', '.join(found)}")]


_NEGATED = ("object_y", "object_vy", "object_sin", "event_y")
SENSOR = Sensor("messages", features, reads=reads, sides=Sides(_NEGATED))
