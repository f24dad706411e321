"""GNSS positions equal those of PROJ and of the vehicle; errors of antennas are independent."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyproj
import pytest
import sumolib
from numpy.typing import NDArray

from cavmarl import make_vec
from cavmarl.config.rig import GnssConfig
from cavmarl.core.errors import MapError
from cavmarl.roads.cache import load_network
from cavmarl.roads.sumo_net.reader import read_network
from cavmarl.sensors.mounted.geodesy import TangentPlane, geodesy_of
from tests.naive.rig import place_in_world

ACOSTA = "net/bologna_acosta/acosta_buslanes.net.xml"


def _metres_apart(one: NDArray[np.float64], other: NDArray[np.float64]) -> float:
    """Return the largest distance between two lists of latitudes, longitudes and heights."""
    _, _, apart = pyproj.Geod(ellps="WGS84").inv(one[:, 1], one[:, 0], other[:, 1], other[:, 0])
    return float(np.hypot(apart, one[:, 2] - other[:, 2]).max())


@pytest.mark.parametrize("origin", [(48.0, 11.0, 0.0), (-33.9, 151.2, 58.0), (69.6, -18.9, 3.0)])
def test_a_tangent_plane_equals_the_projection_of_proj(origin: tuple[float, float, float]) -> None:
    plane = TangentPlane(*origin)
    points = np.random.default_rng(0).uniform(-5000.0, 5000.0, (50, 3)) * [1.0, 1.0, 0.01]
    lat, lon, height = origin
    steps = (
        f"+proj=pipeline +step +inv +proj=topocentric +lat_0={lat} +lon_0={lon} +h_0={height} "
        "+ellps=WGS84 +step +inv +proj=cart +ellps=WGS84"
    )
    east, north, up = pyproj.Transformer.from_pipeline(steps).transform(*points.T)
    found = plane.to_earth(points)
    assert _metres_apart(found, np.stack([north, east, up], axis=1)) < 1e-6
    np.testing.assert_allclose(plane.to_map(found), points, atol=1e-6)


def test_the_projection_of_a_map_is_used(shared_maps: Path) -> None:
    network = read_network(shared_maps / ACOSTA)
    assert load_network(shared_maps / ACOSTA).geo == network.geo
    assert load_network(shared_maps / ACOSTA).geo == network.geo  # the second call reads the cache
    geodesy = geodesy_of(network, GnssConfig(rate_hz=1.0, origin_height_m=54.0))
    low, high = np.array(network.extent_m).reshape(2, 2)
    points = np.random.default_rng(1).uniform([*low, 0.0], [*high, 20.0], (200, 3))
    found = geodesy.to_earth(points)
    net = sumolib.net.readNet(str(shared_maps / ACOSTA))
    wanted = np.array([net.convertXY2LonLat(x, y)[::-1] for x, y, _ in points])
    assert _metres_apart(found, np.column_stack([wanted, points[:, 2] + 54.0])) < 0.01
    assert np.abs(geodesy.to_map(found) - points).max() < 0.01
    assert 44.4 < found[0, 0] < 44.6  # latitude and longitude of Bologna
    assert 11.2 < found[0, 1] < 11.4


def test_an_antenna_is_at_its_mounting_position() -> None:
    gnss = {"type": "gnss", "rate_hz": 20, "x_m": -1.0, "y_m": 0.7, "z_m": 1.5}
    vec = make_vec("grid4x4", agents=5, background=10, overrides={"rig": {"gnss": gnss}})
    config = vec.config.rig["gnss"]
    assert isinstance(config, GnssConfig)
    geodesy = geodesy_of(vec.network, config)
    vec.reset(seed=0)
    for _ in range(10):
        vec.step(vec.suggest_actions())
        for row in vec.simulation.vehicles():
            if row["agent"] >= 0:
                place = vec.frames()["gnss"].data[0, row["agent"], -1:]
                np.testing.assert_allclose(
                    geodesy.to_map(place)[0], place_in_world(row, config), atol=1e-6
                )


def test_errors_of_an_antenna_differ_between_ticks_and_vehicles() -> None:
    gnss = {"type": "gnss", "rate_hz": 20}
    rig = {"clean": gnss, "noisy": {**gnss, "noise": [2.0, 2.0, 0.0]}}
    settings = {"rig": rig, "clock.ctrl_dt_s": 0.05, "population.mode": "respawn"}
    vec = make_vec("grid4x4", agents=12, background=0, overrides=settings)
    config = vec.config.rig["clean"]
    assert isinstance(config, GnssConfig)
    geodesy = geodesy_of(vec.network, config)
    vec.reset(seed=0)
    errors = []
    for _ in range(20):
        vec.step(vec.suggest_actions())
        frames = vec.frames()
        noisy, clean = (geodesy.to_map(frames[name].data[0, :, -1]) for name in ("noisy", "clean"))
        errors.append(noisy - clean)
    found = np.stack(errors)  # (ticks, agents, axes)
    np.testing.assert_allclose(found[..., 2], 0.0, atol=1e-6)
    for axis in range(2):
        assert found[..., axis].std(axis=0).mean() == pytest.approx(2.0, rel=0.2), (
            "errors over ticks"
        )
        assert found[..., axis].std(axis=1).mean() == pytest.approx(2.0, rel=0.2), (
            "errors over vehicles"
        )


def test_an_offset_that_is_not_a_number_is_refused(tmp_path: Path, shared_maps: Path) -> None:
    text = (shared_maps / "net/mcity/mcity.net.xml").read_text(encoding="utf-8")
    broken = tmp_path / "m.net.xml"
    broken.write_text(text.replace('netOffset="0.00,0.00"', 'netOffset="0.00,east"'))
    with pytest.raises(MapError, match="netOffset of its location"):
        read_network(broken)


def test_a_projection_that_proj_does_not_know_is_refused(tmp_path: Path, shared_maps: Path) -> None:
    text = (shared_maps / "net/mcity/mcity.net.xml").read_text(encoding="utf-8")
    broken = tmp_path / "m.net.xml"
    broken.write_text(text.replace("+proj=tmerc", "+proj=nowhere"))
    with pytest.raises(MapError, match=r"projection .*nowhere"):
        geodesy_of(read_network(broken), GnssConfig(rate_hz=1.0))
