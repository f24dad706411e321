"""Features of observations equal values computed from the map file, and from rays and rectangles.

The tests check

- offset, direction and speed limit of `ego`;
- places, widths, speed limits, stop lines, colours, times of change and stop signs of `way`;
- all distances of `lidar`, and positions of `neighbors`.

Other files of this folder compare `conflicts` and `lanes` with their twins.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import cavmarl
from cavmarl.sensors.observed import feature_names
from tests.naive import net_features
from tests.naive.observing_way import way_of
from tests.support.netgenerate import netgenerate

pytestmark = pytest.mark.integration
GRID = ["--grid", "--grid.number", "3", "--grid.length", "90", "-L", "2", "-j"]
DISTANCES_M = [4.0, 12.0, 30.0, 60.0]
RAYS, RANGE_M, TICK_S = 24, 50.0, 0.1
SETTINGS: dict[str, Any] = {
    "clock.sim_dt_s": TICK_S,
    "clock.ctrl_dt_s": 0.2,
    "sensors.way.distances_m": DISTANCES_M,
    "sensors.way.lines": 2,
    "sensors.way.timing": True,
    "sensors.way.stop_signs": "own",
    "sensors.lidar.rays": RAYS,
    "sensors.lidar.range_m": RANGE_M,
    "sensors.neighbors.range_m": RANGE_M,
}
Seen = dict[tuple[str, str], float]


def observed(path: Path, steps: int) -> Iterator[tuple[Seen, np.void, NDArray[np.void], Any]]:
    """Drive; yield an agent's features by (sensor, name), its row, all rows and the environment."""
    vec = cavmarl.make_vec(path, agents=6, background=40, overrides=SETTINGS)
    names = feature_names(vec.config.sensors)
    observations, infos = vec.reset(seed=4)
    for step in range(steps):
        rows = vec.simulation.vehicles().copy()
        for row in rows[rows["agent"] >= 0] if step % 5 == 0 else ():
            values = map(float, observations[0, row["agent"]])
            yield dict(zip(names, values, strict=True)), row, rows, vec
        observations, *_, infos = vec.step(vec.suggest_actions())
        assert infos["mask"].any()
    vec.close()


def unit(value: float) -> float:
    return min(max(value, -1.0), 1.0)


def turned(angle: float) -> float:
    return math.remainder(angle, 2.0 * math.pi)


@pytest.mark.parametrize("kind", ["traffic_light", "allway_stop", "priority_stop"])
def test_paths_and_stop_lines_equal_those_of_the_map_file(tmp_path: Path, kind: str) -> None:
    path = netgenerate(tmp_path / "grid.net.xml", *GRID, kind)
    net = net_features.read_net(path)
    told = {"stop": 0, "red": 0, "green": 0, "bend": 0}
    for seen, row, _, vec in observed(path, 200):
        ids, time_s = vec.network.lane_ids, float(vec.simulation.ticks()[0]) * TICK_S
        way = [
            (net.lanes[ids[stretch.lane]], ids[stretch.lane])
            for stretch in way_of(vec.network, vec.simulation.plans, row)
        ]
        here = way[0][0]
        s = float(row["s"]) * here.length_m / float(vec.network.lanes[row["lane"]]["length_m"])
        x, y, direction = here.pose(s)
        offset = (row["y"] - y) * math.cos(direction) - (row["x"] - x) * math.sin(direction)
        assert seen["ego", "lateral_offset"] == pytest.approx(unit(offset / 4.0), abs=0.01)
        error = turned(row["heading"] - direction) / math.pi
        assert seen["ego", "heading_error"] == pytest.approx(error, abs=0.02)
        assert seen["ego", "speed_limit"] == pytest.approx(here.limit_mps / 40.0)
        start, lines = -s, []
        poses: dict[int, tuple[float, float, net_features.FileLane]] = {}
        for k, (lane, name) in enumerate(way):
            end = start + lane.length_m
            for j, distance in enumerate(DISTANCES_M):
                if j not in poses and (distance <= end or k + 1 == len(way)):
                    poses[j] = (*lane.pose(min(distance, end) - start)[:2], lane)
            after = way[k + 1][1] if k + 1 < len(way) else ""
            # Search by the next lane only. After a lane change, the link begins on another lane.
            before = [one for one in net.states if one[1] == after]
            if not name.startswith(":") and before and end <= 100.0:
                lines.append((end, *net.states[before[0]]))
            start = end
        for j, (px, py, lane) in poses.items():
            left = (py - row["y"]) * math.cos(row["heading"])
            left -= (px - row["x"]) * math.sin(row["heading"])
            wanted = unit(left / DISTANCES_M[j])
            assert seen["way", f"left_{j}"] == pytest.approx(wanted, abs=0.03)
            assert seen["way", f"width_{j}"] == pytest.approx(lane.width_m / 8.0)
            assert seen["way", f"limit_{j}"] == pytest.approx(lane.limit_mps / 40.0)
            told["bend"] += abs(wanted) > 0.3
        shown = [one for one in lines if one[2] or one[1] in "wsm="]
        for j, (end, state, signal, index) in enumerate(shown[:2]):
            near = 20.0 / (20.0 + max(end, 0.0))
            letter, left_s = net.letter(signal, index, time_s) if signal else ("", math.inf)
            assert seen["way", f"line_{j}"] == pytest.approx(near, abs=0.01)
            assert seen["way", f"line_red_{j}"] == (letter == "r")
            assert seen["way", f"line_yellow_{j}"] == (letter == "y")
            assert seen["way", f"line_green_{j}"] == (letter in ("g", "G"))
            assert seen["way", f"line_stop_{j}"] == (not signal and state in "ws")
            assert seen["way", f"line_change_{j}"] == pytest.approx(5.0 / (5.0 + left_s), abs=0.02)
            if not signal:
                assert seen["way", f"line_yields_{j}"] == 1.0
            told["stop"] += not signal and state in "ws"
            told["red"] += letter == "r"
            told["green"] += letter in ("g", "G")
    assert told["bend"] > 5
    assert min(told["red"], told["green"]) > 10 if kind == "traffic_light" else told["stop"] > 10


def test_rays_end_at_the_rectangles_of_vehicles_and_neighbours_have_their_positions(
    tmp_path: Path,
) -> None:
    path = netgenerate(tmp_path / "grid.net.xml", *GRID, "traffic_light")
    hits = 0
    for seen, row, rows, _ in observed(path, 60):
        others = rows[rows["id"] != row["id"]]
        place, heading = (float(row["x"]), float(row["y"])), float(row["heading"])
        for k in range(RAYS):
            direction = heading + 2.0 * math.pi * k / RAYS
            wanted = net_features.ray_distance(place, direction, others, RANGE_M) / RANGE_M
            assert seen["lidar", f"distance_{k}"] == pytest.approx(wanted, abs=2e-3)
            hits += wanted < 1.0
        apart = np.hypot(others["x"] - row["x"], others["y"] - row["y"])
        near = [k for k in np.argsort(apart, kind="stable") if apart[k] <= RANGE_M][:8]
        for j, k in enumerate(near):
            angle = math.atan2(others["y"][k] - row["y"], others["x"][k] - row["x"]) - heading
            for name, share in (("x", math.cos(angle)), ("y", math.sin(angle))):
                wanted = float(apart[k]) * share / RANGE_M
                assert seen["neighbors", f"{name}_{j}"] == pytest.approx(wanted, abs=1e-5)
    assert hits > 50
