"""Trips of agents with a time limit that depends on the trip."""

from __future__ import annotations

import numpy as np
import pytest

import cavmarl
from cavmarl.core.errors import ConfigError

STEPS = 320


def truncations_of_standing_agents(zones: int) -> tuple[list[tuple[int, int]], str]:
    """Let agents brake; return each truncation (step, agent), and the state at the end."""
    vec = cavmarl.make_vec(
        "merge",
        zones=zones,
        agents=8,
        background=4,
        overrides={"traffic.trip_horizon": 1.0, "population.mode": "respawn"},
    )
    actions = np.zeros((1, 8, 2), dtype=np.float32)
    actions[..., 0] = -1.0
    vec.reset(seed=1)
    cuts: list[tuple[int, int]] = []
    for step in range(STEPS):
        _, _, ended, cut, infos = vec.step(actions)
        assert not (ended & cut).any()
        for agent in np.flatnonzero(cut[0]).tolist():
            cuts.append((step, agent))
            assert infos["vehicle_done"][0, agent]
            assert infos["acted"][0, agent]
            assert np.abs(infos["final_observations"][0, agent]).sum() > 0.0
    return cuts, vec.state_hash()


def test_trips_that_take_too_long_are_truncated_equally_in_all_divisions() -> None:
    cuts, state = truncations_of_standing_agents(zones=1)
    assert cuts
    assert max(step for step, _ in cuts) < STEPS - 1  # earlier than the horizon of the episode
    assert truncations_of_standing_agents(zones=2) == (cuts, state)


def test_the_time_limit_is_a_multiple_of_the_free_time_plus_a_cycle_of_each_signal() -> None:
    vec = cavmarl.make_vec(
        "grid4x4", agents=6, background=0, overrides={"traffic.trip_horizon": 2.0}
    )
    vec.reset(seed=3)
    rows = vec.simulation.vehicles(0)
    roads, plans = vec.network.arrays, vec.simulation.shards[0].travel.steps
    lanes = roads.lanes
    for row in rows[rows["agent"] >= 0]:
        lane, free_s, signals_s = int(row["lane"]), 0.0, 0.0
        free_s -= float(row["s"] / lanes[lane]["speed_mps"])
        while lane >= 0:
            free_s += float(lanes[lane]["length_m"] / lanes[lane]["speed_mps"])
            if lanes[lane]["internal"]:
                lane = int(lanes[lane]["successor"])
                continue
            step = plans[int(row["way"]) + lane]
            while step["next"] < 0 and step["change"] != 0:
                lane = int(lanes[lane]["left" if step["change"] > 0 else "right"])
                step = plans[int(row["way"]) + lane]
            link, lane = int(step["link"]), int(step["next"])
            if link >= 0 and roads.links[link]["signal"] >= 0:
                program = roads.signals[roads.links[link]["signal"]]["program"]
                signals_s += float(roads.programs[program]["cycle_s"])
        due_s = (row["due"] - row["departed"]) * vec.config.clock.sim_dt_s
        assert due_s == pytest.approx(2.0 * free_s + signals_s, abs=0.2)


def test_a_trip_horizon_below_the_free_time_is_refused() -> None:
    with pytest.raises(ConfigError, match="at least 1: no vehicle"):
        cavmarl.make_vec("grid4x4", overrides={"traffic.trip_horizon": 0.5})
