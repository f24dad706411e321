"""Compute features of observations from a SUMO network file and from rectangles of vehicles.

This code does not use the package. It reads lanes, widths, limits, stop signs and signal programs
from the file, and intersects rays with the sides of rectangles.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

Point = tuple[float, float]


@dataclass(frozen=True)
class FileLane:
    """A lane of the network file."""

    points: list[Point]
    width_m: float
    limit_mps: float

    @property
    def length_m(self) -> float:
        return sum(math.dist(a, b) for a, b in pairwise(self.points))

    def pose(self, s: float) -> tuple[float, float, float]:
        """Return x, y and direction at a distance from the start."""
        for a, b in pairwise(self.points):
            piece = math.dist(a, b)
            if s <= piece:
                break
            s -= piece
        else:
            s += piece
        share = s / piece
        direction = math.atan2(b[1] - a[1], b[0] - a[0])
        return a[0] + share * (b[0] - a[0]), a[1] + share * (b[1] - a[1]), direction


@dataclass(frozen=True)
class Net:
    """The parts of a network file that features depend on."""

    lanes: dict[str, FileLane]
    # (lane before the junction, first lane inside) → state, name and index of the signal if any
    states: dict[tuple[str, str], tuple[str, str, int]]
    programs: dict[
        str, list[tuple[float, str]]
    ]  # name of a signal → durations in s and states of its phases
    offsets: dict[str, float] = field(default_factory=dict)  # s

    def letter(self, signal: str, index: int, time_s: float) -> tuple[str, float]:
        """Return the letter that a signal shows, and the time until the letter changes.

        If the letter never changes, the time is the cycle of the signal.
        """
        phases = self.programs[signal]
        cycle = sum(duration for duration, _ in phases)
        into = (time_s - self.offsets[signal]) % cycle
        k = 0
        while into >= phases[k][0]:
            into -= phases[k][0]
            k += 1
        letter, left = phases[k][1][index], phases[k][0] - into
        for ahead in range(1, len(phases)):
            duration, letters = phases[(k + ahead) % len(phases)]
            if letters[index] != letter:
                return letter, left
            left += duration
        return letter, cycle


def read_net(path: Path) -> Net:
    root = ElementTree.parse(path).getroot()
    lanes = {
        lane.attrib["id"]: FileLane(
            [_point(text) for text in lane.attrib["shape"].split()],
            float(lane.get("width", "3.2")),
            float(lane.attrib["speed"]),
        )
        for lane in root.iter("lane")
    }
    states = {
        (f"{one.attrib['from']}_{one.attrib['fromLane']}", one.attrib["via"]): (
            one.attrib["state"],
            one.get("tl", ""),
            int(one.get("linkIndex", "-1")),
        )
        for one in root.iter("connection")
        if "via" in one.attrib and not one.attrib["from"].startswith(":")
    }
    programs = {
        logic.attrib["id"]: [
            (float(phase.attrib["duration"]), phase.attrib["state"]) for phase in logic
        ]
        for logic in root.iter("tlLogic")
    }
    offsets = {logic.attrib["id"]: float(logic.attrib["offset"]) for logic in root.iter("tlLogic")}
    return Net(lanes, states, programs, offsets)


def _point(text: str) -> Point:
    x, y = text.split(",")[:2]
    return float(x), float(y)


def ray_distance(
    origin: Point, direction: float, bodies: NDArray[np.void], range_m: float
) -> float:
    """Return the distance along a ray to the nearest side of a rectangle, or the range."""
    nearest = range_m
    ex, ey = math.cos(direction), math.sin(direction)
    for body in bodies:
        cos, sin = math.cos(body["heading"]), math.sin(body["heading"])
        corners = [
            (
                body["x"] + a * body["length"] / 2 * cos - b * body["width"] / 2 * sin - origin[0],
                body["y"] + a * body["length"] / 2 * sin + b * body["width"] / 2 * cos - origin[1],
            )
            for a, b in ((1, 1), (1, -1), (-1, -1), (-1, 1))
        ]
        for (ax, ay), (bx, by) in zip(corners, [*corners[1:], corners[0]], strict=True):
            across = ex * (by - ay) - ey * (bx - ax)
            if abs(across) < 1e-12:
                continue
            along = (ax * (by - ay) - ay * (bx - ax)) / across
            share = (ax * ey - ay * ex) / across
            if 0.0 <= share <= 1.0 and 0.0 <= along < nearest:
                nearest = along
    return nearest
