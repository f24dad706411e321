"""The `messages` sensor: what the vehicle has received over the air."""

from __future__ import annotations

from cavmarl.config.sensors import SensorsConfig
from cavmarl.sensors.observed.feature import Feature, Sensor, features_of, numbered

_HEARD_SIGNAL = (
    ("signal_known", "1 if the unit at the next signal was heard", ""),
    ("signal_go", "1 if it is green on the own way", ""),
    ("signal_soon", "how soon the phase ends: 5 s / (5 s + time)", ""),
    ("signal_age", "how old that is", "1 s"),
)


def features(config: SensorsConfig) -> list[Feature]:
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
        *numbered(messages.objects, "vehicle {} that it has heard of", vehicle),
        *numbered(messages.events, "event {}", event),
        *features_of(_HEARD_SIGNAL if messages.signal else ()),
    ]


# It has no reach: messages come from the bus, which knows no zones.
SENSOR = Sensor("messages", features)
