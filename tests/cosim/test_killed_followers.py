"""Follower processes are killed at random ticks: the world stays intact and continues."""

from __future__ import annotations

import random
import signal
from pathlib import Path

import pytest

from cavmarl.core.errors import FollowerLostError
from cavmarl.cosim.followers.followed_world import FollowedWorld
from tests.cosim.conftest import make_env, spawn
from tests.cosim.test_followed_world import reference

DRIVER = """
import sys
from pathlib import Path
from tests.cosim.conftest import drive
drive(Path(sys.argv[1]), [sys.argv[2]])
"""
STEPS = 12


def test_followers_are_killed_at_random_ticks(address: Path) -> None:
    ticks = random.Random(5)
    with FollowedWorld(make_env(), address) as world:
        for _ in range(3):
            with spawn(DRIVER, address, "car_0") as process:
                try:
                    world.wait_for(1, 60.0)
                    world.reset(seed=1)
                    found, lost = [], 0
                    death = ticks.randrange(STEPS)
                    for step in range(STEPS):
                        if step == death:
                            process.send_signal(signal.SIGKILL)
                            process.wait()
                        try:
                            world.step()
                        except FollowerLostError:
                            lost += 1
                        found.append(world.env.state_hash())
                finally:
                    process.kill()
            assert lost == 1
            assert world.seats == ()
            assert [world.master.world_ticks[0], world.master.drifts] == [STEPS, 0]
            # The step in which the follower dies still uses its last controls.
            driven = reference(STEPS, {"car_0": None})
            assert found[: death + 1] == driven[: death + 1]
            assert found[death + 1 :] != driven[death + 1 :] or death == STEPS - 1


def test_stopped_followers_are_replaced(address: Path) -> None:
    with FollowedWorld(make_env(), address, timeout_s=0.3) as world:
        with spawn(DRIVER, address, "car_0") as first, spawn(DRIVER, address, "car_1") as other:
            try:
                world.wait_for(2, 60.0)
                world.reset(seed=1)
                world.step()
                first.send_signal(signal.SIGSTOP)
                with pytest.raises(FollowerLostError, match="driver"):
                    world.step()
                assert [seat.agents for seat in world.seats] == [(1,)]
                first.kill()
                with spawn(DRIVER, address, "car_0") as second:
                    world.wait_for(2, 60.0)
                    found = []
                    for _ in range(3):
                        world.step()
                        found.append(world.env.state_hash())
                    world.close()
                    assert second.wait(30.0) == 0
                assert other.wait(30.0) == 0
            finally:
                first.kill()
                other.kill()
    # The second follower drives from its first frame on.
    assert found == reference(5, {"car_0": None, "car_1": None})[2:]
