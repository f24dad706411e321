"""Cameras of agents in a hosted zone give the pictures of the CARLA server."""

from __future__ import annotations

import base64
from typing import Any

import numpy as np
import pytest

import cavmarl
from cavmarl.config.rig import DepthCameraConfig, RgbCameraConfig, SemanticCameraConfig
from cavmarl.core.errors import ConfigError
from cavmarl.handoff.simulators.carla_frames import sample_of
from cavmarl.sensors.kernels.panorama import BUILDING, CAR, NOTHING, ROAD
from tests.cosim.carla.test_carla_zones import carla_zones, step_on

SIZE: dict[str, Any] = {"rate_hz": 10.0, "width": 64, "height": 36, "x_m": 1.0, "z_m": 1.6}
RIG: dict[str, Any] = {
    "depth": {"type": "depth_camera", **SIZE},
    "classes": {"type": "semantic_camera", "yaw_deg": 90.0, **SIZE},
    "colours": {"type": "rgb_camera", "pitch_deg": -10.0, **SIZE},
    "gnss": {"type": "gnss", "rate_hz": 10.0},
}


@pytest.mark.parametrize("backend", ["local", "nodes:2"])
def test_cameras_in_a_hosted_zone_give_the_pictures_of_the_server(backend: str) -> None:
    """The server of the test has cavmarl's own cameras, so its pictures must be nearly equal."""
    overrides = {"rig": RIG, "traffic.endless": True}
    own = cavmarl.make_vec("grid4x4", agents=4, background=40, seed=3, overrides=overrides)
    own.reset()
    with carla_zones(
        2, 0, 1, options="?frames=backend", overrides=overrides, backend=backend, background=40
    ) as vec:
        vec.reset()
        step_on(vec, 4)
        step_on(own, 4)
        found, model = vec.frames(), own.frames()
        for agent in np.flatnonzero(vec.worlds.arrays.mask[0]).tolist():
            sample, due = (one["depth"].data[0, agent, -1] for one in (found, model))
            assert sample.dtype == np.float16
            near = np.abs(sample.astype(float) - due) < 0.05 * due + 1.0
            assert near.mean() > 0.9
            sample, due = (one["classes"].data[0, agent, -1] for one in (found, model))
            assert (sample == due).mean() > 0.85
            sample, due = (one["colours"].data[0, agent, -1] for one in (found, model))
            assert np.abs(sample.astype(int) - due).mean() < 25.0
            assert not np.array_equal(sample, due), "it is the server's picture"
        assert np.array_equal(found["gnss"].stamp_s, model["gnss"].stamp_s)
    own.close()


def picture(*pixel: int) -> str:
    """Return an encoded picture of two equal pixels: blue, green, red, alpha."""
    return base64.b64encode(bytes(pixel) * 2).decode()


def test_pixels_become_samples() -> None:
    form: dict[str, Any] = {"rate_hz": 10.0, "width": 2, "height": 1}
    rgb = sample_of(RgbCameraConfig(**form), picture(1, 2, 3, 255))
    assert rgb.tolist() == [[[3, 2, 1]] * 2]
    steps = round(25.0 / 1000.0 * ((1 << 24) - 1))
    far = picture(steps >> 16 & 255, steps >> 8 & 255, steps & 255, 255)
    depth = sample_of(DepthCameraConfig(**form), far)
    assert depth == pytest.approx(25.0, abs=0.02)
    assert (sample_of(DepthCameraConfig(**form, range_m=20.0), far) == 20.0).all()
    for tag, semantic in ((1, ROAD), (14, CAR), (11, NOTHING), (3, BUILDING), (6, BUILDING)):
        classes = sample_of(SemanticCameraConfig(**form), picture(0, 0, tag, 255))
        assert (classes == semantic).all()


@pytest.mark.parametrize(
    ("sensor", "message"),
    [
        (
            {"type": "lidar", "rate_hz": 10.0},
            r"zones\.simulators\.1: frames=backend: rig\.eye is of type lidar; a CARLA server",
        ),
        (
            {"type": "depth_camera", "noise": [0.1], **SIZE},
            r"rig\.eye has noise or bias, which CARLA's pictures do not get",
        ),
    ],
)
def test_sensors_without_such_frames_are_refused_by_name(
    sensor: dict[str, Any], message: str
) -> None:
    with pytest.raises(ConfigError, match=message):
        cavmarl.make_vec(
            "grid4x4",
            zones=2,
            zone_simulators={1: "carla://127.0.0.1:9?frames=backend"},
            overrides={"rig": {"eye": sensor}},
        )


def test_the_option_is_checked() -> None:
    with pytest.raises(ConfigError, match="frames = 'yes': must be own"):
        cavmarl.make_vec("grid4x4", zones=2, zone_simulators={1: "carla://a:1?frames=yes"})
