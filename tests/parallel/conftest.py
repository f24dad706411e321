"""Fixtures of tests of worlds that are stepped together."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest

from cavmarl import CavVectorEnv, make_vec
from tests.support.vec_runs import Make


@pytest.fixture
def make() -> Iterator[Make]:
    """Yield `make_vec`, and close its environments at the end."""
    made: list[CavVectorEnv] = []

    def call(env: str, **arguments: Any) -> CavVectorEnv:
        made.append(make_vec(env, **arguments))
        return made[-1]

    yield call
    for vec in made:
        vec.close()
