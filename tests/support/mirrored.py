"""Mirror SUMO networks in the x axis, so that vehicles drive on the left."""

from __future__ import annotations

import re
from pathlib import Path

_TURNS = str.maketrans("lrLRt", "rlRLT")


def mirror_net(source: Path, target: Path) -> Path:
    """Write a right-hand network as a left-hand one with each y negated."""
    text = source.read_text()
    text = re.sub(r'shape="([^"]*)"', lambda found: f'shape="{_mirrored(found[1])}"', text)
    text = re.sub(r' y="([^"]*)"', lambda found: f' y="{_negative(found[1])}"', text)
    text = re.sub(r' dir="([^"]*)"', lambda found: f' dir="{found[1].translate(_TURNS)}"', text)
    target.write_text(text.replace("<net ", '<net lefthand="true" ', 1))
    return target


def _mirrored(shape: str) -> str:
    points = [point.split(",") for point in shape.split()]
    return " ".join(",".join([x, _negative(y), *z]) for x, y, *z in points)


def _negative(number: str) -> str:
    return number[1:] if number.startswith("-") else f"-{number}"
