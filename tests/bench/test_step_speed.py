"""The benchmark that compares steps with highway-env, with few agents."""

from __future__ import annotations

import os
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from cavmarl.bench import step_speed
from cavmarl.bench.highway_worlds import (
    IDLE,
    RUN_OUT_M,
    THEIR_KINEMATICS,
    THEIR_LIDAR,
    highway_env,
    length_m,
    straight_road,
)
from cavmarl.bench.step_speed import MORE, Row, measure_step_speed, our_sides
from cavmarl.core.errors import ConfigError, MissingExtraError
from cavmarl.maps.check import check_map


def test_all_programs_and_sensors_are_measured() -> None:
    pytest.importorskip("highway_env")
    told: list[str] = []
    found = measure_step_speed(agents=3, worlds=2, repeats=2, progress=told.append)
    rows = {(row.sensors, row.side): row for row in found.rows}
    assert len(rows) == len(found.rows) == 9
    for row in found.rows:
        assert 0.0 < row.low <= row.median <= row.high
    assert rows["kinematics", "more"].agents == MORE * 3
    assert (rows["lidar", "batched"].worlds, rows["lidar", "highway_env"].worlds) == (2, 1)
    assert [text for text in told if text.startswith("measuring")] == [
        "measuring, 1 of 2",
        "measuring, 2 of 2",
    ]


def test_cavmarl_and_highway_env_have_equal_vehicles_time_steps_and_sensors(tmp_path: Path) -> None:
    pytest.importorskip("highway_env")
    theirs = {seen["type"]: highway_env(5, seen) for seen in (THEIR_LIDAR, THEIR_KINEMATICS)}
    road_m = max(map(length_m, theirs.values()))
    ours = our_sides(tmp_path, road_m, agents=5, worlds=2)
    for sensors, their in (("lidar", "LidarObservation"), ("kinematics", "Kinematics")):
        vec, env = ours[sensors, "batched"][2].args[0], theirs[their]  # type: ignore[attr-defined]
        seconds: list[float] = []
        move = env.road.step
        env.road.step = lambda dt, move=move, told=seconds: (told.append(dt), move(dt))
        seen = env.step((IDLE,) * 5)[0]
        clock = vec.config.clock
        assert seconds == pytest.approx([clock.sim_dt_s] * round(clock.ctrl_dt_s / clock.sim_dt_s))
        vec.reset(seed=0)
        assert vec.num_agents == len(vec.simulation.vehicles()) == len(env.road.vehicles) == 5
        assert len(seen) == 5
        before = vec.simulation.ticks()[0]
        vec.step(np.full((2, 5), np.int64(IDLE)))
        assert vec.simulation.ticks()[0] - before == len(seconds)
        lanes = vec.network.lanes
        on_road = lanes[lanes["edge"] == vec.network.edge_ids.index("road")]
        assert len(on_road) == len(env.road.network.lanes_list())
        assert float(on_road["length_m"][0]) == pytest.approx(road_m, abs=0.01)
    rays, speeds = np.shape(theirs["LidarObservation"].observation_space[0].sample())
    lidar = ours["lidar", "batched"][2].args[0].config.sensors.lidar  # type: ignore[attr-defined]
    assert (rays, speeds) == (lidar.rays, 1 + lidar.speeds)
    assert lidar.range_m == THEIR_LIDAR["maximum_range"]


class FakeWorlds:
    """Two fake worlds of three agents: a reset advances a fake clock by 100 s, a step by 0.5 s."""

    num_envs, num_agents = 2, 3

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.now_s, self.steps, self.agents = 0.0, 0, ["a", "b", "c"]
        clock = SimpleNamespace(process_time=lambda: self.now_s)
        monkeypatch.setattr(step_speed, "time", clock)

    def reset(self, seed: int) -> None:
        self.now_s += 100.0

    def step(self, actions: Any) -> Any:
        self.now_s += 0.5
        self.steps += 1
        taken = actions.values() if isinstance(actions, dict) else np.ravel(actions)
        assert set(taken) == {IDLE}
        acted = {"acted": np.ones((2, 3), np.bool_)}
        return (None, dict.fromkeys(self.agents, 0.0), None, None, acted)


def test_rates_are_agent_steps_per_second_without_resets(monkeypatch: pytest.MonkeyPatch) -> None:
    world: Any = FakeWorlds(monkeypatch)
    assert step_speed.their_rate(world, agents=3) == 3 / 0.5
    assert step_speed.dicts_rate(world) == 3 / 0.5
    assert step_speed.batched_rate(world) == 2 * 3 / 0.5
    assert world.steps == step_speed.THEIR_STEPS + 2 * step_speed.OUR_STEPS


def test_ratios_are_rates_of_cavmarl_over_rates_of_highway_env() -> None:
    medians = {
        ("lidar", "batched"): 600.0, ("lidar", "highway_env"): 20.0,
        ("kinematics", "batched"): 1000.0, ("kinematics", "single"): 500.0,
        ("kinematics", "dicts"): 250.0, ("kinematics", "more"): 800.0,
        ("kinematics", "highway_env"): 10.0, ("kinematics", "highway_env_raw"): 40.0,
    }  # fmt: skip
    rows = [Row(*key, 1, 1, 0.5 * rate, rate, 2.0 * rate) for key, rate in medians.items()]
    found = step_speed.compare(500.0, 2, rows)
    assert (found.ratio, found.ratio_kinematics, found.ratio_kinematics_raw) == (30.0, 100.0, 25.0)
    assert found.cost_of_more == 1.25
    assert found.dict_us == pytest.approx(2000.0)


def test_the_road_of_the_benchmark_can_be_driven(tmp_path: Path) -> None:
    report = check_map(straight_road(tmp_path, 500.0))
    assert report.drivable
    assert report.road_km == pytest.approx((500.0 + RUN_OUT_M) / 1000.0)


@pytest.mark.skipif(not hasattr(os, "sched_getaffinity"), reason="no affinity on this system")
def test_after_a_measurement_on_one_core_the_process_may_use_all_its_cores() -> None:
    before = os.sched_getaffinity(0)
    with step_speed.one_core():
        assert len(os.sched_getaffinity(0)) == 1
    assert os.sched_getaffinity(0) == before


@pytest.mark.parametrize("wrong", [{"agents": 0}, {"worlds": 0}, {"repeats": 0}, {"agents": 10**6}])
def test_numbers_out_of_range_are_refused(wrong: dict[str, int]) -> None:
    with pytest.raises(ConfigError, match=next(iter(wrong))):
        measure_step_speed(**wrong)


def test_the_error_without_highway_env_names_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    def absent(module: str) -> None:
        raise ModuleNotFoundError(name=module)

    monkeypatch.setattr("cavmarl.core.errors.importlib.import_module", absent)
    with pytest.raises(MissingExtraError, match=r"pip install .*\[bench\]'"):
        measure_step_speed(agents=1)
