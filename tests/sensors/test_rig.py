"""Samples of mounted sensors do not depend on zones, workers or saved states."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cavmarl import make_vec, parallel_env
from cavmarl.config.registry import load_config, load_rig
from cavmarl.config.rig import GnssConfig
from cavmarl.core.errors import ActionError, ConfigError
from cavmarl.engine.world_setup import load_world
from cavmarl.env.vector import CavVectorEnv
from cavmarl.parallel.worlds.local_worlds import LocalWorlds
from cavmarl.shards.shard import Commands
from cavmarl.verify.equivalence import verify_zones
from tests.support.replayed import BUSY

PLACE = {"x_m": 1.5, "y_m": -0.5, "z_m": 1.2, "yaw_deg": 20.0}
RIG: dict[str, Any] = {
    "wheels": {"type": "odometry", "rate_hz": 5, "noise": [0.1, 0.01, 0.5], "bias": [0.05]},
    "slow": {"type": "odometry", "rate_hz": 2.5, "phase_ticks": 1, "dropout": 0.3},
    "odd": {"type": "odometry", "rate_hz": 3, "schedule": "accumulate"},
    "imu": {"type": "imu", "rate_hz": 50, "noise": [0.01], **PLACE},
    "gnss": {"type": "gnss", "rate_hz": 5, "noise": [1.0], "bias": [2.0], "dropout": 0.1, **PLACE},
    "lane": {"type": "lane_boundary", "rate_hz": 5, "noise": [0.02], **PLACE},
    "events": {"type": "collision", "dropout": 0.2},
}
WORLD = {**BUSY, "rig": RIG}
# All rates are 5 Hz, because the original rates do not fit the long ticks of these tests.
TEN: dict[str, Any] = {
    "rig": "ten_sensors",
    **dict.fromkeys((f"rig.{name}.rate_hz" for name in load_rig("ten_sensors")), 5),
}


@pytest.mark.parametrize(
    "rig",
    [{"rig": RIG}, TEN, {"rig": RIG, "zones.repartition_steps": 5}],
    ids=["rig", "ten", "repartition"],
)
def test_samples_of_divided_worlds_equal_the_undivided_world(rig: dict[str, Any]) -> None:
    modes = {"observation.mode": "sensors", "observation.kind": "dict"}
    overrides = {**BUSY, **modes, **rig}
    found = verify_zones("grid4x4", (2, 4, 9), overrides=overrides, steps=30, seed=3)
    for result in found.results:
        assert result.difference is None, result
        assert result.steps == 30
    assert sum(result.crossings for result in found.results) > 20


def _drive(vec: CavVectorEnv, steps: int = 8) -> list[bytes]:
    """Drive some steps; return all frames and state hashes."""
    vec.reset(seed=7)
    seen = []
    for _ in range(steps):
        vec.step(vec.suggest_actions())
        for frames in (*vec.frames().values(), *vec.final_frames().values()):
            seen += [array.tobytes() for array in frames]
        seen += [vec.state_hash(w).encode() for w in range(vec.num_envs)]
    return seen


@pytest.mark.parametrize(("worlds", "zones", "workers"), [(2, 1, 2), (1, 2, 2)])
def test_samples_of_workers_equal_those_of_one_process(
    worlds: int, zones: int, workers: int
) -> None:
    def make(zones: int, workers: int) -> CavVectorEnv:
        return make_vec(
            "grid4x4", num_envs=worlds, zones=zones, workers=workers, max_cycles=5, overrides=WORLD
        )

    alone = _drive(make(1, 0))
    vec = make(zones, workers)
    try:
        assert _drive(vec) == alone
    finally:
        vec.close()


def test_a_world_after_a_reset_has_only_the_samples_that_are_due_at_its_start() -> None:
    vec = make_vec("grid4x4", num_envs=2, overrides=WORLD)
    vec.reset(seed=0)
    for _ in range(3):
        vec.step(vec.suggest_actions())
    kept = vec.frames()
    vec.reset(options={"reset_mask": np.array([True, False])})
    frames = vec.frames()
    for name, sensor in frames.items():
        for array, before in zip(sensor, kept[name], strict=True):
            np.testing.assert_array_equal(array[1], before[1])
    assert (frames["wheels"].fresh[0] == 1).all()
    assert (frames["wheels"].stamp_s[0] == 0.0).all()
    assert (frames["wheels"].data[0, :, -1, 0] != 0.0).all()
    assert (frames["slow"].fresh[0] == 0).all()
    assert (frames["slow"].data[0] == 0.0).all()


def test_a_state_that_is_loaded_into_other_worlds_keeps_its_samples() -> None:
    world = load_world("grid4x4", overrides=WORLD)
    here, there = LocalWorlds(world, 2), LocalWorlds(world, 2)
    here.arrays.chosen[:] = True
    here.reset(3, 0)
    nothing = Commands(here.arrays.controls, here.arrays.meta_actions)
    for _ in range(3):
        here.step(nothing)
    there.load([array.copy() for array in here.save()])
    for worlds in (here, there):
        worlds.arrays.chosen[:] = [True, False]
        worlds.reset(None, 0)
        worlds.step(nothing)
    for name, sensor in here.arrays.frames.items():
        for array, other in zip(sensor, there.arrays.frames[name], strict=True):
            np.testing.assert_array_equal(array, other)
    assert [here.state_hash(w) for w in (0, 1)] == [there.state_hash(w) for w in (0, 1)]


def test_samples_of_agents_without_a_vehicle_are_zeros() -> None:
    overrides = {**WORLD, "population.mode": "open", "population.agents": 6}
    vec = make_vec("grid4x4", overrides=overrides, autoreset_mode="NextStep")
    rng = np.random.default_rng(0)
    vec.reset(seed=1)
    left = 0
    for _ in range(60):
        actions = np.clip(rng.normal(0.0, 1.0, vec.action_space.shape), -1, 1).astype(np.float32)
        *_, infos = vec.step(actions)
        present = vec.simulation.outputs.present
        left += int((~present).sum())
        for sensor in vec.frames().values():
            for array in sensor:
                assert not array[~present].any()
        if infos["episode_over"].any():
            break
    assert left > 0


def test_frames_of_an_agent_contain_only_its_own_samples() -> None:
    vec = make_vec("grid4x4", overrides=WORLD)
    env = parallel_env("grid4x4", overrides=WORLD)
    vec.reset(seed=4)
    env.reset(seed=4)
    for _ in range(3):
        env.step(env.suggest_actions())
        vec.step(vec.suggest_actions())
    for name, sensor in env.frames("car_2").items():
        for array, all_of_them in zip(sensor, vec.frames()[name], strict=True):
            np.testing.assert_array_equal(array, all_of_them[0, 2])
    with pytest.raises(ActionError, match="no agent 'car_99'"):
        env.frames("car_99")


def test_a_rig_can_be_named_or_read_from_a_file(tmp_path: Path) -> None:
    config, _ = load_config("merge", overrides={"rig": "ten_sensors", "rig.gnss.rate_hz": 10})
    assert len(config.rig) == 10
    assert len({type(sensor) for sensor in config.rig.values()}) == 10
    gnss = config.rig["gnss"]
    assert isinstance(gnss, GnssConfig)
    assert gnss.rate_hz == 10.0
    own = tmp_path / "own.yaml"
    own.write_text("wheels: {type: odometry, rate_hz: 20}", encoding="utf-8")
    entry = tmp_path / "env.yaml"
    entry.write_text("{name: mine, map: {source: a.net.xml}, rig: own.yaml}", encoding="utf-8")
    assert list(load_config(tmp_path)[0].rig) == ["wheels"]
    assert list(load_config("merge", overrides={"rig": str(own)})[0].rig) == ["wheels"]
    with pytest.raises(
        ConfigError, match=r"rig = 'eleven': no such rig; give one of .*ten_sensors"
    ):
        load_config("merge", overrides={"rig": "eleven"})
    with pytest.raises(ConfigError, match="No such file"):
        load_config("merge", overrides={"rig": "nowhere.yaml"})


def test_samples_of_ten_sensors_lie_in_their_spaces() -> None:
    overrides = {"rig": "ten_sensors", "observation.mode": "sensors", "observation.kind": "dict"}
    env = parallel_env("grid4x4", agents=4, background=60, overrides=overrides)
    seen, _ = env.reset(seed=0)
    for _ in range(6):
        for agent, samples in seen.items():
            assert env.observation_space(agent).contains(samples)
            for name, sample in samples.items():
                if name not in ("imu", "lane", "wheels", "front_radar"):
                    assert sample.any(), name
        seen, *_ = env.step(env.suggest_actions())
