"""Streets with corners inside an edge, made by netconvert from plain nodes and edges."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

from tests.support.netgenerate import netconvert

ARM_M = 300.0  # length of the straight edges before and after the street
Place = tuple[float, float]


def bent_street(
    folder: Path,
    turns_deg: Sequence[float],
    legs_m: Sequence[float] = (ARM_M, ARM_M),
    *,
    lanes: int = 1,
    attributes: str = "",
) -> Path:
    """Make a street with corners inside its middle edges `ab` and `ba`; the limit is 50 km/h.

    A corner follows each leg except the last one. Cars turn around at the ends of the street.
    `attributes`: further attributes of all edges.
    """
    places, heading = [(0.0, 0.0)], 0.0
    for leg, turn in zip(legs_m, (*turns_deg, 0.0), strict=True):
        x, y = places[-1]
        places.append((x + leg * math.cos(heading), y + leg * math.sin(heading)))
        heading += math.radians(turn)
    (x, y), arm = places[-1], (ARM_M * math.cos(heading), ARM_M * math.sin(heading))
    ends = {"z": (-ARM_M, 0.0), "a": places[0], "b": (x, y), "y": (x + arm[0], y + arm[1])}
    nodes = (
        f'<node id="{name}" x="{x:.2f}" y="{y:.2f}" type="priority"/>'
        for name, (x, y) in ends.items()
    )
    shapes = {"ab": places, "ba": places[::-1]}
    edges = (
        f'<edge id="{name}" from="{name[0]}" to="{name[1]}" numLanes="{lanes}" speed="13.9"'
        f"{_shape(shapes.get(name, ()))} {attributes}/>"
        for name in ("za", "ab", "by", "yb", "ba", "az")
    )
    for end, (kind, parts) in {
        "nod": ("node", nodes),
        "edg": ("edge", edges),
        "con": ("connection", ()),
    }.items():
        text = f"<{kind}s>{''.join(parts)}</{kind}s>"
        (folder / f"m.{end}.xml").write_text(text)
    return netconvert(folder, "m")


def _shape(places: Sequence[Place]) -> str:
    return f' shape="{" ".join(f"{x:.2f},{y:.2f}" for x, y in places)}"' if places else ""
