"""Worlds with followers in this process and in other processes."""

from __future__ import annotations

import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import cavmarl
from cavmarl.cosim.followers.followed_world import FollowedWorld
from cavmarl.cosim.followers.follower_client import Follower, FollowerView

SETTINGS = {"population.mode": "respawn", "clock.ctrl_dt_s": 0.05, "horizon_s": 60}


def make_env(agents: int = 3, zones: int = 1, workers: int = 0, **more: Any) -> cavmarl.CavEnv:
    return cavmarl.parallel_env(
        "ring", agents=agents, background=3, zones=zones, workers=workers, overrides=SETTINGS | more
    )


@pytest.fixture
def address(tmp_path: Path) -> Path:
    return tmp_path / "s"


def steer(sight: FollowerView) -> dict[str, Any]:
    """Return controls that depend only on the view of the follower."""
    return {
        vehicle: np.tanh(sight.sensors[vehicle]["observation"].values[0, :2]).tolist()
        for vehicle in sight.snapshot.vehicles
    }


@pytest.fixture
def start() -> Iterator[Callable[..., threading.Thread]]:
    """Return a function that runs a follower in a thread; join all threads after the test."""
    threads: list[threading.Thread] = []

    def run(action: Callable[[], None]) -> threading.Thread:
        thread = threading.Thread(target=action, daemon=True)
        thread.start()
        threads.append(thread)
        return thread

    yield run
    for thread in threads:
        thread.join(10.0)
        assert not thread.is_alive()


def drive(address: Any, vehicles: list[str], name: str = "driver") -> list[FollowerView]:
    """Follow a world to its end; return all views."""
    seen = []
    with Follower(address, vehicles, name) as follower:
        for sight in follower:
            seen.append(sight)
            if not sight.snapshot.is_over:
                follower.answer(steer(sight))
    return seen


def join_world(
    world: FollowedWorld, vehicles: list[str], name: str = "driver", secret: str = ""
) -> Follower:
    """Return a follower in this process that has joined the world."""
    found: list[Follower] = []
    caller = threading.Thread(
        target=lambda: found.append(Follower(world.address, vehicles, name, 10.0, secret))
    )
    caller.start()
    world.wait_for(len(world.seats) + 1, 10.0)
    caller.join()
    return found[0]


def spawn(code: str, *words: Any) -> subprocess.Popen[str]:
    """Start a follower in its own process."""
    return subprocess.Popen(
        [sys.executable, "-c", code, *map(str, words)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def hashes(world: FollowedWorld, steps: int) -> list[str]:
    found = []
    for _ in range(steps):
        world.step()
        found.append(world.env.state_hash())
    return found
