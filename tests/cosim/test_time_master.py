"""The time master: no other caller ticks the world, and the master changes no result."""

from __future__ import annotations

import numpy as np
import pytest

import cavmarl
from cavmarl.core.errors import ClockError, ConfigError
from cavmarl.cosim.time_master import OwnTicks, Pacer, RealTime, Stepwise, TimeMaster
from cavmarl.engine.step_trace import SENSORS, TICK, StepTrace
from cavmarl.shards.shard import Commands

FOREVER = {"population.mode": "respawn", "clock.ctrl_dt_s": 0.05, "horizon_s": 600}


def make(zones: int = 1, **more: object) -> cavmarl.CavEnv:
    return cavmarl.parallel_env(
        "ring", agents=2, background=4, zones=zones, overrides=FOREVER | more
    )


def hashes(master: TimeMaster, env: cavmarl.CavEnv, steps: int) -> list[str]:
    found = []
    for _ in range(steps):
        master.step(env.suggest_actions())
        found.append(env.state_hash())
    return found


def plain_hashes(steps: int) -> list[str]:
    env = make()
    env.reset(seed=3)
    found = []
    for _ in range(steps):
        env.step(env.suggest_actions())
        found.append(env.state_hash())
    return found


def test_time_is_exact_after_5000_ticks() -> None:
    env = make()
    master = TimeMaster(env)
    master.reset(seed=0)
    for _ in range(5000):
        master.step(env.suggest_actions())
    assert master.tick == 5000
    assert master.time_s == 250.0
    assert master.world_ticks.tolist() == [5000]
    assert env.worlds.arrays.ticks.tolist() == [5000]


def test_a_second_master_is_refused_until_the_first_is_released() -> None:
    env = make()
    first = TimeMaster(env)
    with pytest.raises(ClockError, match="follow"):
        TimeMaster(env)
    first.release()
    TimeMaster(env).reset(seed=0)
    with pytest.raises(ClockError, match="released"):
        first.step({})


def test_only_the_master_steps_or_resets_its_environment() -> None:
    env = make()
    master = TimeMaster(env)
    with pytest.raises(ClockError, match=r"TimeMaster\.reset"):
        env.reset(seed=0)
    master.reset(seed=0)
    before = env.state_hash()
    with pytest.raises(ClockError, match=r"TimeMaster\.step"):
        env.step(env.suggest_actions())
    assert env.state_hash() == before
    master.release()
    env.step(env.suggest_actions())


@pytest.mark.parametrize("own_ticks", ["refuse", "ignore"])
def test_followers_change_no_trajectory(own_ticks: OwnTicks) -> None:
    env = make()
    master = TimeMaster(env, own_ticks=own_ticks)
    master.reset(seed=3)
    found = hashes(master, env, 5)
    follower = master.follow("stack")
    for _ in range(5):
        if own_ticks == "refuse":
            with pytest.raises(ClockError, match="stack"):
                follower.tick()
        else:
            assert not follower.tick()
        found += hashes(master, env, 1)
    follower.leave()
    with pytest.raises(ClockError, match="join again"):
        follower.tick()
    assert found == plain_hashes(10)
    assert follower.own_ticks == master.own_ticks == 5
    assert master.drift_ticks == 0
    assert [(event.tick, event.kind, event.follower) for event in master.events] == [
        (tick, "own_tick", "stack") for tick in range(5, 10)
    ]


def test_the_drift_after_an_obeyed_tick_of_a_follower_is_detected_before_the_next_tick() -> None:
    env = make()
    master = TimeMaster(env, own_ticks="obey", on_drift="record")
    master.reset(seed=0)
    follower = master.follow("rogue")
    assert not follower.tick()  # a tick repeats the last step, but there is no step yet
    for step in range(10):
        master.step(env.suggest_actions())
        if step % 3 == 0:
            assert follower.tick()
    master.look_for_drift()
    drifts = [event for event in master.events if event.kind == "drift"]
    assert [(event.tick, event.ticks) for event in drifts] == [(1, 1), (4, 1), (7, 1), (10, 1)]
    assert master.drift_ticks == 4
    assert master.tick == 10
    assert master.world_ticks.tolist() == [14]


def test_steps_without_the_master_are_detected_and_refused() -> None:
    env = make()
    master = TimeMaster(env)
    master.reset(seed=0)
    master.step(env.suggest_actions())
    simulation = env.simulation
    shape = simulation.outputs.present.shape
    simulation.step(Commands(np.zeros((*shape, 2)), np.ones(shape, dtype=np.int64)))
    with pytest.raises(ClockError, match="tick 2, but its time master left it at 1"):
        master.step(env.suggest_actions())
    assert master.world_ticks.tolist() == [2]
    master.step(env.suggest_actions())


@pytest.mark.parametrize(
    "pacer", [None, RealTime(5.0), RealTime(1e6), Stepwise(lambda time_s: None)]
)
def test_no_pacer_changes_the_states(pacer: Pacer | None) -> None:
    env = make()
    master = TimeMaster(env, pacer=pacer)
    master.reset(seed=3)
    assert hashes(master, env, 10) == plain_hashes(10)


class WallClock:
    """A clock that advances only by sleeping and by simulated work."""

    def __init__(self) -> None:
        self.time_s = 100.0

    def now(self) -> float:
        return self.time_s

    def pass_by(self, seconds: float) -> None:
        self.time_s += seconds


def test_a_real_time_pacer_waits_and_measures_delays() -> None:
    wall = WallClock()
    pacer = RealTime(2.0, wall.now, wall.pass_by)
    starts = []
    for step, work_s in enumerate([0.01, 0.2, 0.0, 0.0, 0.0, 0.01]):
        pacer.wait(0.1 * step)
        starts.append(round(wall.time_s - 100.0, 6))
        wall.pass_by(work_s)
    # Steps are due every 0.05 s. The second step takes 0.2 s, so later steps start without waiting.
    assert starts == [0.0, 0.05, 0.25, 0.25, 0.25, 0.25]
    lateness = pacer.lateness
    assert (lateness.steps, lateness.late) == (6, 3)
    assert lateness.worst_wall_s == pytest.approx(0.15)
    assert lateness.mean_wall_s == pytest.approx((0.15 + 0.1 + 0.05) / 6)


def test_a_stepwise_pacer_is_asked_before_each_step() -> None:
    asked: list[float] = []
    env = make()
    master = TimeMaster(env, pacer=Stepwise(asked.append))
    master.reset(seed=0)
    hashes(master, env, 3)
    assert asked == [0.0, 0.05, 2 * 0.05]


@pytest.mark.parametrize("factor", [0.0, -1.0, float("nan"), float("inf")])
def test_an_impossible_pace_is_refused(factor: float) -> None:
    with pytest.raises(ConfigError, match="above 0"):
        RealTime(factor)


@pytest.mark.parametrize("zones", [1, 3])
def test_a_step_runs_one_tick_and_then_the_sensors(zones: int) -> None:
    trace = StepTrace()
    env = make(zones)
    master = TimeMaster(env, trace=trace)
    master.reset(seed=3)
    assert hashes(master, env, 4) == plain_hashes(4)
    assert trace.cycles == [(TICK, SENSORS)] * 4


def test_a_longer_step_has_more_ticks_and_one_frame() -> None:
    trace = StepTrace()
    env = make(**{"clock.ctrl_dt_s": 0.1})
    master = TimeMaster(env, trace=trace)
    master.reset(seed=0)
    hashes(master, env, 2)
    assert trace.cycles == [(TICK, TICK, SENSORS)] * 2
    assert master.tick == 4


def test_the_worlds_of_a_vector_environment_keep_their_time_master_in_new_episodes() -> None:
    vec = cavmarl.make_vec("ring", num_envs=2, agents=2, background=2, overrides={"horizon_s": 0.5})
    master = TimeMaster(vec)
    master.reset(seed=0)
    for _ in range(12):
        master.step(vec.suggest_actions())
    assert master.tick == 24
    assert vec.worlds.arrays.ticks.tolist() == master.world_ticks.tolist() == [4, 4]


def test_an_action_takes_effect_after_the_latency() -> None:
    for latency in (0, 1):
        env = make(**{"clock.control_latency_ticks": latency, "action.out_of_range": "clip"})
        master = TimeMaster(env)
        master.reset(seed=0)
        brake = {agent: np.array([-1.0, 0.0], dtype=np.float32) for agent in env.agents}
        throttles = []
        for _ in range(2):
            master.step(brake)
            rows = env.simulation.vehicles()
            throttles.append(float(rows["throttle"][rows["agent"] == 0][0]))
        assert (throttles[0] < -1.0) is (latency == 0)
        assert throttles[1] < -1.0


def test_worlds_in_worker_processes_have_a_time_master() -> None:
    found = []
    for workers in (0, 2):
        vec = cavmarl.make_vec("ring", num_envs=2, workers=workers, agents=2, background=2)
        master = TimeMaster(vec)
        master.reset(seed=0)
        for _ in range(5):
            master.step(vec.suggest_actions())
        with pytest.raises(ClockError):
            vec.step(vec.suggest_actions())
        assert (master.tick, master.world_ticks.tolist()) == (10, [10, 10])
        found.append([vec.state_hash(world) for world in range(2)])
        vec.close()
    assert found[0] == found[1]
