"""A world and its followers: controls, waiting, and failures of followers."""

from __future__ import annotations

import random
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cavmarl.core.errors import (
    ClockError,
    ConfigError,
    EpisodeError,
    FollowerError,
    FollowerLostError,
)
from cavmarl.cosim.followers.followed_world import FollowedWorld
from cavmarl.cosim.followers.follower_client import Follower, FollowerView
from cavmarl.cosim.followers.follower_connection import call
from cavmarl.cosim.followers.follower_messages import Control, Hello, Say
from cavmarl.engine.step_trace import QUEUE, SENSORS, STACK, TICK, StepTrace
from tests.cosim.conftest import drive, hashes, join_world, make_env, steer

Start = Callable[[Callable[[], Any]], threading.Thread]


def reference(steps: int, drivers: dict[str, Any]) -> list[str]:
    """Return the state hashes of a world without followers.

    Agents in `drivers` use the controls of `steer`; other agents use the suggested actions.
    """
    env = make_env()
    observations, _ = env.reset(seed=1)
    found = []
    for _ in range(steps):
        actions = env.suggest_actions()
        for agent in drivers:
            actions[agent] = np.tanh(observations[agent][:2])
        observations, *_ = env.step(actions)
        found.append(env.state_hash())
    return found


def test_a_follower_drives_bit_for_bit_like_a_policy(address: Path, start: Start) -> None:
    seen: list[FollowerView] = []
    with FollowedWorld(make_env(), address) as world:
        driver = start(lambda: seen.extend(drive(address, ["car_1"])))
        world.wait_for(1, 10.0)
        world.reset(seed=1)
        found = hashes(world, 10)
    driver.join(10.0)
    assert found == reference(10, {"car_1": None})
    assert not address.exists()
    for frame, sight in enumerate(seen):
        snapshot = sight.snapshot
        assert (snapshot.frame, snapshot.tick, snapshot.time_s) == (frame, frame, frame * 0.05)
        assert sight.sensors["car_1"]["observation"].stamps_s.tolist() == [frame * 0.05]
        assert list(snapshot.vehicles) == ["car_1"]
        assert snapshot.vehicles["car_1"].vclass == "passenger"
    assert len(seen) == 11


def test_answers_may_come_in_any_order(address: Path, start: Start) -> None:
    delays = random.Random(0)

    def answer_late(agent: str) -> None:
        with Follower(address, [agent], f"driver of {agent}") as follower:
            for sight in follower:
                time.sleep(delays.random() * 0.004)
                follower.answer(steer(sight))

    with FollowedWorld(make_env(zones=2), address) as world:
        for agent in ("car_2", "car_0", "car_1"):
            start(lambda agent=agent: answer_late(agent))
            world.wait_for(len(world.seats) + 1, 10.0)
        world.reset(seed=1)
        found = hashes(world, 12)
        seats = world.seats
        assert [seat.agents for seat in seats] == [(0,), (1,), (2,)]
        assert sum(seat.slowest for seat in seats) == 13
        assert all(seat.wait_wall_s > 0.0 for seat in seats)
        assert [entry["agents"] for entry in world.manifest()["followers"]] == [
            ["car_0"], ["car_1"], ["car_2"],
        ]  # fmt: skip
    assert found == reference(12, dict.fromkeys(["car_0", "car_1", "car_2"]))


def test_one_follower_can_drive_several_vehicles(address: Path, start: Start) -> None:
    with FollowedWorld(make_env(), address) as world:
        start(lambda: drive(address, ["car_2", "car_0"]))
        world.wait_for(1, 10.0)
        world.reset(seed=1)
        assert hashes(world, 6) == reference(6, dict.fromkeys(["car_0", "car_2"]))


def test_a_follower_that_joins_does_not_affect_other_followers(address: Path, start: Start) -> None:
    env = make_env()
    with FollowedWorld(env, address) as world:
        world.reset(seed=1)
        found = hashes(world, 4)
        ids = sorted(env.simulation.vehicles()["id"].tolist())
        start(lambda: drive(address, []))  # this follower drives no vehicle
        world.wait_for(1, 10.0)
        found += hashes(world, 4)
        assert sorted(env.simulation.vehicles()["id"].tolist()) == ids
        start(lambda: drive(address, ["car_1"]))
        world.wait_for(2, 10.0)
        world.step()
        assert world.seats[0].answers == 2  # this frame and the next one
    assert found == reference(8, {})


def test_a_cycle_runs_tick_sensors_stack_and_queue_in_this_order(
    address: Path, start: Start
) -> None:
    trace = StepTrace()
    with FollowedWorld(make_env(), address, trace=trace) as world:
        start(lambda: drive(address, ["car_0"]))
        world.wait_for(1, 10.0)
        world.reset(seed=0)
        hashes(world, 3)
    assert trace.cycles == [(TICK, SENSORS, STACK, QUEUE)] * 3


def test_controls_are_queued_for_the_next_cycle(address: Path, start: Start) -> None:
    def brake_at_frame_2() -> None:
        with Follower(address, ["car_0"]) as follower:
            for sight in follower:
                follower.answer({"car_0": [-1.0 if sight.snapshot.frame == 2 else 0.0, 0.0]})

    throttles = []
    env = make_env()
    with FollowedWorld(env, address) as world:
        start(brake_at_frame_2)
        world.wait_for(1, 10.0)
        world.reset(seed=0)
        for _ in range(4):
            world.step()
            rows = env.simulation.vehicles()
            throttles.append(float(rows["throttle"][rows["agent"] == 0][0]))
        assert world.manifest()["control_latency_steps"] == 1
    # The frame of the second step has number 2; controls computed from it act in the third step.
    assert [throttle < -1.0 for throttle in throttles] == [False, False, True, False]


def test_a_slow_follower_holds_the_world_and_misses_no_frame(address: Path, start: Start) -> None:
    frames = []

    def answer_slowly() -> None:
        with Follower(address, ["car_0"]) as follower:
            for sight in follower:
                frames.append(sight.snapshot.frame)
                time.sleep(0.05)
                follower.answer(steer(sight))

    with FollowedWorld(make_env(), address) as world:
        start(answer_slowly)
        world.wait_for(1, 10.0)
        world.reset(seed=0)
        began = time.monotonic()
        hashes(world, 4)
        assert time.monotonic() - began > 0.2
        assert world.seats[0].wait_wall_s > 0.2  # the world need not wait for the last answer
    assert frames == [0, 1, 2, 3, 4]


def test_a_silent_follower_is_dropped_and_the_world_continues(address: Path) -> None:
    env = make_env()
    with FollowedWorld(env, address, timeout_s=0.2) as world:
        silent = join_world(world, ["car_0"], "silent")
        with pytest.raises(FollowerLostError, match=r"'silent' has not answered within 0\.2 s"):
            world.reset(seed=1)
        assert world.seats == ()
        assert hashes(world, 3) == reference(3, {})
        assert silent.wait() is not None
        with pytest.raises(FollowerError, match="has not answered"):
            silent.wait()
        silent.close()


def test_a_silent_follower_does_not_block_other_followers(address: Path, start: Start) -> None:
    with FollowedWorld(make_env(), address, timeout_s=0.3) as world:
        with join_world(world, ["car_0"], "silent"):
            start(lambda: drive(address, ["car_1"]))
            world.wait_for(2, 10.0)
            with pytest.raises(FollowerLostError):
                world.reset(seed=1)
        assert [seat.agents for seat in world.seats] == [(1,)]
        assert hashes(world, 3) == reference(3, {"car_1": None})


def test_a_follower_may_leave_without_an_error(address: Path) -> None:
    with FollowedWorld(make_env(), address) as world:
        follower = join_world(world, ["car_0"])
        follower.leave()
        world.reset(seed=1)
        assert world.seats == ()
        assert hashes(world, 2) == reference(2, {})


def test_followers_see_the_end_of_an_episode_and_need_not_answer(
    address: Path, start: Start
) -> None:
    seen: list[FollowerView] = []
    with FollowedWorld(make_env(horizon_s=0.15), address) as world:
        driver = start(lambda: seen.extend(drive(address, ["car_0"])))
        world.wait_for(1, 10.0)
        for seed in (0, 1):
            world.reset(seed=seed)
            while not world.is_over:
                world.step()
        with pytest.raises(EpisodeError, match="reset"):
            world.step()
    driver.join(10.0)
    assert [sight.snapshot.is_over for sight in seen] == [False, False, False, True] * 2
    assert [sight.snapshot.episode for sight in seen] == [0] * 4 + [1] * 4
    assert [sight.snapshot.frame for sight in seen] == list(range(8))


@pytest.mark.parametrize(
    ("controls", "match"),
    [
        ({"car_0": [float("nan"), 0.0]}, "nan"),
        ({"car_0": [7.0, 0.0]}, "7"),
        ({"car_0": [0.0]}, "shape"),
        ({"car_0": 1}, "car_0"),
        ({}, "no controls of car_0"),
        ({"car_0": [0.0, 0.0], "car_1": [0.0, 0.0]}, "car_1, which is not in the frame"),
    ],
)
def test_bad_controls_are_refused_and_the_world_continues(
    address: Path, start: Start, controls: dict[str, Any], match: str
) -> None:
    told = []

    def answer_badly() -> None:
        with Follower(address, ["car_0"], "bad") as follower:
            try:
                for _ in follower:
                    follower.answer(controls)
            except FollowerError as error:
                told.append(str(error))

    with FollowedWorld(make_env(), address) as world:
        start(answer_badly)
        world.wait_for(1, 10.0)
        with pytest.raises(FollowerError, match=match):
            world.reset(seed=1)
        assert hashes(world, 2) == reference(2, {})
    assert "follower 'bad'" in told[0]


def test_bad_controls_can_be_replaced_by_the_last_controls_and_counted(
    address: Path, start: Start
) -> None:
    def answer_sometimes_badly() -> None:
        with Follower(address, ["car_0"]) as follower:
            for sight in follower:
                is_bad = sight.snapshot.frame % 2 == 1
                follower.answer({"car_0": [float("nan") if is_bad else -1.0, 0.0]})

    env = make_env()
    with FollowedWorld(env, address, bad_controls="hold") as world:
        start(answer_sometimes_badly)
        world.wait_for(1, 10.0)
        world.reset(seed=1)
        for _ in range(5):
            world.step()
            rows = env.simulation.vehicles()
            assert rows["throttle"][rows["agent"] == 0][0] < -1.0
        (seat,) = world.seats
        assert (seat.answers, seat.bad) == (6, 3)


@pytest.mark.parametrize("own_ticks", ["refuse", "ignore"])
def test_refused_or_ignored_ticks_of_a_follower_do_not_change_the_world(
    address: Path, start: Start, own_ticks: Any
) -> None:
    refused = []

    def ticks() -> None:
        with Follower(address, ["car_1"], "ticker") as follower:
            for sight in follower:
                try:
                    assert not follower.tick().done
                except ClockError as error:
                    refused.append(str(error))
                follower.answer(steer(sight))

    with FollowedWorld(make_env(), address, own_ticks=own_ticks) as world:
        start(ticks)
        world.wait_for(1, 10.0)
        world.reset(seed=1)
        assert hashes(world, 4) == reference(4, {"car_1": None})
        assert world.master.own_ticks == 5
        assert world.master.drifts == 0
    assert len(refused) == (5 if own_ticks == "refuse" else 0)


def test_a_vehicle_has_one_follower(address: Path) -> None:
    with FollowedWorld(make_env(), address) as world:
        with join_world(world, ["car_0"], "first"):
            for wanted, match in (
                (["car_0"], "driven by 'first'"),
                (["car_9"], "no agent 'car_9'"),
                (["car_1", "car_1"], "twice"),
            ):
                outcome: list[str] = []

                def ask(wanted: list[str] = wanted, outcome: list[str] = outcome) -> None:
                    try:
                        Follower(address, wanted)
                    except FollowerError as error:
                        outcome.append(str(error))

                caller = threading.Thread(target=ask)
                caller.start()
                while caller.is_alive():
                    with pytest.raises(FollowerLostError, match="1 of 2"):
                        world.wait_for(2, 0.05)
                caller.join()
                assert match in outcome[0]


def test_answers_to_other_frames_are_dropped_or_refused(address: Path) -> None:
    with FollowedWorld(make_env(), address, timeout_s=1.0) as world:
        line = call(address, 10.0)
        line.say(Say.HELLO, Hello("x", ["car_0"]))
        world.wait_for(1, 10.0)
        for frame in (-1, 0):  # the answer to frame -1 is late: it is dropped and counted
            line.say(Say.CONTROL, Control(frame, {"car_0": [0.0, 0.0]}))
        world.reset(seed=0)
        (seat,) = world.seats
        assert (seat.answers, seat.late) == (1, 1)
        line.say(Say.CONTROL, Control(7, {"car_0": [0.0, 0.0]}))
        with pytest.raises(FollowerError, match="answers frame 7; the last is 1"):
            world.step()
        line.close()


def test_missing_followers_are_reported_after_the_timeout(address: Path) -> None:
    with (
        FollowedWorld(make_env(), address) as world,
        pytest.raises(FollowerLostError, match="0 of 1 followers"),
    ):
        world.wait_for(1, 0.05)


def test_a_follower_without_a_world_is_refused(address: Path) -> None:
    with pytest.raises(FollowerLostError, match="start it first"):
        Follower(address)
    with pytest.raises(ConfigError, match="at most 100 bytes"):
        Follower("x" * 200)


def test_a_followed_world_refuses_an_invalid_timeout_or_address(address: Path) -> None:
    with pytest.raises(ConfigError, match="timeout_s"):
        FollowedWorld(make_env(), address, timeout_s=0.0)
    address.write_text("somebody's file")
    with pytest.raises(ConfigError, match="cannot be opened"):
        FollowedWorld(make_env(), address)
    assert address.read_text() == "somebody's file"


def test_a_new_world_takes_over_the_socket_of_a_dead_world(address: Path) -> None:
    with FollowedWorld(make_env(), address) as world, pytest.raises(ConfigError, match="cannot"):
        FollowedWorld(make_env(), world.address)
    import socket

    dead = socket.socket(socket.AF_UNIX)
    dead.bind(str(address))
    dead.close()
    FollowedWorld(make_env(), address).close()


def lead_steps(address: Path, steps: int, ticks: list[int]) -> None:
    """Lead a world for `steps` steps, then leave; append each tick of the world to `ticks`."""
    with Follower(address, ["car_1"], "bridge", leads=True) as follower:
        for sight in follower:
            if len(ticks) == steps:
                follower.leave()
                return
            follower.answer(steer(sight))
            ticked = follower.tick()
            assert ticked.done
            ticks.append(ticked.tick)


def test_a_follower_that_leads_releases_each_step(address: Path, start: Start) -> None:
    ticks: list[int] = []
    with FollowedWorld(make_env(), address) as world:
        start(lambda: lead_steps(address, 5, ticks))
        world.wait_for(1, 10.0)
        assert world.leader is not None
        world.reset(seed=1)
        assert world.manifest()["followers"][0]["leads"]
        found = hashes(world, 5)
        assert found == reference(5, {"car_1": None})
        assert ticks == [1, 2, 3, 4, 5]
        assert (world.master.own_ticks, world.master.drifts) == (0, 0)
        world.step()  # the leader has left, so the world steps without it
        assert world.leader is None


def test_the_world_does_not_step_without_the_tick_of_its_leader(address: Path) -> None:
    env = make_env()
    with FollowedWorld(env, address, timeout_s=0.3) as world:
        world.reset(seed=1)
        before = env.state_hash()
        found: list[Follower] = []
        caller = threading.Thread(
            target=lambda: found.append(Follower(address, [], "bridge", waits=False, leads=True))
        )
        caller.start()
        world.wait_for(1, 10.0)
        caller.join()
        with (
            found[0],
            pytest.raises(FollowerLostError, match=r"'bridge' has not answered within 0\.3"),
        ):
            world.step()
        assert env.state_hash() == before
        assert hashes(world, 2) == reference(2, {})  # the world steps without a leader


def test_a_second_leader_is_refused(address: Path, start: Start) -> None:
    refused: list[str] = []

    def second() -> None:
        try:
            Follower(address, [], "second", leads=True)
        except FollowerError as error:
            refused.append(str(error))

    ticks: list[int] = []
    with FollowedWorld(make_env(), address) as world:
        start(lambda: lead_steps(address, 3, ticks))
        world.wait_for(1, 10.0)
        world.reset(seed=1)
        thread = start(second)
        while thread.is_alive():
            world.admit(0.1)
        hashes(world, 3)
    assert "'bridge' leads already; a world has one time master" in refused[0]
    assert ticks == [1, 2, 3]


def test_a_leader_that_ticks_twice_in_a_step_is_refused(address: Path) -> None:
    with FollowedWorld(make_env(), address) as world:
        world.reset(seed=1)
        line = call(address, 5.0)
        line.say(Say.HELLO, Hello("hasty", waits=False, leads=True))
        world.wait_for(1, 10.0)
        line.say(Say.TICK)
        line.say(Say.TICK)
        with pytest.raises(FollowerError, match="ticks twice"):
            world.step()
        line.close()
