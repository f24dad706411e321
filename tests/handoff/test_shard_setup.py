"""How far zones see: as far as exactness needs, or the settings are refused with the numbers."""

from __future__ import annotations

from typing import Any

import pytest

from cavmarl.config.registry import load_config
from cavmarl.core.errors import ConfigError
from cavmarl.driving.kernels.motion import MAX_SPEED_MPS
from cavmarl.handoff.shard_setup import halo_m
from tests.support.driving import drive, make_simulation, start

SETTINGS = {"clock.sim_dt_s": 0.1, "zones.count": 4, "zones.hysteresis_m": 3.0}
LOSSY = SETTINGS | {"zones.faults": "{}"}


def test_the_halo_is_reach_hysteresis_and_the_way_of_late_ticks() -> None:
    for settings, ticks in ((LOSSY, 5), (SETTINGS, 1)):  # nobody is late where nothing is lost
        config = load_config("grid4x4", overrides=settings | {"zones.max_deferred_ticks": 4})[0]
        needed_m = 100.0 + 3.0 + ticks * MAX_SPEED_MPS * 0.1
        assert needed_m < halo_m(config, 100.0, 4) < needed_m + 1e-5


def test_a_wider_halo_is_taken_and_a_narrower_one_refused_with_the_numbers() -> None:
    narrow = load_config("grid4x4", overrides=LOSSY | {"zones.halo_m": 120.0})[0]
    with pytest.raises(
        ConfigError,
        match=r"120 m is too narrow: 121 m = reach 100 m \+ hysteresis 3 m \+ \(2 \+ 1\) ticks",
    ):
        halo_m(narrow, 100.0, 4)
    assert halo_m(narrow, 99.0, 4) == 120.0
    assert halo_m(narrow, 100.0, 1) == 120.0, "nobody looks over a border"


def test_a_world_is_not_made_that_could_not_be_exact() -> None:
    settings = {"mode": "closed", "overrides": SETTINGS | {"zones.halo_m": 50.0}}
    with pytest.raises(ConfigError, match="an overlap of 50 m is too narrow"):
        make_simulation("grid4x4", **settings)
    settings["overrides"] = SETTINGS | {"zones.halo_m": 5000.0}
    assert make_simulation("grid4x4", **settings).zone_loads().halo_m == 5000.0


def deferred(ticks: int) -> dict[str, Any]:
    return {"zones.max_deferred_ticks": ticks}


def test_who_may_stay_longer_is_seen_from_farther_away() -> None:
    config = load_config("grid4x4", overrides=LOSSY)[0]
    patient = load_config("grid4x4", overrides=LOSSY | deferred(7))[0]
    more_m = halo_m(patient, 100.0, 4) - halo_m(config, 100.0, 4)
    assert more_m == pytest.approx(5 * MAX_SPEED_MPS * 0.1)


def test_after_the_deadline_the_change_is_forced() -> None:
    lost = '{"messages": {"Prepare": {"drop": 1.0}}}'
    waited: set[int] = set()
    for ticks in (2, 5):
        simulation = make_simulation(
            "grid4x4",
            mode="respawn",
            agents=4,
            background=60,
            overrides=SETTINGS | deferred(ticks) | {"zones.faults": lost},
        )
        start(simulation, seed=1)
        for _ in range(40):
            drive(simulation)
        (transfers,) = simulation.transfers
        assert transfers.rows
        assert all(row.forced for row in transfers.rows)
        waited |= {row.waited for row in transfers.rows}
    assert waited == {2, 5}
