"""Advantages, by hand."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from cavmarl.learning.batch import Batch


def batch_of_one_seat(
    rewards: list[float], acted: list[bool], goes_on: list[bool], cut_value: float
) -> Batch:
    steps = len(rewards)

    def column(values: list[float] | list[bool]) -> Tensor:
        return torch.tensor(values).reshape(steps, 1, 1)

    next_values = torch.where(column(goes_on), 0.5, 0.0)
    next_values[-1] = cut_value
    return Batch(
        observations=torch.zeros(steps, 1, 1, 1),
        states=torch.zeros(steps, 1, 0),
        actions=torch.zeros(steps, 1, 1, 2),
        log_probs=torch.zeros(steps, 1, 1),
        values=column([0.5] * steps),
        rewards=column(rewards),
        acted=column(acted),
        next_values=next_values,
        goes_on=column(goes_on),
    )


def test_advantages_by_hand() -> None:
    # A vehicle ends after step 1; the seat waits in step 2; the next vehicle is cut after step 4.
    batch = batch_of_one_seat(
        rewards=[1.0, 2.0, 9.0, 3.0, 4.0],
        acted=[True, True, False, True, True],
        goes_on=[True, False, False, True, False],
        cut_value=2.0,
    )
    found = batch.advantages(0.9, 0.5).flatten().tolist()
    ends = 2.0 - 0.5
    cut = 4.0 + 0.9 * 2.0 - 0.5
    first = 1.0 + 0.9 * 0.5 - 0.5 + 0.45 * ends
    fourth = 3.0 + 0.9 * 0.5 - 0.5 + 0.45 * cut
    assert found == pytest.approx([first, ends, 0.0, fourth, cut])
