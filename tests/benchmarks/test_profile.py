"""The profile of a step: every phase is named, and together they are the step."""

from __future__ import annotations

import pytest

from benchmarks.profile import measure
from cavmarl.core.errors import ConfigError


def test_the_phases_are_the_step() -> None:
    found = measure("ring", worlds=2, agents=3, background=2, steps=5, repeats=2)
    phases = {row["name"]: row["ns"] for row in found.rows}
    assert {"advance", "resolve", "commit", "sense", "view"} <= set(phases)
    assert "suggest" not in phases
    assert sum(phases.values()) == pytest.approx(found.facts["timed_ns"])
    assert list(phases.values()) == sorted(phases.values(), reverse=True)
    assert (found.facts["vehicles"], found.facts["agents"]) == (10.0, 6.0)
    assert found.facts["plain_ns"] > 0.0


@pytest.mark.parametrize("wrong", [{"steps": 0}, {"repeats": 0}])
def test_numbers_out_of_range_are_refused(wrong: dict[str, int]) -> None:
    with pytest.raises(ConfigError, match=next(iter(wrong))):
        measure("ring", **wrong)  # type: ignore[arg-type]
