"""Times of samples equal a computed list, also in worlds that run for a minute."""

from __future__ import annotations

from fractions import Fraction
from typing import Any

import numpy as np
import pytest

from cavmarl import make_vec
from cavmarl.config.registry import load_config
from cavmarl.core.errors import ConfigError
from cavmarl.sensors.kernels.rig_frames import Due, SensorSchedule, call_due, taken
from tests.naive.rig import sample_ticks

RATES = [Fraction(1), Fraction(1, 2), Fraction(1, 20), Fraction(5), Fraction(3, 20), Fraction(7, 9)]


@pytest.mark.parametrize("rate", RATES)
@pytest.mark.parametrize("phase", [0, 1])
def test_samples_are_due_at_the_listed_ticks(rate: Fraction, phase: int) -> None:
    phase = 0 if rate >= 1 else phase
    steps, slots = 4, -(-4 * rate.numerator // rate.denominator)
    schedule = SensorSchedule(rate.numerator, rate.denominator, phase, steps, slots)
    wanted = sample_ticks(rate, phase, 200)
    due = Due(*(np.zeros(1, dtype=np.int64) for _ in range(3)), np.ones(1, dtype=np.bool_))
    everywhere = np.ones(1, dtype=np.bool_)
    for tick in range(200):
        assert taken(schedule, tick) == sum(at <= tick for at in wanted)
        is_due = call_due(schedule, np.array([tick]), everywhere, due)
        assert int(due.num[0]) == wanted.count(tick)
        assert is_due == (tick in wanted)
        if is_due:
            assert int(due.first[0]) == wanted.index(tick)
            step_end = -(-tick // steps) * steps
            later = sum(tick < at <= step_end for at in wanted)
            assert int(due.slot[0]) == slots - later - wanted.count(tick)


@pytest.mark.parametrize(
    ("dt", "rate", "schedule"),
    [
        (0.05, 20.0, "exact"),
        (0.05, 10.0, "exact"),
        (0.05, 100.0, "exact"),
        (0.1, 50.0, "exact"),
        (0.1, 1.0, "exact"),
        (0.05, 15.0, "accumulate"),
        (0.05, 3.0, "accumulate"),
    ],
)
def test_a_minute_has_sixty_times_as_many_samples_as_the_rate(
    dt: float, rate: float, schedule: str
) -> None:
    rig = {"a": {"type": "odometry", "rate_hz": rate, "schedule": schedule}}
    settings = {
        "rig": rig, "clock.sim_dt_s": dt, "clock.ctrl_dt_s": 1.0, "horizon_s": 60.0,
        "population.mode": "respawn",
    }  # fmt: skip
    vec = make_vec("grid4x4", agents=2, background=0, overrides=settings)
    vec.reset(seed=0)
    stamps = vec.frames()["a"].stamp_s[0, 0, -1:].tolist()
    for _ in range(59):
        vec.step(vec.suggest_actions())
        frames = vec.frames()["a"]
        stamps += frames.stamp_s[0, 0, -int(frames.fresh[0, 0]) :].tolist()
    assert abs(len(stamps) - 59 * rate) <= 1
    assert (np.diff(stamps) > 0.0).all()
    grid = dt / max(1, round(rate * dt))
    np.testing.assert_allclose(np.array(stamps) / grid, np.round(np.array(stamps) / grid))
    if schedule == "exact":
        np.testing.assert_allclose(np.diff(stamps), 1.0 / rate)


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        (
            {"type": "odometry", "rate_hz": 3},
            r"try 2\.85714 or 3\.33333; or set schedule: accumulate",
        ),
        ({"type": "imu", "rate_hz": 30}, "try 20 or 40"),
        ({"type": "gnss", "rate_hz": 30}, "try 20"),
        ({"type": "gnss", "rate_hz": 40}, "at most one sample per tick, 20 Hz"),
        ({"type": "gnss", "rate_hz": 30, "schedule": "accumulate"}, "try 20"),
        ({"type": "imu", "rate_hz": 30, "schedule": "accumulate"}, "try 20 or 40"),
        ({"type": "gnss", "rate_hz": 0}, "must be a number from 0.001"),
        ({"type": "gnss", "rate_hz": 5, "phase_ticks": 4}, "phase_ticks = 4: must be from 0 to 3"),
        ({"type": "imu", "rate_hz": 100, "phase_ticks": 1}, "must be from 0 to 0"),
        ({"type": "gnss", "rate_hz": 5, "noise": [1.0, 2.0]}, "must be one number, or 3"),
        ({"type": "gnss", "rate_hz": 5, "dropout": 1.5}, "dropout = 1.5"),
        ({"type": "depth_camera", "rate_hz": 5, "width": 4000, "height": 4000}, "fewer pixels"),
        ({"type": "lidr", "rate_hz": 5}, r"rig\.a\.type = 'lidr': must be one of lidar"),
        ({"rate_hz": 5}, "a mapping with the key type: one of lidar"),
        ({"type": "lidar", "rate_hz": 5, "rayz": 9}, r"did you mean rig\.a\.rays"),
        ({"type": "lidar", "rate_hz": 5, "range_km": 9}, "use range_m"),
    ],
)
def test_invalid_arguments_are_refused(settings: dict[str, Any], words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        load_config("merge", overrides={"rig": {"a": settings}})


@pytest.mark.parametrize("rate", [2.85714, 3.33333])
def test_rates_that_error_messages_propose_are_accepted(rate: float) -> None:
    load_config("merge", overrides={"rig": {"a": {"type": "gnss", "rate_hz": rate}}})


@pytest.mark.parametrize("name", ["Roof", "a.b", "", "9a", "a" * 65])
def test_invalid_names_of_sensors_are_refused(name: str) -> None:
    with pytest.raises(ConfigError, match="a sensor's name"):
        load_config("merge", overrides={"rig": {name: {"type": "collision"}}})
