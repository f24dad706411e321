"""Signal controllers: their rules, the counts that they use, and equality of divided worlds."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from contextlib import closing
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cavmarl import CavVectorEnv, ConfigError, make_vec
from cavmarl.evaluate.signals.signal_runs import run_controller
from cavmarl.signals.controllers import SignalView, make_controller
from cavmarl.signals.kernels.green_choices import GREEN, SINCE
from cavmarl.signals.kernels.lane_counts import NEAR_LINE, VEHICLES
from cavmarl.signals.kernels.lane_history import (
    DETECTED_MS,
    FLOW,
    NOT_MEASURED,
    PASSED,
    RED_TICKS,
    RED_VEHICLE_TICKS,
)

TICKS = {"clock.sim_dt_s": 0.2, "clock.ctrl_dt_s": 1.0}
ALL = {"signals.agents": "all", **TICKS}
CONTROLLERS: dict[str, dict[str, Any]] = {
    "webster": {"signals.flow_interval_s": 10.0},
    "actuated": {"signals.decide_s": 1.0},
    "sotl": {"signals.decide_s": 1.0, "signals.sotl_vehicle_s": 10.0},
    "max_pressure": {"signals.longest_red_s": 10.0},
}


# Rules; the test sets the counts


def view_of(vec: CavVectorEnv) -> SignalView:
    """Return a view of the signals at 100 s, when the first green has lasted for 20 s."""
    vec.reset(seed=0)
    given = vec.signals.view
    states, history = np.zeros_like(given.states), np.zeros_like(given.history)
    states[..., SINCE] = 500 - 110  # 22 s ago: 2 s of yellow, 20 s of green
    history[..., FLOW] = NOT_MEASURED
    return given._replace(
        ticks=given.ticks + 500,
        states=states,
        counts=np.zeros_like(given.counts),
        history=history,
        masks=np.ones_like(given.masks),
        decides=np.ones_like(given.decides),
    )


@pytest.fixture
def view() -> Iterator[SignalView]:
    with closing(make_vec("grid4x4", num_envs=1, agents=0, background=0, overrides=ALL)) as vec:
        yield view_of(vec)


def lanes_of(view: SignalView, green: int) -> list[int]:
    """Return the lanes that only this green of the signal A0 opens."""
    moves, opened = view.table.movements[0], view.table.opened[0]
    other = set(moves[opened[1 - green], 0].tolist())
    return sorted(set(moves[opened[green], 0].tolist()) - other)


def with_green_s(view: SignalView, green_s: float) -> SignalView:
    """Return a copy of the view in which the present green has lasted for `green_s`."""
    states = view.states.copy()
    states[..., SINCE] = 500 - round((2.0 + green_s) / view.dt)
    return view._replace(states=states)


def choice(name: str, view: SignalView, s: int = 0, **keys: Any) -> int:
    config = view.config.__class__(agents="all", **keys)
    return int(make_controller(name).choose(view._replace(config=config))[0, s])


def test_webster_divides_the_cycle_by_critical_flows(view: SignalView) -> None:
    # At most 150 vehicles leave a lane in 300 s, so the flow ratios are 0.4 and 0.2; 8 s are lost.
    # C = (1.5 · 8 + 5) / (1 - 0.6) = 42.5 s; greens of 34.5 · 2/3 + 2 = 25 s, and 13.5 s.
    view.history[0, :, FLOW] = 0
    view.history[0, lanes_of(view, 0)[0], FLOW] = 60
    view.history[0, lanes_of(view, 0)[-1], FLOW] = 20
    view.history[0, lanes_of(view, 1)[0], FLOW] = 30
    assert choice("webster", with_green_s(view, 24.4), decide_s=1.0) == 0
    assert choice("webster", with_green_s(view, 24.6), decide_s=1.0) == 1
    view.states[..., GREEN] = 1
    assert choice("webster", with_green_s(view, 12.8), decide_s=1.0) == 1
    assert choice("webster", with_green_s(view, 13.2), decide_s=1.0) == 0
    # With half of the saturation flow, the sum of flow ratios is 1.2, so the cycle is 120 s.
    late = with_green_s(view, (120.0 - 8.0) / 3.0 + 2.0 - 0.6)
    assert choice("webster", late, decide_s=1.0, saturation_per_h=900.0) == 1
    late = with_green_s(view, (120.0 - 8.0) / 3.0 + 2.0 - 0.4)
    assert choice("webster", late, decide_s=1.0, saturation_per_h=900.0) == 0


def test_webster_divides_the_flow_of_a_lane_among_its_greens() -> None:
    with closing(make_vec("town", num_envs=1, agents=0, background=0, overrides=ALL)) as vec:
        view = view_of(vec)
        table = view.table
        s, lane, openers = next(
            (s, lane, openers.tolist())
            for s, (moves, opened) in enumerate(zip(table.movements, table.opened, strict=True))
            for lane in moves[:, 0].tolist()
            if len(openers := np.flatnonzero(opened[:, moves[:, 0] == lane].any(axis=1))) == 2
        )
        view.history[0, :, FLOW] = 0
        view.history[0, lane, FLOW] = 60  # flow ratio 0.4, 0.2 for each green
        lost_s = 4.0 * len(table.greens[s])
        cycle_s = max(30.0, (1.5 * lost_s + 5.0) / 0.6)
        green_s = (cycle_s - lost_s) / 2.0 + 2.0
        for green in openers:
            view.states[0, s, GREEN] = green
            assert choice("webster", with_green_s(view, green_s - 0.7), s, decide_s=1.0) == green
            assert choice("webster", with_green_s(view, green_s - 0.3), s, decide_s=1.0) != green


def test_webster_follows_the_program_before_a_flow_is_known(view: SignalView) -> None:
    due_s = float(view.table.green_s[0, 0])
    assert choice("webster", with_green_s(view, due_s - 1.0), decide_s=1.0) == 0
    assert choice("webster", with_green_s(view, due_s), decide_s=1.0) == 1


def test_the_controller_actuated_ends_a_green_at_a_gap(view: SignalView) -> None:
    at = view.table.prolonging.first
    (lane, *_) = view.table.prolonging.lanes[at[0] : at[1]]
    assert lane in lanes_of(view, 0)
    view.history[0, lane, DETECTED_MS] = 97_100
    assert choice("actuated", view) == 0
    view.history[0, lane, DETECTED_MS] = 97_000
    assert choice("actuated", view) == 1
    assert choice("actuated", view, max_gap_s=3.1) == 0
    view.history[0, lanes_of(view, 1)[0], DETECTED_MS] = 100_000  # this lane has red
    assert choice("actuated", view) == 1


def test_sotl_changes_on_demand_but_does_not_interrupt_small_platoons(view: SignalView) -> None:
    red, green = lanes_of(view, 1), lanes_of(view, 0)
    view.history[0, red[0], RED_VEHICLE_TICKS] = 150
    view.history[0, red[1], RED_VEHICLE_TICKS] = 49
    assert choice("sotl", view) == 0  # 199 · 0.2 s < 40 s
    view.history[0, red[1], RED_VEHICLE_TICKS] = 50
    assert choice("sotl", view) == 1
    view.counts[0, green[0], NEAR_LINE] = 1
    view.counts[0, green[1], NEAR_LINE] = 2
    assert choice("sotl", view) == 0
    assert choice("sotl", view, platoon=2) == 1
    view.counts[0, green[1], NEAR_LINE] = 3  # more than `platoon` vehicles
    assert choice("sotl", view) == 1


@pytest.mark.parametrize("name", ["longest_queue", "max_pressure"])
def test_a_lane_at_its_longest_red_takes_precedence_over_queues(
    name: str, view: SignalView
) -> None:
    view.counts[0, lanes_of(view, 0), VEHICLES] = 9
    view.history[0, lanes_of(view, 1)[0], RED_TICKS] = 300
    assert choice(name, view) == 0
    assert choice(name, view, longest_red_s=60.2) == 0
    assert choice(name, view, longest_red_s=60.0) == 1
    view.masks[0, 0] = [True, False]
    assert choice(name, view, longest_red_s=60.0) == 0


@pytest.mark.parametrize("name", CONTROLLERS)
def test_controllers_can_choose_the_action_next(name: str, view: SignalView) -> None:
    view.history[0, :, FLOW] = 0  # cycle of 30 s with equal greens
    view.history[0, lanes_of(view, 1), RED_VEHICLE_TICKS] = 1000
    view.counts[0, lanes_of(view, 1), VEHICLES] = 1
    assert choice(name, view, action="keep_or_next") == 1
    view.masks[0, 0] = [True, False]
    assert choice(name, view, action="keep_or_next") == 0


# Counts of lanes


def test_detectors_count_vehicles_and_store_the_last_time() -> None:
    keys = ALL | {"clock.ctrl_dt_s": 0.2, "signals.decide_s": 1.0, "signals.flow_interval_s": 20.0}
    vec = make_vec("grid4x4", num_envs=1, agents=0, background=150, overrides=keys)
    with closing(vec):
        vec.reset(seed=2)
        table, network = vec.signals.table, vec.network
        lanes = np.flatnonzero(table.arrays.detector >= 0)
        places = network.detectors[table.arrays.detector[lanes]]
        assert (places["lane"] == table.arrays.lane_row[lanes]).all()
        # 2 s before the line at the speed limit, at most the length of a queue that leaves in 5 s
        speed = table.arrays.speed_mps[lanes]
        away_m = np.minimum(2.0 * speed, (5.0 / 1.9 + 0.5) * 7.5)
        np.testing.assert_allclose(places["s_m"], table.arrays.length_m[lanes] - away_m)
        over: list[set[int]] = [set() for _ in lanes]
        counted, last = np.zeros(len(lanes), int), np.zeros(len(lanes), int)
        for tick in range(1, 300):
            vec.step({"signals": np.zeros((1, len(table.ids)), int)})
            rows = vec.simulation.vehicles(0)
            for k, place in enumerate(places):
                on = rows[rows["lane"] == place["lane"]]
                is_over = np.abs(on["s"] - place["s_m"]) <= 0.5 * on["length"]
                now = set(on["id"][is_over].tolist())
                # A loop has to be free for a tick before it counts the next vehicle.
                counted[k] += bool(now) and not over[k] and tick > 1
                last[k] = 200 * tick if now else last[k]
                over[k] = now
            history = vec.signals.view.history[0, lanes]
            if tick % 100 == 0:
                assert (history[:, FLOW] == counted).all()
                assert counted.sum() > 20
                counted[:] = 0
            assert (history[:, PASSED] == counted).all()
            since_ms = history[:, DETECTED_MS] - last  # a vehicle may leave between ticks
            assert ((since_ms >= 0) & (since_ms <= 200)).all()


def test_vehicles_near_the_line_are_counted() -> None:
    keys = ALL | {"signals.platoon_m": 30.0, "signals.decide_s": 1.0}
    vec = make_vec("grid4x4", num_envs=1, agents=0, background=150, overrides=keys)
    with closing(vec):
        vec.reset(seed=2)
        table, total = vec.signals.table, 0
        for _ in range(20):
            vec.step({"signals": np.zeros((1, len(table.ids)), int)})
            rows = vec.simulation.vehicles(0)
            n = table.arrays.lane_index[rows["lane"]]
            rows, n = rows[n >= 0], n[n >= 0]
            left_m = table.arrays.length_m[n] - rows["s"] - 0.5 * rows["length"]
            expected = np.bincount(n[left_m <= 30.0], minlength=len(table.lanes))
            assert (vec.signals.view.counts[0, :, NEAR_LINE] == expected).all()
            total += expected.sum()
        assert total > 100


def test_the_counts_of_a_red_lane_are_cleared_by_its_green() -> None:
    keys = ALL | {"signals.min_green_s": 30.0, "signals.max_green_s": 30.0}
    vec = make_vec("grid4x4", num_envs=1, agents=0, background=150, overrides=keys)
    with closing(vec):
        vec.reset(seed=2)
        table, view = vec.signals.table, vec.signals.view
        red, vehicle_ticks = np.zeros((2, len(table.lanes)), int)
        longest = 0
        for step in range(60):
            vec.step({"signals": np.zeros((1, len(table.ids)), int)})
            if step % 5 != 4:
                continue
            for s in range(len(table.ids)):
                moves, opened = table.movements[s], table.opened[s][view.states[0, s, GREEN]]
                for lane in set(moves[:, 0].tolist()):
                    vehicles, standing = view.counts[0, lane, :2]
                    red[lane] = red[lane] + 25 if standing else 0
                    vehicle_ticks[lane] += 25 * vehicles
                    if lane in moves[opened, 0]:
                        red[lane] = vehicle_ticks[lane] = 0
            assert (view.history[0, :, RED_TICKS] == red).all()
            assert (view.history[0, :, RED_VEHICLE_TICKS] == vehicle_ticks).all()
            longest = max(longest, red.max())
        assert 125 <= longest <= 200


def test_a_side_road_does_not_starve(tmp_path: Path) -> None:
    """One vehicle waits at the side road while 15 vehicles a minute drive on the main road."""
    demand = tmp_path / "main.rou.xml"
    demand.write_text(
        '<routes><vType id="car" sigma="0" speedDev="0"/>'
        '<route id="along" edges="left0A0 A0B0 B0C0"/><route id="side" edges="bottom0A0 A0A1"/>'
        '<flow id="a" type="car" route="along" begin="0" end="400" period="4"/>'
        '<flow id="b" type="car" route="side" begin="30" end="40" number="1"/></routes>'
    )
    keys = {"traffic.demand": [str(demand)], "population.background": 0, "signals.agents": ["A0"]}
    keys |= {"signals.max_green_s": 0.0}

    def longest_red(**more: Any) -> float | None:
        found = run_controller(
            "grid4x4", "max_pressure", seconds=400, seeds=[1], overrides=keys | more
        )
        return found[0].longest_red_s

    assert longest_red() > 300
    assert 35 <= longest_red(**{"signals.longest_red_s": 40.0}) <= 50


# Zones, workers, nodes and saved states


def drive(name: str, kill_at: tuple[int, ...] = (), num_envs: int = 1, **more: Any) -> list[str]:
    """Run worlds; return the hashes of their states, and the greens of all signals."""
    keys = ALL | CONTROLLERS[name] | {"horizon_s": 35.0, "signals.controller": name}
    vec = make_vec("grid4x4", num_envs=num_envs, agents=4, background=80, overrides=keys, **more)
    with closing(vec):
        vec.reset(seed=1)
        greens = []
        for step in range(50):
            if step in kill_at:
                os.kill(vec.worlds.worker_pids[1], signal.SIGKILL)
            vec.step(vec.suggest_actions())
            greens.append(vec.signals.view.states[..., GREEN].tolist())
        assert any(one != other for one, other in pairwise(greens))
        return [*(vec.state_hash(w) for w in range(num_envs)), str(greens)]


@pytest.fixture(scope="module", params=CONTROLLERS)
def undivided(request: pytest.FixtureRequest) -> tuple[str, list[str]]:
    return request.param, drive(request.param)


@pytest.mark.parametrize("zones", [2, 4])
def test_a_divided_world_equals_the_undivided_one(
    zones: int, undivided: tuple[str, list[str]]
) -> None:
    name, expected = undivided
    assert drive(name, zones=zones) == expected


@pytest.mark.integration
def test_results_on_workers_equal_the_undivided_ones_when_a_worker_is_killed(
    undivided: tuple[str, list[str]],
) -> None:
    name, expected = undivided
    assert drive(name, zones=4, workers=2, kill_at=(23,)) == expected


@pytest.mark.integration
def test_results_over_nodes_equal_the_undivided_ones(undivided: tuple[str, list[str]]) -> None:
    name, expected = undivided
    assert drive(name, zones=3, nodes=2, kill_at=(24,)) == expected


@pytest.mark.parametrize("name", CONTROLLERS)
def test_a_saved_state_continues_with_other_zones(name: str) -> None:
    keys = ALL | CONTROLLERS[name] | {"signals.controller": name}

    def make(zones: int) -> CavVectorEnv:
        return make_vec("grid4x4", num_envs=2, agents=2, background=80, zones=zones, overrides=keys)

    def steps(vec: CavVectorEnv, count: int) -> list[Any]:
        found = []
        for _ in range(count):
            vec.step(vec.suggest_actions())
            found.append((vec.signals.view.states.tolist(), vec.signals.view.history.tolist()))
        return found

    with closing(make(1)) as first, closing(make(4)) as second:
        first.reset(seed=4)
        steps(first, 18)
        saved = first.save_state()
        second.reset(seed=0)
        second.load_state(saved)
        assert steps(first, 24) == steps(second, 24)
        assert first.state_hash(1) == second.state_hash(1)


# Settings


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        (
            {"signals.controller": "webster", "signals.longest_red_s": 60.0},
            r"longest_red_s = 60.*: has no effect on signals.controller = webster, only on l",
        ),
        ({"signals.flow_interval_s": 10.1}, r"whole number of ticks of clock.sim_dt_s = 0.2"),
        ({"signals.saturation_per_h": 0.0}, r"signals.saturation_per_h = 0.*from 100"),
        ({"signals.platoon": -1}, r"signals.platoon = -1"),
    ],
)
def test_invalid_settings_are_refused_with_the_reason(keys: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        make_vec("grid4x4", agents=1, background=5, overrides=ALL | keys)
