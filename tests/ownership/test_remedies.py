"""Run the scenario of each remedy: the remedy closes its hole in the protocol."""

from __future__ import annotations

import pytest

from tests.ownership.scenarios import SCENARIOS


@pytest.mark.parametrize("name", SCENARIOS)
def test_the_remedy_closes_its_hole(name: str) -> None:
    SCENARIOS[name]()
