"""How long agents stood, and why, in worlds with given speeds."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from cavmarl.config.terms import TERMS
from cavmarl.core.records.codes import ACTION_FASTER, ACTION_IDLE, ACTION_SLOWER
from cavmarl.evaluate.recorder import Recorder
from cavmarl.evaluate.stuck_trips import StandingWatch

STEP_S = 0.5


class Worlds:
    """One world whose agents have given speeds and given actions of the built-in driver."""

    def __init__(self, suggested: list[float], kind: str = "continuous") -> None:
        agents = len(suggested)
        self.asked = 0
        arrays = SimpleNamespace(suggested=np.full((1, agents, 2), np.nan))

        def suggest() -> None:
            self.asked += 1
            arrays.suggested[0, :, 0] = suggested

        vec: Any = SimpleNamespace(
            step_s=STEP_S,
            num_envs=1,
            num_agents=agents,
            config=SimpleNamespace(action=SimpleNamespace(kind=kind)),
            worlds=SimpleNamespace(suggest=suggest, arrays=arrays),
        )
        self.recorder = Recorder(1, agents, 1000, STEP_S, np.zeros(len(TERMS)))
        self.watch = StandingWatch(vec, self.recorder)
        self.mask = np.ones((1, agents), np.bool_)
        self.step = 0
        self._x_m = np.zeros(agents)

    def drive(self, steps: int, *speeds_mps: float) -> None:
        for _ in range(steps):
            self.recorder.places_m[0, :, 0] = self._x_m
            self.recorder.places_m[0, :, 1] = 0.0
            self.watch.look(self.step, self.mask)
            self._x_m += STEP_S * np.array(speeds_mps)
            self.step += 1

    def cut(self) -> NDArray[np.void]:
        """Truncate the trips as at the horizon, and return the trips."""
        agents = self.mask.shape[1]
        nothing = np.zeros((1, agents))
        return self.recorder.add(
            self.step,
            self.mask,
            nothing.astype(np.float32),
            np.zeros((1, agents, len(TERMS)), np.float32),
            nothing.astype(np.bool_),
            np.array([True]),
            np.zeros(1, np.int64),
        )


def test_a_vehicle_below_0_1_mps_counts_as_standing() -> None:
    worlds = Worlds([0.0, 0.0, 0.0])
    worlds.drive(5, 0.0, 0.09, 0.11)
    # The first of the five steps does not count, because it has no earlier position.
    assert worlds.recorder.still_s[0].tolist() == [2.0, 2.0, 0.0]
    worlds.drive(1, 0.0, 1.0, 0.0)
    worlds.drive(1, 0.0, 0.0, 0.0)
    assert worlds.recorder.still_s[0].tolist() == [3.0, 0.0, 0.5]


def test_the_standing_time_of_an_agent_begins_anew_after_an_absence() -> None:
    worlds = Worlds([0.0])
    worlds.drive(5, 0.0)
    worlds.mask[:] = False
    worlds.drive(1, 0.0)
    worlds.mask[:] = True
    worlds.drive(1, 0.0)
    assert worlds.recorder.still_s[0].tolist() == [0.0]
    worlds.drive(2, 0.0)
    assert worlds.recorder.still_s[0].tolist() == [1.0]


@pytest.mark.parametrize(
    ("kind", "goes", "waits"),
    [
        ("continuous", 0.6, 0.4),
        ("discrete", ACTION_FASTER, ACTION_IDLE),
        ("discrete", ACTION_FASTER, ACTION_SLOWER),
    ],
)
def test_a_stop_of_ten_seconds_counts_as_blocked_if_the_driver_would_wait_and_otherwise_as_stood(
    kind: str, goes: float, waits: float
) -> None:
    worlds = Worlds([goes, waits, goes], kind)
    worlds.drive(21, 0.0, 0.0, 5.0)
    rows = worlds.cut()
    assert rows["stood"].tolist() == [True, False, False]
    assert rows["blocked"].tolist() == [False, True, False]
    assert rows["out_of_time"].tolist() == [False, False, True]
    # As soon as an agent has stood for 5 s, the recorder asks the built-in driver every 5 s.
    assert worlds.asked == 2


def test_a_stop_below_ten_seconds_does_not_count_as_stood() -> None:
    worlds = Worlds([0.6])
    worlds.drive(20, 0.0)
    assert worlds.cut()["out_of_time"].tolist() == [True]
