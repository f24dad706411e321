"""The errors for impossible settings name the key, the value and the remedy."""

from __future__ import annotations

from typing import Any

import pytest

from cavmarl import parallel_env
from cavmarl.config.v2x import V2xConfig
from cavmarl.core.errors import ConfigError
from cavmarl.engine.spaces import flat_observation_space
from cavmarl.engine.world_setup import load_world


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"v2x.cam.rate_hz": 30.0}, r"v2x\.cam\.rate_hz = 30.*sim_dt_s = 0.05; try 20"),
        ({"v2x.denm.rate_hz": 7.0}, r"v2x\.denm\.rate_hz = 7.*try 6.66667"),
        ({"v2x.perception.rate_hz": 1e9}, r"v2x\.perception\.rate_hz"),
        ({"v2x.roadside.rate_hz": -1.0}, r"v2x\.roadside\.rate_hz = -1"),
        ({"v2x.equipped": 1.5}, r"v2x\.equipped = 1\.5"),
        ({"v2x.capacity": -1}, r"v2x\.capacity = -1"),
        ({"v2x.channel.range_m": -5.0}, r"v2x\.channel\.range_m = -5"),
        ({"v2x.channel.range_m": float("nan")}, r"v2x\.channel\.range_m"),
        ({"v2x.channel.loss": 1.1}, r"v2x\.channel\.loss = 1\.1"),
        ({"v2x.channel.latency_ticks": 65}, r"v2x\.channel\.latency_ticks = 65.*to 64"),
        ({"v2x.channel.latency_ticks": 0.5}, r"v2x\.channel\.latency_ticks = 0\.5"),
        ({"v2x.channel.path_loss_exponent": 0.5}, r"path_loss_exponent = 0\.5.*0 \(off\)"),
        ({"v2x.channel.building_db": 10.0}, r"building_db = 10\.0.*set path_loss_exponent"),
        ({"v2x.channel.packet_bytes": 0}, r"packet_bytes = 0"),
        ({"v2x.inbox.objects": 0}, r"v2x\.inbox\.objects = 0"),
        ({"v2x.inbox.memory_s": 0.0}, r"v2x\.inbox\.memory_s"),
        ({"v2x.roadside.signals": ["A0", "A0"]}, r"name each signal once"),
        ({"v2x.roadside.signals": ["all", "A0"]}, r"'all' must be the only name"),
        ({"v2x.roadside.signals": ["A9"]}, r"no signal 'A9' on the map '.*The map has: A0, A1"),
        ({"v2x.perception.objects": 33}, r"v2x\.perception\.objects = 33"),
        (
            {"sensors.messages.objects": 9},
            r"sensors\.messages\.objects = 9: .*at most v2x\.inbox\.objects",
        ),
        ({"sensors.messages.range_m": 0.0}, r"sensors\.messages\.range_m"),
        ({"v2x.cam.rate": 10.0}, r"v2x\.cam\.rate.*use rate_hz"),
        ({"observation.mode": "messages"}, r"observation\.mode.*set sensors\.messages\.objects"),
    ],
)
def test_invalid_arguments_are_refused(settings: dict[str, Any], words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        parallel_env("grid4x4", overrides={"v2x.enabled": True} | settings)


@pytest.mark.parametrize("name", ["objects", "events", "signal"])
def test_messages_that_no_station_sends_cannot_be_observed(name: str) -> None:
    value = True if name == "signal" else 1
    with pytest.raises(ConfigError, match=rf"sensors\.messages\.{name} = .*set v2x\.enabled"):
        load_world("grid4x4", overrides={f"sensors.messages.{name}": value})


def test_the_key_sensors_conflicts_heard_needs_messages() -> None:
    settings = {"sensors.conflicts.count": 4, "sensors.conflicts.heard": True}
    with pytest.raises(ConfigError, match=r"sensors\.conflicts\.heard = True: .*set v2x\.enabled"):
        load_world("grid4x4", overrides=settings)


def test_messages_and_channel_effects_are_off_by_default() -> None:
    default = V2xConfig()
    assert not default.enabled
    channel = default.channel
    assert (channel.range_m, channel.latency_ticks, channel.loss) == (0.0, 0, 0.0)
    assert (channel.path_loss_exponent, channel.building_db, channel.data_rate_mbps) == (0, 0, 0)


def test_in_the_mode_messages_other_vehicles_are_known_only_from_messages() -> None:
    overrides = {
        "v2x.enabled": True, "sensors.messages.objects": 3, "sensors.messages.events": 1,
        "sensors.messages.signal": True, "observation.mode": "messages", "observation.kind": "dict",
    }  # fmt: skip
    env = parallel_env("grid4x4", overrides=overrides)
    observations, _ = env.reset(seed=0)
    assert set(observations[env.agents[0]]) == {"ego", "route", "messages"}
    assert observations[env.agents[0]]["messages"].shape == (3 * 11 + 8 + 4,)
    assert flat_observation_space(env.config).shape == (13 + 16 + 45,)
