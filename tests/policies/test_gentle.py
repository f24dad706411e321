"""`ring22`: one agent among 21 simulated human drivers, compared with 22 human drivers."""

from __future__ import annotations

import pytest

import cavmarl
from benchmarks import ring22
from cavmarl.core.errors import PolicyError
from cavmarl.policies.loading import load_policy


def test_one_gentle_driver_raises_the_mean_speed_by_more_than_57_percent() -> None:
    human, gentle = ring22.measure(["gentle"], episodes=1).rows
    assert human["mean"] == pytest.approx(2.07, abs=0.01)
    assert gentle["gain"] > 57.0
    assert gentle["crashed"] == 0


def test_a_trained_driver_raises_the_mean_speed_by_more_than_57_percent() -> None:
    _, learnt = ring22.measure(["ring22_ippo"], episodes=4, seed=1000).rows
    assert learnt["gain"] > 57.0
    assert learnt["crashed"] == 0


def test_an_episode_in_which_the_agent_crashes_has_no_mean_speed() -> None:
    _, row = ring22.measure(["random_actions"], episodes=2).rows
    assert row["crashed"] == 2
    assert "mean" not in row


def test_the_gentle_driver_refuses_unsupported_worlds() -> None:
    with pytest.raises(PolicyError, match="gentle needs"):
        load_policy("gentle", cavmarl.make_vec("ring"))
