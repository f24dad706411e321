"""Left-hand traffic: observations are the mirrored observations of the mirrored world."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import cavmarl
from cavmarl.sensors.observed import sensors_of
from tests.support.mirrored import mirror_net
from tests.support.netgenerate import netgenerate

GRID = ["--grid", "--grid.number", "3", "--grid.length", "120", "-L", "2", "-j", "traffic_light"]
SETTINGS = {
    "sensors.lanes.range_m": 80.0,
    "sensors.signal.timing": True,
    "sensors.way.distances_m": [5.0, 15.0, 30.0],
    "sensors.way.lines": 2,
    "rig": {"lane": {"type": "lane_boundary", "rate_hz": 5}},
}
LIKE = ("ego", "route", "signal", "lanes", "way")  # sensors whose rows are not ordered by distance
TURNED = ("y", "left", "curvature", "lateral_offset", "heading_error", "steering", "yaw_rate")
STEPS = 40


def mirror_of(names: list[str]) -> tuple[list[int], NDArray[np.float64]]:
    """Return for each feature the index in the mirrored world, and the sign."""
    sides = str.maketrans({"<": "right_", ">": "left_"})
    other = [name.replace("left_", "<").replace("right_", ">").translate(sides) for name in names]
    stems = [name.rstrip("_0123456789") for name in names]
    where = [
        names.index(name if stem in TURNED else swapped)
        for name, stem, swapped in zip(names, stems, other, strict=True)
    ]
    return where, np.array([-1.0 if stem in TURNED else 1.0 for stem in stems])


def test_features_of_route_and_lanes_are_mirrored(tmp_path: Path) -> None:
    plain = netgenerate(tmp_path / "right.net.xml", *GRID)
    mirror = mirror_net(plain, tmp_path / "left.net.xml")
    right, left = (
        cavmarl.make_vec(path, agents=9, background=20, overrides=SETTINGS)
        for path in (plain, mirror)
    )
    config = right.config.sensors
    named = [(s.name, f.name) for s in sensors_of(config) for f in s.features(config)]
    chosen = [k for k, (sensor, _) in enumerate(named) if sensor in LIKE]
    where, sign = mirror_of([named[k][1] for k in chosen])
    seen, other = right.reset(seed=3)[0], left.reset(seed=3)[0]
    different = np.zeros(len(chosen), dtype=np.bool_)
    for _ in range(STEPS):
        np.testing.assert_allclose(
            seen[..., chosen], (other[..., chosen] * sign)[..., where], atol=1e-4
        )
        lane, mirrored = (vec.frames()["lane"].data[:, :, -1] for vec in (right, left))
        turned = mirrored[..., [1, 0, 2, 3, 4]] * [1.0, 1.0, 1.0, -1.0, -1.0]
        np.testing.assert_allclose(lane, turned, atol=1e-3)
        different |= (seen != other)[..., chosen].any(axis=(0, 1))
        seen = right.step(right.suggest_actions())[0]
        other = left.step(left.suggest_actions())[0]
    assert different.sum() > 20, "compared features are not symmetric"
    right.close()
    left.close()
