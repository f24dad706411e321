"""The sensors `way`, `conflicts` and `history`: known values, divisions and settings.

The first two are also compared with twins, which are slow implementations in tests/naive.
"""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

import cavmarl
from cavmarl.config.sensors import ConflictsConfig, HistoryConfig, SensorsConfig, WayConfig
from cavmarl.core.compiled import IS_PLAIN
from cavmarl.core.math.neighbors import fill_grid, make_grid
from cavmarl.core.math.walls import make_walls
from cavmarl.driving.kernels.junctions.gaps import link_signal
from cavmarl.roads.network import SIGNAL_STATES
from cavmarl.sensors.kernels.observing_conflicts import observe_conflicts
from cavmarl.sensors.kernels.observing_way import observe_way
from cavmarl.sensors.observed import (
    conflicts_sensor,
    feature_names,
    frame_size,
    layout,
    way_sensor,
)
from cavmarl.shards.shard import CONTROLLER
from cavmarl.v2x.kernels.v2x_records import REPORT
from cavmarl.verify.equivalence import verify_zones
from tests.naive import observing_way as naive
from tests.sensors.test_observing_lanes import phases, traffic
from tests.support.netgenerate import netgenerate
from tests.support.traffic import NAMES, network, on_lane, plans, travel

DISTANCES_M = [3.0, 8.0, 20.0, 45.0, 90.0]
COUNT, RANGE_M, LINES = 4, 60.0, 2
CONFIG = SensorsConfig(
    way=WayConfig(distances_m=tuple(DISTANCES_M), lines=LINES, timing=False),
    conflicts=ConflictsConfig(count=COUNT, range_m=RANGE_M),
)
SIGNS = {
    shown: replace(CONFIG, way=replace(CONFIG.way, stop_signs=shown))
    for shown in ("give_way", "own", "red")
}
INDICATED = replace(CONFIG, conflicts=replace(CONFIG.conflicts, indicators=True))
NEAR_M = 25.0
INDICATED_NEAR = replace(CONFIG, conflicts=replace(INDICATED.conflicts, indicators_m=NEAR_M))
DEPARTING = replace(
    CONFIG, conflicts=replace(INDICATED_NEAR.conflicts, departs=True, horizon_s=8.0)
)
# These settings are those of the environment `cities`.
ON = {
    "sensors.way.distances_m": DISTANCES_M,
    "sensors.way.lines": LINES,
    "sensors.way.timing": True,
    "sensors.conflicts.count": 8,
    "sensors.history.steps": 3,
}


def observed_way(
    name: str, row: np.void, phase: NDArray[np.int32], config: SensorsConfig = CONFIG
) -> list[float]:
    roads = network(name)
    place = layout(config)["way"]
    out = np.zeros(frame_size(config), np.float32)
    controllers = np.zeros(roads.num_controllers, CONTROLLER)
    sensor = way_sensor.settings(config, place.start)
    observe_way(roads.arrays, travel(name), controllers, row, phase, 0.0, 0.1, sensor, out)
    assert not out[: place.start].any()
    assert not out[place.stop :].any()
    return [float(value) for value in out[place]]


def observed_conflicts(
    name: str,
    rows: NDArray[np.void],
    i: int,
    phase: NDArray[np.int32],
    config: SensorsConfig = CONFIG,
) -> list[float]:
    roads = network(name)
    grid = make_grid(roads.extent_m, 25.0, len(rows))
    fill_grid(rows, len(rows), grid)
    place = layout(config)["conflicts"]
    out = np.zeros(frame_size(config), np.float32)
    sensor = conflicts_sensor.settings(
        config, place.start, make_walls(np.zeros((0, 4))), 0, len(rows)
    )
    told = np.zeros(0, REPORT)
    observe_conflicts(roads.arrays, travel(name), rows, i, grid, phase, told, 0, 0.1, sensor, out)
    assert not out[: place.start].any()
    assert not out[place.stop :].any()
    return [float(value) for value in out[place]]


def shown(name: str, phase: NDArray[np.int32]) -> dict[int, str]:
    """Return the letter that each link with a signal shows."""
    roads = network(name)
    with_signal = np.flatnonzero(roads.links["signal"] >= 0)
    return {int(k): SIGNAL_STATES[link_signal(roads.arrays, int(k), phase)] for k in with_signal}


@pytest.mark.parametrize("name", NAMES)
@settings(deadline=None, max_examples=25)
@given(data=st.data(), random=st.randoms(use_true_random=False))
def test_way_and_conflicts_equal_twin_for_any_order_of_rows(
    name: str, data: st.DataObject, random: object
) -> None:
    rows = data.draw(traffic(name))
    rows["width"] = 2.0
    # Rounding would decide the order of vehicles at equal or mirrored positions, so move all
    # vehicles by random distances.
    nudge = np.random.default_rng(0).uniform(0.0, 1.0, (2, len(rows)))
    rows["x"], rows["y"] = rows["x"] + nudge[0], rows["y"] + nudge[1]
    phase = phases(name, random)
    letters = shown(name, phase)
    roads, ways = network(name), plans(name)
    order = data.draw(st.permutations(range(len(rows))))
    for place, i in enumerate(order):
        for stop_signs, config in SIGNS.items():
            found = observed_way(name, rows[i], phase, config)
            twin = naive.places(roads, ways, rows[i], DISTANCES_M)
            twin += naive.lines(roads, ways, rows[i], letters, LINES, 100.0, stop_signs)
            assert found == pytest.approx(twin, abs=2e-5)
        seen = observed_conflicts(name, rows, i, phase)
        assert seen == observed_conflicts(name, rows[order], place, phase)
        twin = naive.conflicts(roads, ways, rows, i, letters, COUNT, RANGE_M)
        assert seen == pytest.approx(twin, abs=2e-5)
        for config, from_m in ((INDICATED, 0.0), (INDICATED_NEAR, NEAR_M)):
            seen = observed_conflicts(name, rows, i, phase, config)
            assert seen == observed_conflicts(name, rows[order], place, phase, config)
            twin = naive.conflicts(
                roads, ways, rows, i, letters, COUNT, RANGE_M, indicators=True, from_m=from_m
            )
            assert seen == pytest.approx(twin, abs=2e-5)
        seen = observed_conflicts(name, rows, i, phase, DEPARTING)
        how = {"indicators": True, "from_m": NEAR_M, "horizon_s": 8.0, "departs": True}
        twin = naive.conflicts(roads, ways, rows, i, letters, COUNT, RANGE_M, **how)
        assert seen == pytest.approx(twin, abs=2e-5)


def test_a_waiting_vehicle_observes_whom_it_would_meet_if_it_departed() -> None:
    """A vehicle stands 31 m behind a standing one, which it reaches in 5.5 s with 2 m/s²."""
    rows = on_main_road((100.0, 0.0, 0.0), (131.0, 0.0, 0.0))
    phase = np.zeros(0, np.int32)
    rows["length"] = 4.0

    def near_and_soon(**keys: Any) -> list[float]:
        config = replace(CONFIG, conflicts=replace(CONFIG.conflicts, **keys))
        return observed_conflicts("merge", rows, 0, phase, config)[:2]

    # At 3 m/s, the vehicle comes 13.5 m closer within 4.5 s.
    assert near_and_soon() == pytest.approx([2.0 / (2.0 + 27.0 - 13.5), 2.0 / 6.5])
    # It would drive 25 m within 5 s, and 30.25 m within 5.5 s.
    assert near_and_soon(departs=True, horizon_s=5.0) == pytest.approx([2.0 / 4.0, 2.0 / 7.0])
    assert near_and_soon(departs=True, horizon_s=8.0) == pytest.approx([1.0, 2.0 / 7.5])


def test_the_route_of_another_vehicle_is_unknown_until_it_is_indicated() -> None:
    roads, ways = network("grid4x4"), plans("grid4x4")
    phase = np.zeros(len(roads.arrays.signals), np.int32)
    links = roads.links
    lane = next(k for k in np.unique(links["from_lane"]) if np.sum(links["from_lane"] == k) > 1)
    goals = {int(ways[goal][lane]["link"]): goal for goal in range(len(ways))}
    goals.pop(-1, None)
    assert len(goals) > 1

    def numbers(from_line_m: float, goal: int) -> list[float]:
        s = float(roads.lanes[lane]["length_m"]) - from_line_m
        rows = np.concatenate([on_lane(roads, lane, s - 20.0), on_lane(roads, lane, s, speed=10.0)])
        rows["goal"], rows["id"] = [min(goals.values()), goal], [0, 1]
        rows["way"] = rows["goal"] * len(roads.lanes)
        return observed_conflicts("grid4x4", rows, 0, phase, INDICATED_NEAR)

    for from_line_m, is_known in ((NEAR_M + 1.0, False), (NEAR_M - 1.0, True)):
        seen = {tuple(numbers(from_line_m, goal)) for goal in goals.values()}
        assert (len(seen) > 1) == is_known


def on_main_road(*cars: tuple[float, float, float]) -> NDArray[np.void]:
    """Return cars at (s, d, speed) on the road behind the merge, whose goal is the road's end."""
    roads = network("merge")
    lane = roads.lane_ids.index("main_out_0")
    rows = np.concatenate([on_lane(roads, lane, s, d=d, speed=speed) for s, d, speed in cars])
    rows["goal"] = len(plans("merge")) - 1
    rows["way"] = rows["goal"] * len(roads.lanes)
    rows["id"] = np.arange(len(rows))
    return rows


def test_vehicles_are_ordered_by_time_to_contact() -> None:
    # One car stands 30 m ahead. The other car is 10 m behind and slower.
    rows = on_main_road((100.0, 0.0, 20.0), (90.0, 0.0, 2.0), (130.0, 0.0, 0.0))
    numbers = np.array(observed_conflicts("merge", rows, 0, np.zeros(0, np.int32))).reshape(-1, 9)
    assert numbers[0, 2] == pytest.approx(30.0 / 40.0)
    assert numbers[0, 4] == pytest.approx(-20.0 / 30.0)
    assert numbers[0, :2] == pytest.approx(
        [1.0, 2.0 / 3.5]
    )  # contact with the standing car in 1.5 s
    assert numbers[1, 2] == pytest.approx(-10.0 / 20.0)
    assert not numbers[2:].any()


@pytest.mark.parametrize("config", [CONFIG, INDICATED_NEAR])
def test_plans_and_controls_of_other_vehicles_have_no_effect(config: SensorsConfig) -> None:
    """Vehicles indicate only near junctions, and these vehicles are far from any junction."""
    rows = on_main_road((100.0, 0.0, 20.0), (90.0, 0.0, 2.0), (130.0, 0.0, 0.0))
    phase = np.zeros(0, np.int32)
    before = observed_conflicts("merge", rows, 0, phase, config)
    for name in ("goal", "way", "target_lane", "link", "throttle", "steering", "to_go"):
        rows[name][1:] = 0
    assert observed_conflicts("merge", rows, 0, phase, config) == before


def test_an_indicated_route_is_known_over_the_next_junction_only() -> None:
    """Compare routes that differ at the next junction, and routes that differ only later."""
    roads, ways = network("grid4x4"), plans("grid4x4")
    phase = np.zeros(len(roads.arrays.signals), np.int32)
    num_lanes = len(roads.lanes)

    def numbers(lane: int, s: float, goal: int) -> list[float]:
        other = on_lane(roads, lane, s, speed=10.0)
        before = int(np.flatnonzero(roads.links["from_lane"] == lane)[0])
        ego = on_lane(roads, int(roads.links[before]["to_lane"]), 5.0, speed=0.0)
        rows = np.concatenate([ego, other])
        rows["goal"], rows["id"] = [0, goal], [0, 1]
        rows["way"] = rows["goal"] * num_lanes
        return observed_conflicts("grid4x4", rows, 0, phase, INDICATED)

    told_apart = alike = 0
    for lane in np.unique(roads.links["from_lane"]):
        s = float(roads.lanes[lane]["length_m"]) - 12.0
        goals = [goal for goal in range(len(ways)) if ways[goal][lane]["link"] >= 0]
        for one, other in pairwise(goals):
            first, second = (int(ways[goal][lane]["link"]) for goal in (one, other))
            same = numbers(int(lane), s, one) == numbers(int(lane), s, other)
            assert same or first != second
            alike += same and first == second
            told_apart += not same
    assert told_apart > 0
    assert alike > 0


def made(env: str = "grid4x4", **overrides: Any) -> Any:
    settings: dict[str, Any] = {"population.mode": "respawn", **ON, **overrides}
    return cavmarl.make_vec(env, num_envs=2, agents=6, background=12, seed=1, overrides=settings)


@pytest.mark.skipif(IS_PLAIN, reason="compares no twin")
def test_history_contains_earlier_observations_and_begins_with_copies_of_the_first() -> None:
    vec = made()
    place = layout(vec.config.sensors)["history"]
    observations, infos = vec.reset()
    assert place.stop == observations.shape[2], "the history is not the last part"
    rng = np.random.default_rng(0)
    fresh = 0
    before = None
    for _ in range(60):
        history = observations[..., place].reshape(2, 6, 3, 3)
        mask = infos["mask"]
        if before is None:
            entered = mask
        else:
            entered = mask & ~infos["acted"]
            stayed = mask & infos["acted"] & ~infos["vehicle_done"]
            np.testing.assert_array_equal(history[stayed][:, 1:], before[stayed][:, :-1])
        fresh += int(entered.sum())
        np.testing.assert_array_equal(history[entered][:, 1:], history[entered][:, :-1])
        before = history
        actions = rng.uniform(-1.0, 1.0, (2, 6, 2)).astype(np.float32)
        observations, *_, infos = vec.step(actions)
    assert fresh > 12, "no agent entered later"
    vec.close()


@pytest.mark.skipif(IS_PLAIN, reason="compares no twin")
@pytest.mark.parametrize(
    "conflicts",
    [{}, {"indicators": True}, {"indicators": True, "departs": True, "horizon_s": 8.0}],
)
def test_observations_in_a_divided_world_equal_the_undivided_ones(
    conflicts: dict[str, Any],
) -> None:
    shown = {f"sensors.conflicts.{key}": value for key, value in conflicts.items()}
    shown["sensors.way.stop_signs"] = "own"
    whole, divided = made(**shown), made(**shown, **{"zones.count": 4})
    rng = np.random.default_rng(1)
    one, other = whole.reset()[0], divided.reset()[0]
    for _ in range(40):
        np.testing.assert_array_equal(one, other)
        assert whole.observation_space.contains(one)
        actions = rng.uniform(-0.4, 0.6, (2, 6, 2)).astype(np.float32)
        actions[..., 1] *= 0.05
        one, other = whole.step(actions)[0], divided.step(actions)[0]
    whole.close()
    divided.close()


@pytest.mark.skipif(IS_PLAIN, reason="compares no twin")
def test_a_saved_state_keeps_the_history() -> None:
    vec = made()
    vec.reset()
    actions = np.full((2, 6, 2), 0.1, np.float32)
    for _ in range(5):
        vec.step(actions)
    saved = vec.save_state()
    expected = vec.step(actions)[0]
    vec.load_state(saved)
    np.testing.assert_array_equal(vec.step(actions)[0], expected)
    vec.close()


@pytest.mark.parametrize("wrong", [(5.0, 5.0), (9.0, 4.0), (0.1,), (400.0,), (math.nan,)])
def test_invalid_distances_are_refused(wrong: tuple[float, ...]) -> None:
    with pytest.raises(cavmarl.ConfigError, match=r"sensors\.way\.distances_m"):
        WayConfig(distances_m=wrong)


def test_a_horizon_between_two_predictions_is_refused() -> None:
    with pytest.raises(cavmarl.ConfigError, match=r"horizon_s = 4\.7: must be a multiple of 0\.5"):
        ConflictsConfig(count=1, horizon_s=4.7)


def test_without_sight_switches_off_the_sensor_conflicts_and_the_lines_of_way() -> None:
    config = SensorsConfig(
        way=WayConfig(distances_m=(5.0,), lines=2),
        conflicts=ConflictsConfig(count=3),
        history=HistoryConfig(steps=1),
    )
    assert {"way", "conflicts", "history"} <= set(layout(config))
    assert "conflicts" not in layout(config.without_sight())
    assert config.without_sight().way.lines == 0


def test_the_time_to_a_signal_change_is_not_observed_by_default() -> None:
    config = SensorsConfig(way=WayConfig(lines=1))
    assert not config.way.timing
    assert not config.signal.timing
    names = [feature.name for feature in way_sensor.SENSOR.features(config)]
    assert names == ["line_0", "line_red_0", "line_yellow_0", "line_green_0", "line_yields_0"]


@pytest.mark.integration
@pytest.mark.parametrize("kind", ["allway_stop", "priority_stop"])
def test_stop_signs_are_observed_equally_in_all_divisions(tmp_path: Path, kind: str) -> None:
    path = netgenerate(
        tmp_path / "stops.net.xml",
        "--grid",
        "--grid.number",
        "3",
        "--grid.length",
        "90",
        "-j",
        kind,
    )
    keys = {**ON, "sensors.way.stop_signs": "own", "sensors.signal.stop_signs": "own"}
    found = verify_zones(path, (2, 4), overrides=keys, agents=6, background=30, steps=30, seed=3)
    assert all(result.difference is None for result in found.results)
    whole, divided = (
        cavmarl.make_vec(
            path, num_envs=2, agents=6, background=20, overrides={**keys, "zones.count": zones},
            workers=workers,
        )
        for zones, workers in ((1, 0), (2, 2))
    )  # fmt: skip
    one, other = whole.reset(seed=1)[0], divided.reset(seed=1)[0]
    stops = [
        name.startswith(("line_stop", "stop")) for _, name in feature_names(whole.config.sensors)
    ]
    seen = 0
    for _ in range(10):
        np.testing.assert_array_equal(one, other)
        seen += int(one[..., stops].sum())
        actions = whole.suggest_actions()
        one, other = whole.step(actions)[0], divided.step(actions)[0]
    assert seen > 20
    whole.close()
    divided.close()
