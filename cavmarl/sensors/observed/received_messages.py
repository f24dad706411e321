"""What the vehicle has been told over the air."""

from __future__ import annotations

from cavmarl.config.env import SensorsConfig
from cavmarl.sensors.observed.feature import Feature


def features(config: SensorsConfig) -> list[Feature]:
    """Eleven numbers a vehicle, eight an event, four of the signal; 0 where nothing is known."""
    messages = config.messages
    scale = f"{messages.range_m:g} m"
    found = [
        Feature(f"{name}_{k}", f"vehicle {k} that it has heard of: {meaning}", unit)
        for k in range(messages.objects)
        for name, meaning, unit in (
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
    ]
    found += [
        Feature(f"{name}_{k}", f"event {k}: {meaning}", unit)
        for k in range(messages.events)
        for name, meaning, unit in (
            ("event_present", "1 if there is one", ""),
            ("event_x", "forward place, ego frame", scale),
            ("event_y", "place to the left, ego frame", scale),
            ("event_age", "how long ago", "10 s"),
            ("event_collision", "1 if it is a collision", ""),
            ("event_braking", "1 if somebody brakes hard", ""),
            ("event_stationary", "1 if somebody stands", ""),
            ("event_other", "1 if it is anything else", ""),
        )
    ]
    if messages.signal:
        found += [
            Feature("signal_known", "1 if the unit at the next signal was heard"),
            Feature("signal_go", "1 if it is green on the own way"),
            Feature("signal_soon", "how soon the phase ends: 5 s / (5 s + time)"),
            Feature("signal_age", "how old that is", "1 s"),
        ]
    return found


def reach_m(config: SensorsConfig) -> float:
    """0: messages come from the bus, which knows no zones."""
    return 0.0
