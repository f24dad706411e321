"""Random errors of sensors have their configured sizes and are independent."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from cavmarl import make_vec
from cavmarl.sensors.kernels.rig_frames import gauss
from cavmarl.sensors.mounted.mounted_sensor import stream_of

CLEAN = {"type": "odometry", "rate_hz": 20}


def _speeds(rig: dict[str, Any], seed: int = 0, steps: int = 40) -> dict[str, NDArray[np.float64]]:
    """Let the built-in driver drive; return the samples (steps, agents, 3) of each sensor."""
    settings = {"rig": rig, "clock.ctrl_dt_s": 0.05, "population.mode": "respawn"}
    vec = make_vec("grid4x4", agents=24, background=0, overrides=settings)
    vec.reset(seed=seed)
    found: dict[str, list[NDArray[np.float64]]] = {name: [] for name in rig}
    for _ in range(steps):
        vec.step(vec.suggest_actions())
        for name, frames in vec.frames().items():
            found[name].append(frames.data[0, :, -1].astype(np.float64))
    return {name: np.stack(samples) for name, samples in found.items()}


def test_random_numbers_have_a_normal_distribution() -> None:
    key = np.uint64(123456789)
    numbers = np.array(
        [gauss(key, v, t, d) for v in range(20) for t in range(50) for d in range(10)]
    )
    assert abs(numbers.mean()) < 0.03
    assert numbers.std() == pytest.approx(1.0, abs=0.02)
    assert (np.abs(numbers) < 1.0).mean() == pytest.approx(0.6827, abs=0.01)
    assert (np.abs(numbers) > 3.0).mean() == pytest.approx(0.0027, abs=0.002)
    assert abs(np.corrcoef(numbers[:-1], numbers[1:])[0, 1]) < 0.03


def test_noise_and_bias_have_their_configured_sizes() -> None:
    noisy = {**CLEAN, "noise": [0.5, 0.0, 2.0]}
    found = _speeds({"clean": CLEAN, "noisy": noisy, "biased": {**CLEAN, "bias": [3.0]}})
    error = found["noisy"] - found["clean"]
    assert error[..., 0].std() == pytest.approx(0.5, rel=0.1)
    assert (error[..., 1] == 0.0).all()
    assert error[..., 2].std() == pytest.approx(2.0, rel=0.1)
    assert abs(error[..., 0].mean()) < 0.05
    bias = found["biased"] - found["clean"]
    np.testing.assert_allclose(bias, np.broadcast_to(bias[:1], bias.shape), atol=1e-3)
    assert bias[0].std() == pytest.approx(3.0, rel=0.3)
    assert abs(np.corrcoef(bias[0, :, 0], bias[0, :, 1])[0, 1]) < 0.6


def test_the_random_numbers_of_a_sensor_do_not_depend_on_other_sensors() -> None:
    noisy = {**CLEAN, "noise": [1.0]}
    two = _speeds({"a": noisy, "b": noisy})
    assert not np.array_equal(two["a"], two["b"])
    alone = _speeds({"clean": CLEAN, "b": noisy})
    np.testing.assert_array_equal(alone["b"], two["b"])
    assert not np.array_equal(_speeds({"b": noisy}, seed=1)["b"], two["b"])
    assert stream_of("a") != stream_of("b")


def test_the_share_of_lost_samples_equals_the_configured_share() -> None:
    settings = {
        "rig": {"a": {**CLEAN, "rate_hz": 100, "dropout": 0.25}},
        "clock.ctrl_dt_s": 0.5, "population.mode": "respawn",
    }  # fmt: skip
    vec = make_vec("grid4x4", agents=20, background=0, overrides=settings)
    vec.reset(seed=0)
    for _ in range(4):
        vec.step(vec.suggest_actions())
    frames = vec.frames()["a"]
    assert (frames.fresh == 50).all()
    assert frames.lost.mean() == pytest.approx(0.25, abs=0.05)
    assert (frames.data[frames.lost] == 0.0).all()
    assert (frames.data[~frames.lost][:, 2] > 0.0).all()
    assert (frames.stamp_s > 1.5).all()
