"""Levels of the points of a lane that is partly on a bridge."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from cavmarl.maps.heights import levels
from cavmarl.maps.osm_roads import RoadWay


@pytest.mark.parametrize("level", [1, -2])
def test_points_of_a_lane_between_the_ends_of_a_bridge_have_its_level(
    monkeypatch: pytest.MonkeyPatch, level: int
) -> None:
    monkeypatch.setattr(levels, "project", lambda source, places, geo: places)
    lane = SimpleNamespace(internal=False, ways=("road", "bridge"))
    stations: Any = SimpleNamespace(
        lanes=(lane,),
        plane_m=np.column_stack([np.arange(11.0), np.zeros(11)]),
        first=np.array([0, 11]),
        rows=lambda row: slice(0, 11),
        graph=SimpleNamespace(places=11, links=np.zeros((0, 2), np.int64)),
    )
    roads: Any = SimpleNamespace(
        ways={
            "road": SimpleNamespace(level=0, nodes=("a", "b")),
            "bridge": SimpleNamespace(level=level, nodes=("b", "between", "c")),
        },
        places={"a": (0.0, 0.0), "b": (6.9, 0.1), "between": (9.0, 0.0), "c": (3.2, 0.0)},
    )
    geo: Any = None
    found = levels.levels_of(stations, roads, geo, Path("town.osm"))
    assert found.tolist() == [0, 0, 0, *[level] * 5, 0, 0, 0]


@pytest.mark.parametrize(
    ("tags", "level"),
    [
        ({"bridge": "yes"}, 1),
        ({"bridge": "viaduct", "layer": "2"}, 2),
        ({"bridge": "yes", "layer": "-1"}, 1),
        ({"bridge": "yes", "layer": "high"}, 1),
        ({"tunnel": "yes"}, -1),
        ({"tunnel": "yes", "layer": "-3"}, -3),
        ({"tunnel": "yes", "layer": "0"}, -1),
        ({"tunnel": "building_passage", "layer": "-1"}, 0),
        ({"layer": "1"}, 0),
    ],
)
def test_bridges_have_positive_and_tunnels_negative_levels(
    tags: dict[str, str], level: int
) -> None:
    """A layer with the wrong sign is ignored, and so is a layer that is not a number."""
    assert RoadWay(tags=tags).level == level
