"""Assignment of agents to opponents, tested with drivers whose actions are their numbers."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from cavmarl.learning import opponents

WORLDS, AGENTS = 200, 20


class NumberedDriver:
    """A driver named by a number; all its actions are that number."""

    def __init__(self, name: str) -> None:
        self.number = float(name)
        self.masks: list[NDArray[np.bool_]] = []

    def act_batch(self, observations: NDArray[np.float32], mask: NDArray[np.bool_]) -> Any:
        self.masks.append(mask)
        return np.full((*mask.shape, 2), self.number, np.float32)


@pytest.fixture
def drivers(monkeypatch: pytest.MonkeyPatch) -> list[NumberedDriver]:
    """Return a list to which each loaded driver is appended."""
    loaded: list[NumberedDriver] = []

    def load(name: str, vec: object) -> NumberedDriver:
        loaded.append(NumberedDriver(name))
        return loaded[-1]

    monkeypatch.setattr(opponents, "load_policy", load)
    return loaded


def driven(names: str, share: float, mask: NDArray[np.bool_]) -> tuple[Any, NDArray[np.float32]]:
    """Return the opponents, and the number of each agent's driver (0: the learning driver)."""
    vec: Any = SimpleNamespace(num_envs=WORLDS, num_agents=AGENTS)
    found = opponents.Opponents(names, vec, share, 7)
    actions = np.zeros((WORLDS, AGENTS, 2), np.float32)
    found.act(np.zeros((WORLDS, AGENTS, 1), np.float32), mask, actions)
    return found, actions[..., 0]


def test_each_opponent_drives_its_share_of_the_agents(drivers: list[NumberedDriver]) -> None:
    mask = np.ones((WORLDS, AGENTS), np.bool_)
    found, by = driven("1,2,3", 0.2, mask)
    shares = [float((by == number).mean()) for number in range(4)]
    assert shares == pytest.approx([0.4, 0.2, 0.2, 0.2], abs=0.03)
    np.testing.assert_array_equal(found.absent, by == 0.0)
    for driver in drivers:
        np.testing.assert_array_equal(driver.masks[0], by == driver.number)


def test_opponents_act_only_for_agents_of_the_mask(drivers: list[NumberedDriver]) -> None:
    mask = np.zeros((WORLDS, AGENTS), np.bool_)
    mask[:, ::2] = True
    driven("1,2", 0.5, mask)
    asked = drivers[0].masks[0] | drivers[1].masks[0]
    np.testing.assert_array_equal(asked, mask)


@pytest.mark.parametrize(("names", "share"), [("", 0.5), ("1", 0.0)])
def test_without_names_or_share_the_learning_driver_drives_all_agents(
    drivers: list[NumberedDriver], names: str, share: float
) -> None:
    found, by = driven(names, share, np.ones((WORLDS, AGENTS), np.bool_))
    assert found.absent.all()
    assert not by.any()
