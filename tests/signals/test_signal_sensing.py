"""Vehicle data that signal agents and controllers get, for each value of `signals.sensing`."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import closing
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from cavmarl import CavVectorEnv, ConfigError, make_vec
from cavmarl.engine.world_description import describe_world
from cavmarl.signals.kernels.lane_counts import (
    LENGTH_MM,
    NEAR_LINE,
    SPEED_PPM,
    STANDING,
    STOOD_TICKS,
    VEHICLES,
)
from cavmarl.signals.kernels.loop_counts import COUNT, COVERED_TICKS, EXIT, FREE_TICKS

TICK_S = 0.2
KEYS: dict[str, Any] = {
    "signals.agents": "all",
    "signals.decide_s": 1.0,
    "clock.sim_dt_s": TICK_S,
    "clock.ctrl_dt_s": TICK_S,
}
V2X: dict[str, Any] = {
    "signals.sensing": "v2x",
    "v2x.enabled": True,
    "v2x.cam.rate_hz": 5.0,
    "v2x.denm.rate_hz": 0.0,
    "v2x.roadside.signals": ["all"],
    "v2x.roadside.rate_hz": 5.0,
    "v2x.inbox.objects": 64,
}


def make(background: int = 150, num_envs: int = 1, **keys: Any) -> CavVectorEnv:
    overrides = KEYS | {f"signals.{name}": value for name, value in keys.items()}
    return make_messages(overrides, background, num_envs)


def make_messages(
    overrides: dict[str, Any], background: int = 150, num_envs: int = 1
) -> CavVectorEnv:
    return make_vec(
        "grid4x4", num_envs=num_envs, agents=0, background=background, overrides=KEYS | overrides
    )


def ticks(vec: CavVectorEnv, seconds: float, seed: int = 3) -> Iterator[int]:
    """Run a world whose signals change as early as allowed; yield the number of each tick."""
    vec.reset(seed=seed)
    yield 0
    for tick in range(round(seconds / TICK_S)):
        view = vec.signals.view
        vec.step({"signals": np.where(view.masks[..., 1], 1, 0)})
        yield tick + 1


def watched(vec: CavVectorEnv) -> tuple[NDArray[np.void], NDArray[np.int64]]:
    """Return the vehicles on lanes of signals, and the index of each vehicle's lane."""
    rows = vec.simulation.vehicles(0)
    lanes = vec.signals.table.arrays.lane_index[rows["lane"]].astype(np.int64)
    return rows[lanes >= 0], lanes[lanes >= 0]


def distances_m(vec: CavVectorEnv, rows: NDArray[np.void]) -> NDArray[np.float64]:
    """Return the distance of each vehicle to the signal that observes its lane."""
    table = vec.signals.table
    before = {lane for row in table.arrays.incoming.tolist() for lane in row}
    found = []
    for row in rows:
        n = table.arrays.lane_index[row["lane"]]
        lane = vec.network.lanes[row["lane"]]
        line = lane["length_m"] - lane["stop_back_m"]
        found.append(abs(line - row["s"]) if n in before else row["s"])
    return np.array(found)


def near_line(vec: CavVectorEnv, rows: NDArray[np.void]) -> NDArray[np.bool_]:
    """Return whether each vehicle's front is within `signals.platoon_m` of its lane's end."""
    to_end = vec.network.lanes["length_m"][rows["lane"]] - rows["s"] - 0.5 * rows["length"]
    near: NDArray[np.bool_] = to_end <= vec.config.signals.platoon_m
    return near


def sums(rows: NDArray[np.void], lanes: NDArray[np.int64], num: int) -> NDArray[np.int64]:
    """Return for each lane the numbers of vehicles and of stopped vehicles."""
    standing = lanes[np.abs(rows["speed"]) < 0.1]
    return np.stack([np.bincount(each, minlength=num) for each in (lanes, standing)], axis=1)


# Cameras


def test_a_camera_counts_the_vehicles_within_its_range() -> None:
    # Seen from 100 m above the ground, no vehicle hides another.
    with closing(make(sensing="camera", camera_range_m=60.0, camera_height_m=100.0)) as vec:
        beyond = 0
        for tick in ticks(vec, 40.0):
            if tick % 5:
                continue
            rows, lanes = watched(vec)
            is_near = distances_m(vec, rows) <= 60.0
            beyond += np.count_nonzero(~is_near)
            counts = vec.signals.view.counts[0]
            expected = sums(rows[is_near], lanes[is_near], len(counts))
            np.testing.assert_array_equal(counts[:, [VEHICLES, STANDING]], expected)
            near = lanes[is_near & near_line(vec, rows)]
            np.testing.assert_array_equal(
                counts[:, NEAR_LINE], np.bincount(near, minlength=len(counts))
            )
        assert beyond > 500


def is_in_sight(
    camera: NDArray[np.float64], row: np.void, others: NDArray[np.void]
) -> NDArray[np.bool_]:
    """Return whether no other vehicle hides the middle of a vehicle from a camera."""
    target = np.array([row["x"], row["y"], row["z"] + 0.5 * row["height"]])
    far = np.sqrt(((target - camera)[:2] ** 2).sum())
    along, across = (target - camera)[:2] / far, np.array([-1.0, 1.0]) * (target - camera)[1::-1]
    for other in others:
        if other["id"] == row["id"]:
            continue
        cos, sin = np.cos(other["heading"]), np.sin(other["heading"])
        half = 0.5 * np.array([[a, b] for a in (-1, 1) for b in (-1, 1)])
        half *= [other["length"], other["width"]]
        corners = half @ [[cos, sin], [-sin, cos]] + [other["x"], other["y"]] - camera[:2]
        middle = (np.array([other["x"], other["y"]]) - camera[:2]) @ along
        sides = corners @ across
        if not (0.0 < middle < far and sides.min() < 0.0 < sides.max()):
            continue
        leaves = min((corners @ along).max(), far)
        height = camera[2] + (target[2] - camera[2]) * leaves / far
        if height < other["z"] + other["height"]:
            return np.False_
    return np.True_


def test_vehicles_hide_others_from_a_camera() -> None:
    keys = {"sensing": "camera", "camera_range_m": 150.0, "camera_height_m": 5.0}
    overrides = KEYS | {f"signals.{name}": value for name, value in keys.items()}
    overrides["population.types"] = ["car", "bus"]
    with closing(make_messages(overrides, background=250)) as vec:
        table, network = vec.signals.table, vec.network
        hidden = 0
        for tick in ticks(vec, 20.0):
            if tick % 25:
                continue
            rows, lanes = watched(vec)
            rows, lanes = (each[distances_m(vec, rows) <= 150.0] for each in (rows, lanes))
            expected = np.zeros(len(table.lanes), dtype=np.int64)
            for s, signal in enumerate(table.arrays.row.tolist()):
                links = network.links[network.links["signal"] == signal]
                ends = [network.lane_polyline(lane)[-1] for lane in links["from_lane"].tolist()]
                camera = np.mean(ends, axis=0) + np.array([0.0, 0.0, 5.0])
                own = table.posts.signal[lanes] == s
                for row, lane in zip(rows[own], lanes[own], strict=True):
                    is_seen = is_in_sight(camera, row, rows[own])
                    expected[lane] += is_seen
                    hidden += not is_seen
            np.testing.assert_array_equal(vec.signals.view.counts[0, :, VEHICLES], expected)
        assert hidden > 20


def test_a_lane_is_observed_by_the_signal_at_its_end() -> None:
    with closing(make(0, sensing="camera")) as vec:
        table = vec.signals.table
        signal = table.posts.signal
        for s in range(len(table.ids)):
            incoming = [n for n in table.arrays.incoming[s].tolist() if n >= 0]
            assert (signal[incoming] == s).all()
        before = {n for row in table.arrays.incoming.tolist() for n in row}
        only_out = [n for n in range(len(signal)) if n not in before]
        assert len(only_out) > 10
        for n in only_out:
            assert n in table.arrays.outgoing[signal[n]]


def test_a_camera_misses_vehicles_by_chance() -> None:
    def counted(misses: float, seed: int = 3) -> NDArray[np.int64]:
        keys = {"camera_range_m": 1000.0, "camera_height_m": 100.0, "camera_misses": misses}
        with closing(make(sensing="camera", **keys)) as vec:
            found = [
                vec.signals.view.counts[0, :, VEHICLES].copy()
                for tick in ticks(vec, 20.0, seed)
                if tick % 5 == 0
            ]
            return np.array(found)

    everything, some = counted(0.0), counted(0.3)
    assert (some <= everything).all()
    assert some.sum() / everything.sum() == pytest.approx(0.7, abs=0.03)
    # Misses are drawn independently for each decision.
    standing = (np.diff(everything, axis=0) == 0) & (everything[1:] > 0)
    assert 0.1 < (np.diff(some, axis=0)[standing] != 0).mean() < 0.9
    np.testing.assert_array_equal(some, counted(0.3))
    assert not counted(1.0).any()


# Induction loops


def test_loops_report_the_vehicles_over_them() -> None:
    with closing(make(sensing="loops", loop_upstream_m=30.0)) as vec:
        table = vec.signals.table
        lanes = vec.network.lanes[table.arrays.lane_row]
        leads_in = np.isin(np.arange(len(lanes)), table.arrays.incoming)
        line = lanes["length_m"] - lanes["stop_back_m"]
        begin = np.where(leads_in, (line - 30.0, line - 3.0), (0.0 * line, 30.0 + 0.0 * line)).T
        was_covered = np.zeros(begin.shape, dtype=bool)
        count, covered_ticks = np.zeros((2, *begin.shape), dtype=np.int64)
        free_ticks = np.zeros(begin.shape, dtype=np.int64)
        counted = 0
        for tick in ticks(vec, 40.0):
            covered = np.zeros(begin.shape, dtype=bool)
            for row, n in zip(*watched(vec), strict=True):
                front = row["s"] + 0.5 * row["length"]
                rear = row["s"] - 0.5 * row["length"] - row["speed"] * TICK_S
                covered[n] |= (front >= begin[n]) & (rear <= begin[n] + 2.0)
            count += covered & ~was_covered
            covered_ticks += covered
            free_ticks = np.where(covered, 0, free_ticks + 1)
            was_covered = covered
            if tick % 5 == 0:
                found = vec.signals.view.loops[0]
                np.testing.assert_array_equal(found[..., COUNT], count)
                np.testing.assert_array_equal(found[..., COVERED_TICKS], covered_ticks)
                np.testing.assert_array_equal(found[..., FREE_TICKS], free_ticks)
                counted += int(count.sum())
                count[:] = covered_ticks[:] = 0
        assert counted > 200


def test_loops_estimate_the_vehicles_between_them() -> None:
    with closing(make(sensing="loops", loop_upstream_m=50.0, decide_s=5.0)) as vec:
        table = vec.signals.table
        incoming = np.unique(table.arrays.incoming[table.arrays.incoming >= 0])
        guessed, true = [], []
        for tick in ticks(vec, 240.0):
            if tick % 25 or tick < 150:
                continue
            rows, lanes = watched(vec)
            is_between = distances_m(vec, rows) <= 50.0
            counts = vec.signals.view.counts[0]
            true.append(sums(rows[is_between], lanes[is_between], len(counts))[incoming])
            guessed.append(counts[incoming][:, [VEHICLES, STANDING]])
            assert (counts[:, VEHICLES] >= counts[:, STANDING]).all()
            np.testing.assert_array_equal(counts[:, LENGTH_MM], 5000 * counts[:, VEHICLES])
            moving = counts[:, VEHICLES] - counts[:, STANDING]
            np.testing.assert_array_equal(counts[:, SPEED_PPM], 1_000_000 * moving)
            # The estimate is at least 1 if a vehicle covers the loop at the line, and at most 7.
            covered = vec.signals.view.loops[0, :, EXIT, FREE_TICKS] == 0
            assert (counts[covered, VEHICLES] > 0).all()
            np.testing.assert_array_equal(counts[:, NEAR_LINE], covered)
            assert counts[:, VEHICLES].max() <= 7
        for column, least in ((VEHICLES, 0.8), (STANDING, 0.7)):
            one, other = (np.array(each)[..., column].ravel() for each in (guessed, true))
            assert np.corrcoef(one, other)[0, 1] > least
            assert np.mean(one) == pytest.approx(np.mean(other), rel=0.35)


def test_loops_estimate_no_vehicles_on_an_empty_road() -> None:
    with closing(make(0, sensing="loops")) as vec:
        for _ in ticks(vec, 5.0):
            assert not vec.signals.view.counts.any()
        readings = vec.signals.view.loops[0]
        assert not readings[..., [COUNT, COVERED_TICKS]].any()
        assert (readings[..., FREE_TICKS] == 26).all()
        assert not vec.signals.view.observations[0, :, 3:].any()


def test_loops_estimate_standing_times_from_the_number_of_decisions_with_a_queue() -> None:
    with closing(make(sensing="loops")) as vec:
        before: NDArray[np.int64] | None = None
        longest = 0
        for tick in ticks(vec, 40.0):
            if tick % 5:
                continue
            counts = vec.signals.view.counts[0].copy()
            if before is not None:
                stood = before[:, STOOD_TICKS] + 5 * counts[:, STANDING]
                stood[counts[:, STANDING] == 0] = 0
                np.testing.assert_array_equal(counts[:, STOOD_TICKS], stood)
                longest = max(longest, int(stood.max()))
            before = counts
        assert longest > 100


def test_without_loops_there_are_no_readings() -> None:
    for sensing in ("truth", "camera"):
        with closing(make(0, sensing=sensing)) as vec:
            vec.reset()
            assert vec.signals.view.loops.shape == (1, 0, 2, 3)


# Messages


def test_roadside_units_count_the_vehicles_that_send_messages() -> None:
    with closing(make_messages(V2X, background=50)) as vec:
        before = None
        differing = total = 0
        for tick in ticks(vec, 40.0):
            counts = vec.signals.view.counts[0]
            if tick == 0:
                assert not counts.any()
            elif tick % 5 == 0:
                assert before is not None
                # The newest messages were sent in the previous tick.
                found = counts[:, [VEHICLES, STANDING, NEAR_LINE]]
                differing += int(np.abs(found - before).sum())
                total += int(before.sum())
            rows, lanes = watched(vec)
            near = np.bincount(lanes[near_line(vec, rows)], minlength=len(counts))
            before = np.column_stack([sums(rows, lanes, len(counts)), near])
        assert total > 500
        # Vehicles that change lanes, or that two units receive, cause differences.
        assert differing < 0.03 * total


@pytest.mark.parametrize(
    ("keys", "low", "high"),
    [
        ({"v2x.equipped": 0.0}, 0.0, 0.0),
        ({"v2x.equipped": 0.5}, 0.3, 0.7),
        ({"v2x.channel.loss": 1.0}, 0.0, 0.0),
        ({"v2x.channel.loss": 0.5}, 0.8, 1.05),  # later messages arrive
        ({"v2x.channel.range_m": 40.0}, 0.1, 0.7),
    ],
)
def test_roadside_units_count_only_vehicles_whose_messages_arrive(
    keys: dict[str, Any], low: float, high: float
) -> None:
    with closing(make_messages(V2X | keys, background=50)) as vec:
        known = true = 0
        for tick in ticks(vec, 15.0):
            if tick % 5 == 0 and tick:
                known += int(vec.signals.view.counts[..., VEHICLES].sum())
                true += len(watched(vec)[0])
        assert low <= known / true <= high


def test_messages_of_the_previous_episode_are_deleted() -> None:
    with closing(make_messages(V2X, background=50)) as vec:
        for _ in ticks(vec, 3.0):
            pass
        assert vec.signals.view.counts.any()
        vec.reset(seed=3)
        assert not vec.signals.view.counts.any()
        for _ in ticks(vec, 3.0):
            pass
        assert vec.signals.view.counts.any()


def test_full_inboxes_are_reported_once(caplog: pytest.LogCaptureFixture) -> None:
    with closing(make_messages(V2X | {"v2x.inbox.objects": 2}, background=100)) as vec:
        with caplog.at_level(logging.WARNING):
            for _ in ticks(vec, 6.0):
                pass
        told = [text for text in caplog.messages if "full inboxes of 2 vehicles" in text]
        assert len(told) == 1
        assert vec.signals.view.counts[0, :, VEHICLES].sum() <= 2 * 16


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ({"v2x.enabled": False}, r"vehicles send no messages: set v2x\.enabled to true"),
        ({"v2x.cam.rate_hz": 0.0}, r"v2x\.cam\.rate_hz above 0"),
        (
            {"v2x.roadside.signals": ["A0", "A1"]},
            r"14 signals with agents have no roadside unit, such as 'A2'; set v2x\.roadside",
        ),
        ({"signals.sensing": "radar"}, r"signals\.sensing"),
        ({"signals.camera_misses": 1.5}, r"signals\.camera_misses"),
    ],
)
def test_invalid_settings_are_refused_with_the_reason(keys: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        make_messages(V2X | keys)


# All kinds of sensing


@pytest.mark.parametrize("keys", [{"signals.sensing": "camera"}, {"signals.sensing": "loops"}, V2X])
def test_rewards_are_computed_from_all_vehicles(keys: dict[str, Any]) -> None:
    terms = {"diff_wait": 1.0, "average_speed": 1.0, "queue": 1.0, "pressure": 1.0}
    differing = 0
    with (
        closing(make_messages({"signals.terms": terms})) as truth,
        closing(make_messages({"signals.terms": terms} | keys)) as vec,
    ):
        for _ in zip(ticks(truth, 20.0), ticks(vec, 20.0), strict=True):
            one, other = truth.worlds.arrays, vec.worlds.arrays
            np.testing.assert_array_equal(one.signal_terms, other.signal_terms)
            np.testing.assert_array_equal(one.signal_rewards, other.signal_rewards)
            np.testing.assert_array_equal(one.signal_masks, other.signal_masks)
            differing += bool((one.signal_observations != other.signal_observations).any())
        assert differing > 50
        world = vec.worlds.world
        described = describe_world(world.config, world.network, None, world.partition)
        expected = {"observed": keys["signals.sensing"], "rewarded": "truth"}
        assert described["signals"] == expected
