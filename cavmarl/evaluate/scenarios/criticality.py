"""Criticality of an encounter: time to collision (TTC) and post-encroachment time (PET).

Both are computed for rectangles in the plane, on lanes or off them.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.math.elementary import cos_sin
from cavmarl.core.math.elementary_arrays import hypot_all
from cavmarl.core.math.geometry import boxes_overlap, time_to_collision_s

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
    """Return the fields of a VEHICLE row that a TRACE keeps."""
    _, *names = TRACE.names or ()
    return (time_s, *(float(row[name]) for name in names))


def least_ttc_s(one: NDArray[np.void], other: NDArray[np.void]) -> float:
    """Return the least `time_to_collision_s` of TRACE (n,) and (m,) over their common moments."""
    _, here, there = np.intersect1d(one["time_s"], other["time_s"], return_indices=True)
    least = math.inf
    for i, j in zip(here.tolist(), there.tolist(), strict=True):
        x1, y1, cos1, sin1, length1, width1 = box(one[i])
        x2, y2, cos2, sin2, length2, width2 = box(other[j])
        speed1, speed2 = float(one[i]["speed"]), float(other[j]["speed"])
        ttc = time_to_collision_s(
            x2 - x1, y2 - y1, speed2 * cos2 - speed1 * cos1, speed2 * sin2 - speed1 * sin1,
            cos1, sin1, length1, width1, cos2, sin2, length2, width2,
        )  # fmt: skip
        least = min(least, ttc)
    return least


def post_encroachment_s(one: NDArray[np.void], other: NDArray[np.void]) -> float:
    """Return the post-encroachment time of two bodies, in s.

    It is the shortest time between one body's leaving a place and the other body's presence there
    (Allen, Shin, Cooper: "Analysis of traffic conflicts and collisions", Transportation Research
    Record 667, 1978). The arguments are TRACE (n,) and (m,), and the place is the ground that a
    body covers. The value is inf if no place was covered by both bodies, and 0 if both were there
    at the same time. Because bodies are sampled at discrete moments, the value is too long by at
    most twice the time between two samples.
    """
    reach = 0.5 * (hypot_all(one["length"], one["width"]).max(initial=0.0)
                   + hypot_all(other["length"], other["width"]).max(initial=0.0))  # fmt: skip
    dx = one["x"][:, None] - other["x"][None, :]
    dy = one["y"][:, None] - other["y"][None, :]
    apart_s = np.abs(one["time_s"][:, None] - other["time_s"][None, :])
    near = np.argwhere(dx * dx + dy * dy < reach * reach)
    near = near[np.argsort(apart_s[near[:, 0], near[:, 1]], kind="stable")]
    for i, j in near.tolist():
        if boxes_overlap(*box(one[i]), *box(other[j])):
            return float(apart_s[i, j])
    return math.inf


def box(body: np.void) -> tuple[float, float, float, float, float, float]:
    """Return the arguments of `boxes_overlap` for a body: centre, cos, sin and half sizes."""
    return (
        float(body["x"]), float(body["y"]), *cos_sin(float(body["heading"])),
        0.5 * float(body["length"]), 0.5 * float(body["width"]),
    )  # fmt: skip
