"""How close it was: time to collision and post-encroachment time between two bodies.

Both are measured on rectangles in the plane, wherever the bodies are, on lanes or off them.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.math.geometry import boxes_overlap

TRACE = np.dtype(
    [
        ("time_s", np.float64),
        ("x", np.float64),  # as in VEHICLE
        ("y", np.float64),
        ("heading", np.float64),
        ("speed", np.float64),
        ("length", np.float64),
        ("width", np.float64),
    ]
)
"""Where a body was, moment by moment."""


def trace_of(row: np.void, time_s: float) -> tuple[float, ...]:
    """What a TRACE keeps of a VEHICLE row."""
    _, *names = TRACE.names or ()
    return (time_s, *(float(row[name]) for name in names))


def time_to_collision_s(one: np.void, other: np.void) -> float:
    """When two bodies (TRACE) touch if both keep their velocities, in s; inf: never, 0: they do.

    Hayward's time to collision ("Near miss determination through use of a scale of danger", Highway
    Research Record 384, 1972) for rectangles that move and do not turn: they touch when their
    shadows overlap on each of the four separating axes.
    """
    dx, dy = float(other["x"] - one["x"]), float(other["y"] - one["y"])
    vx, vy = (
        float(other["speed"]) * turn(float(other["heading"]))
        - float(one["speed"]) * turn(float(one["heading"]))
        for turn in (math.cos, math.sin)
    )
    begin, end = 0.0, math.inf
    for body in (one, other):
        for angle in (float(body["heading"]), float(body["heading"]) + 0.5 * math.pi):
            cos, sin = math.cos(angle), math.sin(angle)
            apart, rate = dx * cos + dy * sin, vx * cos + vy * sin
            reach = sum(
                0.5 * float(b["length"]) * abs(math.cos(float(b["heading"]) - angle))
                + 0.5 * float(b["width"]) * abs(math.sin(float(b["heading"]) - angle))
                for b in (one, other)
            )
            if abs(rate) < 1e-9:
                if abs(apart) >= reach:
                    return math.inf
                continue
            times = sorted(((-reach - apart) / rate, (reach - apart) / rate))
            begin, end = max(begin, times[0]), min(end, times[1])
    return begin if begin < end else math.inf


def post_encroachment_s(one: NDArray[np.void], other: NDArray[np.void]) -> float:
    """The shortest time between one body's leaving a place and the other's being there, in s.

    Post-encroachment time (Allen, Shin, Cooper: "Analysis of traffic conflicts and collisions",
    Transportation Research Record 667, 1978) of TRACE (n,) and (m,), with the ground that a body
    covers as the place: inf if no place was covered by both, 0 if both were there at a time. As
    bodies are known at moments only, it is too long by at most twice the time between two of them.
    """
    reach = 0.5 * (np.hypot(one["length"], one["width"]).max(initial=0.0)
                   + np.hypot(other["length"], other["width"]).max(initial=0.0))  # fmt: skip
    dx = one["x"][:, None] - other["x"][None, :]
    dy = one["y"][:, None] - other["y"][None, :]
    apart_s = np.abs(one["time_s"][:, None] - other["time_s"][None, :])
    near = np.argwhere(dx * dx + dy * dy < reach * reach)
    near = near[np.argsort(apart_s[near[:, 0], near[:, 1]], kind="stable")]
    for i, j in near.tolist():
        if boxes_overlap(*_box(one[i]), *_box(other[j])):
            return float(apart_s[i, j])
    return math.inf


def _box(body: np.void) -> tuple[float, float, float, float, float, float]:
    heading = float(body["heading"])
    return (
        float(body["x"]), float(body["y"]), math.cos(heading), math.sin(heading),
        0.5 * float(body["length"]), 0.5 * float(body["width"]),
    )  # fmt: skip
