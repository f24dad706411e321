"""The table of combinations on a Ray cluster of this machine: whole worlds, and nodes."""

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


@pytest.mark.parametrize("feature", FEATURES)
@pytest.mark.parametrize(
    "place", [pytest.param("worlds on Ray", marks=pytest.mark.slow), "nodes on Ray"]
)
def test_features_on_ray(make: Make, tmp_path: Path, feature: str, place: str) -> None:
    check(make, tmp_path, feature, place)
