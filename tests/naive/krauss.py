"""The safe speed of Krauss by bisection, and his driver imperfection from its definition."""

from __future__ import annotations


def safe_speed(
    gap: float, front_speed: float, decel: float, front_decel: float, reaction_s: float
) -> float:
    """Return the largest speed at which a driver can stop behind a leader that brakes."""
    room = gap + front_speed**2 / (2.0 * max(decel, front_decel))
    low, high = 0.0, 1000.0
    for _ in range(100):
        middle = 0.5 * (low + high)
        if middle * reaction_s + middle**2 / (2.0 * decel) <= room:
            low = middle
        else:
            high = middle
    return low


def dawdle(speed: float, accel: float, sigma: float, share: float, dt: float) -> float:
    """Reduce a speed by a random share of sigma times one tick's acceleration."""
    lost = sigma * share * dt * (speed if speed < accel else accel)
    return speed - lost if speed > lost else 0.0
