"""Received messages do not depend on zones, although messages reach beyond the halo."""

from __future__ import annotations

from typing import Any

import pytest

from cavmarl import make_vec
from cavmarl.verify.equivalence import verify_zones

FAST = {"clock.sim_dt_s": 0.1, "clock.ctrl_dt_s": 0.2}
OBSERVED = {
    "v2x.enabled": True, "sensors.messages.objects": 6, "sensors.messages.events": 2,
    "sensors.messages.signal": True, "sensors.messages.timing": True, "sensors.conflicts.count": 4,
    "sensors.conflicts.heard": True,
}  # fmt: skip
LOSSY = {
    "v2x.equipped": 0.7,
    "v2x.cam.triggered": True,
    "v2x.perception.rate_hz": 5.0,
    "v2x.roadside.signals": ["all"],
    "v2x.roadside.perception_hz": 5.0,
    "v2x.denm.hard_braking_mps2": 1.0,
    "v2x.channel.range_m": 250.0,
    "v2x.channel.path_loss_exponent": 2.75,
    "v2x.channel.latency_ticks": 2,
    "v2x.channel.loss": 0.1,
    "v2x.channel.data_rate_mbps": 0.3,
}


@pytest.mark.parametrize("channel", [{}, LOSSY], ids=["ideal", "lossy"])
@pytest.mark.parametrize("stack", [1, 3])
def test_received_messages_do_not_depend_on_zones(channel: dict[str, Any], stack: int) -> None:
    settings = FAST | OBSERVED | channel | {"sensors.stack": stack, "population.background": 60}
    found = verify_zones("grid4x4", (2, 4, 9), steps=30, overrides=settings)
    for result in found.results:
        assert result.difference is None, result
    assert sum(result.crossings for result in found.results) >= 10


def all_messages(zones: int) -> list[bytes]:
    """Run worlds; return the bytes of all inboxes, counts and observations after each step."""
    overrides = FAST | OBSERVED | LOSSY | {"population.mode": "respawn"}
    env = make_vec("grid4x4", num_envs=2, zones=zones, overrides=overrides)
    said = []
    observations, _ = env.reset(seed=4)
    for _ in range(20):
        said.append(observations.tobytes())
        said += [array.tobytes() for array in env.simulation.messages.mail]
        said.append(env.state_hash(1).encode())
        observations, *_ = env.step(env.suggest_actions())
    return said


def test_inboxes_do_not_depend_on_zones() -> None:
    whole = all_messages(1)
    for zones in (2, 4, 9):
        assert all_messages(zones) == whole


def test_worlds_in_workers_receive_the_same_messages() -> None:
    overrides = FAST | OBSERVED | LOSSY | {"population.mode": "respawn"}

    def seen(**split: int) -> list[bytes]:
        env = make_vec("grid4x4", num_envs=1, overrides=overrides, **split)
        observations, _ = env.reset(seed=4)
        found = []
        for _ in range(8):
            found += [observations.tobytes(), env.state_hash(0).encode()]
            observations, *_ = env.step(env.suggest_actions())
        found.append(repr(sorted(env.traffic_stats().items())).encode())
        env.close()
        return found

    assert seen(zones=2, workers=2) == seen()
