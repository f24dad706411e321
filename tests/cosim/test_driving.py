"""The reference stack drives as a policy, and as a follower in its own process."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest

import cavmarl
from cavmarl.cosim.stack.stack import REFERENCE_RIG
from cavmarl.policies.loading import load_policy

RIG: dict[str, Any] = {"clock.ctrl_dt_s": 0.05, "rig": REFERENCE_RIG}


def test_the_stack_drives_in_traffic_without_a_collision() -> None:
    env = cavmarl.parallel_env("grid4x4", agents=2, background=10, overrides=RIG)
    observations, _ = env.reset(seed=0)
    policy = load_policy("reference", env)
    policy.reset(0)
    driven = 0.0
    for _ in range(200):
        if not env.agents:
            break
        observations, _, _, _, infos = env.step(policy.act(observations))
        for info in infos.values():
            assert not info["collision"]
            assert not info["off_road"]
            assert not info["red_light"]
            driven += info["progress"]
    assert driven > 50.0


@pytest.mark.slow
def test_a_follower_process_drives_through_town_from_its_sensors_alone(tmp_path: Path) -> None:
    program = [sys.executable, "-m", "cavmarl"]
    place, led, followed = (str(tmp_path / name) for name in ("s", "led.json", "followed.json"))
    lead = [*program, "lead", "town", "--at", place, "--rig", "reference", "--agents", "1"]
    lead += ["--background", "20", "--seed", "1", "--timeout-s", "120", "--json", led]
    follow = [*program, "follow", "town", "--at", place, "--json", followed]
    with subprocess.Popen(lead) as master:
        try:
            until_s = time.monotonic() + 300.0
            while not Path(place).exists() and time.monotonic() < until_s:
                assert master.poll() is None
                time.sleep(0.1)
            assert subprocess.run(follow, timeout=900.0).returncode == 0
            assert master.wait(60.0) == 0
        finally:
            master.kill()
    told = json.loads(Path(led).read_text())
    assert told["traffic"]["contacts"] == 0
    assert told["traffic"]["arrived"] >= 1
    assert told["barrier"][0]["answers"] == told["steps"]
    stages = json.loads(Path(followed).read_text())["stages"]
    assert set(stages) == {"perception", "localisation", "signals", "planning", "control"}
