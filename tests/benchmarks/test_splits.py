"""From how many vehicles on it pays to split one world."""

from __future__ import annotations

import pytest

from benchmarks.splits import measure, split_line
from cavmarl.core.errors import ConfigError


def test_one_world_is_split() -> None:
    found = measure("ring", "9,12", agents=3, steps=2, repeats=2)
    assert [row["vehicles"] for row in found.rows] == [9, 12]
    assert all(len(row["split_ms"]) == 2 for row in found.rows)
    assert "splitting one world" in found.notes[0]


def test_the_line_lies_where_splitting_pays_from_then_on() -> None:
    few, some, many = (100, 1.1), (1000, 0.9), (10_000, 1.6)
    assert split_line([many, few, some]) == 10_000
    assert split_line([few, some]) is None
    assert split_line([few, many]) == 100


@pytest.mark.parametrize(
    ("vehicles", "told"),
    [("many", "--vehicles many: must be whole numbers"), ("2", "2 vehicles: agents alone are 3")],
)
def test_what_cannot_be_is_refused(vehicles: str, told: str) -> None:
    with pytest.raises(ConfigError, match=told):
        measure("ring", vehicles, agents=3)
