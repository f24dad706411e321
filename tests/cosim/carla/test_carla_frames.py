"""Agents in a zone that a CARLA server runs get the frames of that server."""

from __future__ import annotations

import base64
import math
from typing import Any

import numpy as np
import pytest

import cavmarl
from cavmarl.config.rig import (
    DepthCameraConfig,
    LidarRigConfig,
    RadarConfig,
    RgbCameraConfig,
    SemanticCameraConfig,
)
from cavmarl.core.errors import ConfigError
from cavmarl.handoff.simulators.carla_frames import sample_of
from cavmarl.sensors.kernels.panorama import BUILDING, CAR, NOTHING, ROAD
from cavmarl.sensors.mounted.lidar import has_echo
from tests.cosim.carla.test_carla_zones import carla_zones, step_on

SIZE: dict[str, Any] = {"rate_hz": 10.0, "width": 64, "height": 36, "x_m": 1.0, "z_m": 1.6}
RIG: dict[str, Any] = {
    "depth": {"type": "depth_camera", **SIZE},
    "classes": {"type": "semantic_camera", "yaw_deg": 90.0, **SIZE},
    "colours": {"type": "rgb_camera", "pitch_deg": -10.0, **SIZE},
    "roof": {
        "type": "lidar", "rate_hz": 10.0, "z_m": 1.4, "layers": 4, "rays": 90, "range_m": 60.0,
    },
    "ahead": {
        "type": "lidar", "rate_hz": 20.0, "x_m": 1.5, "z_m": 0.8, "rays": 45, "fov_deg": 120.0,
    },
    "radar": {"type": "radar", "rate_hz": 10.0, "x_m": 1.5, "z_m": 0.6, "rays": 240},
    "gnss": {"type": "gnss", "rate_hz": 10.0},
}  # fmt: skip


@pytest.mark.parametrize("backend", ["local", "nodes:2"])
def test_agents_in_a_hosted_zone_get_the_frames_of_the_server(backend: str) -> None:
    """Compare the frames with those of a world without a server.

    The server of this test is a cavmarl server, so the frames are nearly equal.
    """
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
        echoes = targets = met = 0
        for agent in np.flatnonzero(vec.worlds.arrays.mask[0]).tolist():
            sample, due = (one["depth"].data[0, agent, -1] for one in (found, model))
            assert sample.dtype == np.float16
            near = np.abs(sample.astype(float) - due) < 0.05 * due + 1.0
            assert near.mean() > 0.9
            sample, due = (one["classes"].data[0, agent, -1] for one in (found, model))
            assert (sample == due).mean() > 0.85
            sample, due = (one["colours"].data[0, agent, -1] for one in (found, model))
            assert np.abs(sample.astype(int) - due).mean() < 25.0
            assert not np.array_equal(sample, due), "the picture is not from the server"
            for lidar in ("roof", "ahead"):
                sample, due = (one[lidar].data[0, agent, -1] for one in (found, model))
                range_m = float(due.max())
                assert (has_echo(sample, range_m) == has_echo(due, range_m)).mean() > 0.9
                assert (np.abs(sample - due) < 0.05 * due + 1.0).mean() > 0.9
                echoes += int(has_echo(sample, range_m).sum())
            sample, due = (one["radar"].data[0, agent, -1] for one in (found, model))
            num, num_due = (int((one[:, 0] > 0.0).sum()) for one in (sample, due))
            assert abs(num - num_due) <= 2
            targets += num_due
            for target in due[:num_due]:
                apart = np.abs(sample[:num] - target)
                met += bool((apart < [2.5, 0.1, 1.5]).all(axis=1).any())
        assert echoes > 100
        assert targets > 3
        assert met >= 0.7 * targets
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


def data(rows: list[tuple[float, ...]]) -> str:
    return base64.b64encode(np.array(rows, "<f4").tobytes()).decode()


@pytest.mark.parametrize(("rays", "fov_deg"), [(8, 360.0), (5, 360.0), (5, 80.0), (1, 80.0)])
def test_each_point_becomes_the_distance_of_its_ray(rays: int, fov_deg: float) -> None:
    config = LidarRigConfig(rate_hz=10.0, rays=rays, fov_deg=fov_deg, layers=3, range_m=50.0)
    step = 360.0 / rays if fov_deg == 360.0 or rays == 1 else fov_deg / (rays - 1)
    first = 0.0 if fov_deg == 360.0 or rays == 1 else -0.5 * fov_deg
    points: list[tuple[float, ...]] = []
    due = np.full((3, rays), 50.0)
    for layer, elevation in enumerate((-15.0, -5.0, 5.0)):
        for ray in range(rays):
            for beside, distance_m in ((0.0, 10.0 * (layer + 1) + ray), (0.5, 3.0)):
                azimuth = math.radians(first + (ray + beside) * step)
                rising = math.radians(elevation)
                level = distance_m * math.cos(rising)
                # CARLA's second axis is to the right.
                points.append(
                    (
                        level * math.cos(azimuth), -level * math.sin(azimuth),
                        distance_m * math.sin(rising), 1.0,
                    )
                )  # fmt: skip
            if (layer, ray) == (1, 0):
                del points[-2]  # this ray has no echo
            else:
                due[layer, ray] = 10.0 * (layer + 1) + ray
    np.testing.assert_allclose(sample_of(config, data(points)), due, rtol=1e-5)
    assert (sample_of(config, "") == 50.0).all()


def test_echoes_become_targets() -> None:
    """Echoes are (speed, azimuth to the right, altitude, distance); wall and car are targets."""
    wall = [(-5.0, math.radians(a), 0.0, 10.0 - a) for a in (-20.0, -19.0, -18.0)]
    car = [(2.0, math.radians(a), 0.0, 12.0 + 0.1 * a) for a in (-17.5, -17.0, -16.5)]
    beside = [(9.0, math.radians(-16.0), 0.0, 12.0)]  # at the distance of the car, but faster
    ground = [(-5.0, math.radians(10.0), -0.1, 5.0)]
    config = RadarConfig(rate_hz=10.0, z_m=0.5, targets=4)
    found = sample_of(config, data([*beside, *ground, *wall, *car]))
    car_m = 12.0 - 1.75
    due = [(car_m, 17.5, 2.0), (12.0, 16.0, 9.0), (28.0, 18.0, -5.0), (0.0, 0.0, 0.0)]
    expected = [(distance, math.radians(azimuth), speed) for distance, azimuth, speed in due]
    assert found == pytest.approx(np.array(expected), abs=1e-5)
    assert sample_of(RadarConfig(rate_hz=10.0, targets=1), data(wall)).shape == (1, 3)
    assert not sample_of(config, "").any()


@pytest.mark.parametrize(
    ("sensor", "message"),
    [
        (
            {"type": "bev_grid", "rate_hz": 10.0},
            r"zones\.simulators\.1: frames=backend: rig\.eye is of type bev_grid; a CARLA server",
        ),
        (
            {"type": "radar", "rate_hz": 10.0, "fov_deg": 200.0},
            r"rig\.eye\.fov_deg = 200: a radar of CARLA covers at most 179 degrees",
        ),
        (
            {"type": "depth_camera", "noise": [0.1], **SIZE},
            r"rig\.eye has noise or bias, which CARLA's frames do not get",
        ),
    ],
)
def test_sensors_that_carla_cannot_provide_are_refused_by_name(
    sensor: dict[str, Any], message: str
) -> None:
    with pytest.raises(ConfigError, match=message):
        cavmarl.make_vec(
            "grid4x4",
            zones=2,
            zone_simulators={1: "carla://127.0.0.1:9?frames=backend"},
            overrides={"rig": {"eye": sensor}},
        )


def test_an_invalid_option_for_frames_is_refused() -> None:
    with pytest.raises(ConfigError, match="frames = 'yes': must be own"):
        cavmarl.make_vec("grid4x4", zones=2, zone_simulators={1: "carla://a:1?frames=yes"})
