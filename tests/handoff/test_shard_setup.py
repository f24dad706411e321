"""The halo of zones is as wide as exactness needs; narrower halos are refused."""

from __future__ import annotations

import pytest

from cavmarl.config.registry import load_config
from cavmarl.core.errors import ConfigError
from cavmarl.driving.kernels.motion.motion import MAX_SPEED_MPS
from cavmarl.handoff.shard_setup import halo_m
from tests.support.driving import make_simulation

SETTINGS = {"clock.sim_dt_s": 0.1, "zones.count": 4, "zones.hysteresis_m": 3.0}


def test_the_halo_is_the_sum_of_reach_hysteresis_and_distance_of_late_ticks() -> None:
    config = load_config("grid4x4", overrides=SETTINGS | {"zones.max_deferred_ticks": 4})[0]
    for late_ticks in (0, 3):  # late_ticks is the deadline for messages between nodes
        needed_m = 100.0 + 3.0 + (late_ticks + 1) * MAX_SPEED_MPS * 0.1
        wide_m = halo_m(config, 100.0, 4, late_ticks=late_ticks)
        assert needed_m < wide_m < needed_m + 1e-5


def test_a_wider_halo_is_accepted_and_a_narrower_halo_is_refused() -> None:
    narrow = load_config("grid4x4", overrides=SETTINGS | {"zones.halo_m": 120.0})[0]
    with pytest.raises(
        ConfigError,
        match=r"120 m is too narrow; .* 121 m = reach 100 m \+ hysteresis 3 m \+ \(2 \+ 1\) ticks",
    ):
        halo_m(narrow, 100.0, 4, late_ticks=2)
    assert halo_m(narrow, 99.0, 4, late_ticks=2) == 120.0
    assert halo_m(narrow, 100.0, 1, late_ticks=2) == 120.0, "one shard has no border"


def test_a_world_whose_halo_is_too_narrow_for_exactness_is_refused() -> None:
    settings = {"mode": "closed", "overrides": SETTINGS | {"zones.halo_m": 50.0}}
    with pytest.raises(ConfigError, match="an overlap of 50 m is too narrow"):
        make_simulation("grid4x4", **settings)
    settings["overrides"] = SETTINGS | {"zones.halo_m": 5000.0}
    assert make_simulation("grid4x4", **settings).zones.loads().halo_m == 5000.0
