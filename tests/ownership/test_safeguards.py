"""AT8: each safeguard can be switched off, and then its scenario fails."""

from __future__ import annotations

from dataclasses import fields, replace

import pytest

from cavmarl.core.errors import ProtocolError
from cavmarl.ownership.safeguards import ALL_ON, Safeguards
from tests.ownership.scenarios import SCENARIOS


def test_every_safeguard_has_a_scenario() -> None:
    assert sorted(SCENARIOS) == sorted(field.name for field in fields(Safeguards))


@pytest.mark.parametrize("name", SCENARIOS)
def test_with_all_safeguards_the_scenario_passes(name: str) -> None:
    SCENARIOS[name](ALL_ON)


@pytest.mark.parametrize("name", SCENARIOS)
def test_without_its_safeguard_the_scenario_fails(name: str) -> None:
    without = replace(ALL_ON, **{name: False})
    with pytest.raises((ProtocolError, AssertionError, pytest.fail.Exception)):
        SCENARIOS[name](without)
