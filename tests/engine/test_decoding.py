"""Decoding of actions: the fast path gives the same results as the general path."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from cavmarl.config.action import ActionConfig
from cavmarl.core.errors import ActionError
from cavmarl.env.actions import ActionDecoder

AGENTS = ("car_0", "car_1", "car_2")
MASK = np.array([[True, False, True], [True, True, False]])


def for_general_path(actions: NDArray[Any]) -> NDArray[Any]:
    """Return a read-only copy, which the decoder handles in the general path."""
    actions = actions.copy()
    actions.flags.writeable = False
    return actions


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_the_fast_and_the_general_path_decode_continuous_actions_equally(dtype: type) -> None:
    actions = np.random.default_rng(0).uniform(-1.0, 1.0, (2, 3, 2)).astype(dtype)
    actions[~MASK] = np.nan  # must not be read: these agents have no vehicle
    config = ActionConfig(kind="continuous")
    found = ActionDecoder(config, 2, AGENTS).from_array(actions, MASK)
    expected = ActionDecoder(config, 2, AGENTS).from_array(for_general_path(actions), MASK)
    assert found.controls.tobytes() == expected.controls.tobytes()
    assert found.meta_actions.tobytes() == expected.meta_actions.tobytes()
    assert found.controls[~MASK].tolist() == [[0.0, 0.0]] * 2


def test_the_fast_and_the_general_path_decode_discrete_actions_equally() -> None:
    actions = np.random.default_rng(0).integers(0, 5, (2, 3))
    actions[~MASK] = 99
    config = ActionConfig(kind="discrete")
    found = ActionDecoder(config, 2, AGENTS).from_array(actions, MASK)
    expected = ActionDecoder(config, 2, AGENTS).from_array(for_general_path(actions), MASK)
    assert found.meta_actions.tobytes() == expected.meta_actions.tobytes()
    assert found.meta_actions[MASK].tolist() == actions[MASK].tolist()


@pytest.mark.parametrize("wrong", [1.001, -np.inf, np.nan])
def test_a_refused_continuous_action_changes_no_control(wrong: float) -> None:
    decoder = ActionDecoder(ActionConfig(kind="continuous", out_of_range="error"), 2, AGENTS)
    actions = np.full((2, 3, 2), 0.5)
    before = decoder.from_array(actions, MASK).controls.copy()
    actions[:] = 0.25
    actions[1, 1, 1] = wrong
    with pytest.raises(ActionError, match="world 1, car_1, steering"):
        decoder.from_array(actions, MASK)
    actions[1, 1, 1] = 0.5
    assert (decoder.idle().controls == 0.0).all()
    actions[:] = 0.5
    assert (decoder.from_array(actions, MASK).controls == before).all()


def test_an_invalid_discrete_action_is_refused() -> None:
    decoder = ActionDecoder(ActionConfig(kind="discrete"), 2, AGENTS)
    actions = np.zeros((2, 3), dtype=np.int64)
    actions[0, 2] = 5
    with pytest.raises(ActionError, match="world 0, car_2"):
        decoder.from_array(actions, MASK)


def test_clipped_values_are_counted() -> None:
    decoder = ActionDecoder(ActionConfig(kind="continuous", out_of_range="clip"), 2, AGENTS)
    actions = np.full((2, 3, 2), 2.0, dtype=np.float32)
    clipped = decoder.from_array(actions, MASK).controls.copy()
    assert decoder.clipped.tolist() == [4, 4]
    assert (clipped == decoder.from_array(np.ones_like(actions), MASK).controls).all()
