"""Test each feature on a Ray cluster on this machine, with whole worlds and with nodes."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.parallel.test_combinations import FEATURES, check
from tests.support.vec_runs import Make

ray = pytest.importorskip("ray", reason="needs the extra: ray")

pytestmark = pytest.mark.filterwarnings("ignore")  # Ray warns about its own code


@pytest.fixture(scope="module", autouse=True)
def cluster() -> Iterator[None]:
    ray.init(num_cpus=3, include_dashboard=False, log_to_driver=False, logging_level="ERROR")
    yield
    ray.shutdown()


# Features in every test run: they cover the start of actors, a library that only the actor loads, a
# file on its machine, and a refusal.
OFTEN = ("stacked frames, discrete actions, seats", "SUMO's traffic", "a journal", "sensor workers")


@pytest.mark.parametrize(
    ("place", "feature"),
    [
        pytest.param(place, feature, marks=() if often else pytest.mark.slow)
        for place in ("worlds on Ray", "nodes on Ray")
        for feature in FEATURES
        for often in (place == "nodes on Ray" and feature in OFTEN,)
    ],
)
def test_each_feature_works_on_ray_or_is_refused(
    make: Make, tmp_path: Path, place: str, feature: str
) -> None:
    check(make, tmp_path, feature, place)
