"""The profile of a step: every phase is named, and together they are the step."""

from __future__ import annotations

from functools import partial

import pytest

from cavmarl import make_vec
from cavmarl.bench.step_profile import profile_step
from cavmarl.core.errors import ConfigError

RING = partial(make_vec, "ring", num_envs=2, agents=3, background=2)


def test_the_phases_are_the_step() -> None:
    found = profile_step(RING, steps=5, repeats=2)
    assert {"advance", "resolve", "commit", "sense", "view"} <= set(found.phases)
    assert "suggest" not in found.phases
    assert sum(found.phases.values()) == pytest.approx(found.timed_ns)
    assert list(found.phases.values()) == sorted(found.phases.values(), reverse=True)
    assert (found.vehicles, found.agents) == (10.0, 6.0)
    assert found.plain_ns > 0.0


@pytest.mark.parametrize("wrong", [{"steps": 0}, {"repeats": 0}])
def test_numbers_out_of_range_are_refused(wrong: dict[str, int]) -> None:
    with pytest.raises(ConfigError, match=next(iter(wrong))):
        profile_step(RING, **wrong)
