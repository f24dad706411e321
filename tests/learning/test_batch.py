"""Advantages, compared with hand-computed values."""

from __future__ import annotations

from dataclasses import fields
from typing import Any

import pytest
import torch
from torch import Tensor

from tests.support.training import load_program

Batch = load_program("ppo").Batch


def batch_of_one_seat(
    rewards: list[float], acted: list[bool], goes_on: list[bool], cut_value: float
) -> Any:
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


def test_advantages_equal_hand_computed_values() -> None:
    # A trip ends after step 1, the seat is empty in step 2, the next trip is truncated in step 4.
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


def test_advantages_of_a_trip_exclude_rewards_of_the_next_trip() -> None:
    # The next vehicle has the seat directly after the end of the previous trip.
    batch = batch_of_one_seat(
        rewards=[1.0, 50.0, -7.0],
        acted=[True, True, True],
        goes_on=[False, True, False],
        cut_value=0.0,
    )
    found = batch.advantages(0.9, 0.5).flatten().tolist()
    last = -7.0 - 0.5
    second = 50.0 + 0.9 * 0.5 - 0.5 + 0.45 * last
    assert found == pytest.approx([1.0 - 0.5, second, last])


def test_advantages_of_seats_are_independent() -> None:
    one, other = (
        batch_of_one_seat([r, 2.0 * r, 3.0], [True] * 3, [on, True, False], 1.0)
        for r, on in ((1.0, True), (4.0, False))
    )
    together = Batch(
        *(
            torch.cat([getattr(one, field.name), getattr(other, field.name)], dim=1)
            for field in fields(Batch)
            if field.name != "suggested"
        )
    )
    found = together.advantages(0.9, 0.5)
    for seat, batch in enumerate((one, other)):
        assert torch.equal(found[:, seat], batch.advantages(0.9, 0.5)[:, 0])
