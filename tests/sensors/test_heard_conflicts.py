"""`sensors.conflicts.heard`: vehicles behind houses are known from messages only."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import cavmarl
from cavmarl.core.math.neighbors import fill_grid
from cavmarl.engine.spaces import observation_parts
from cavmarl.sensors.kernels.observing_conflicts import forget_others, observe_conflicts
from cavmarl.sensors.observed import conflicts_sensor
from tests.naive import observing_way as naive
from tests.sensors.test_hidden_neighbors import blocked

COUNT, RANGE_M, SIZE = 12, 120.0, 11
SETTINGS = {
    "observation.kind": "flat", "sensors.conflicts.count": COUNT,
    "sensors.conflicts.range_m": RANGE_M, "sensors.conflicts.through_walls": False,
    "sensors.conflicts.heard": True, "v2x.cam.rate_hz": 2.0,
}  # fmt: skip


def made(overrides: dict[str, Any] | None = None, **keywords: Any) -> Any:
    return cavmarl.make_vec("blind_junction", overrides=SETTINGS | (overrides or {}), **keywords)


def driven(vec: Any, steps: int, seed: int = 5) -> Any:
    observations, _ = vec.reset(seed=seed)
    for _ in range(steps):
        yield observations
        observations, *_ = vec.step(vec.suggest_actions())


def ticks(vec: Any) -> int:
    return int(vec.worlds.simulation.shards[0].worlds.ticks[0])


def part(vec: Any) -> slice:
    return observation_parts(vec.config.sensors)["conflicts"].place


def reported(vec: Any, me: np.void) -> dict[int, tuple[np.void, float]]:
    """Return by id the vehicles in an agent's inbox: (extrapolated row, age of the report in s)."""
    found = {}
    for report in vec.simulation.messages.mail.objects[0, me["agent"]]:
        if report["sender"] < 0:
            break
        row = me.copy()
        age_s = float(ticks(vec) - report["tick"]) * vec.config.clock.sim_dt_s
        gone_m = age_s * report["speed"]
        for name in ("z", "heading", "speed", "length", "width"):
            row[name] = report[name]
        row["x"] = report["x"] + gone_m * np.cos(report["heading"])
        row["y"] = report["y"] + gone_m * np.sin(report["heading"])
        found[int(report["subject"])] = row, age_s
    return found


def by_place(numbers: NDArray[np.float64]) -> NDArray[np.float64]:
    """Sort rows by position, because rounding decides the order of equally critical vehicles."""
    rows = numbers.reshape(COUNT, SIZE)
    assert bool(rows[-1, 0] == 0.0), "more vehicles are known than fit into the observation"
    return rows[np.lexsort(np.round(rows[:, 2:4], 3).T)]


def hidden_from(rows: NDArray[np.void], me: np.void) -> list[int]:
    return [int(row["id"]) for row in rows if blocked(me["x"], me["y"], float(row["x"]), row["y"])]


def test_observed_visible_and_reported_vehicles_equal_those_of_the_twin() -> None:
    vec = made({"v2x.channel.loss": 0.3})
    simulation = vec.worlds.simulation
    heard = old = 0
    for k, observations in enumerate(driven(vec, 120)):
        if k % 12 < 10:
            continue
        rows = simulation.vehicles(0)
        for i in np.flatnonzero(rows["agent"] >= 0):
            me = rows[i]
            numbers = observations[0, me["agent"]][part(vec)]
            told, hidden = reported(vec, me), hidden_from(rows, me)
            plans = simulation.plans
            twin = naive.conflicts(
                simulation.network, plans, rows, i, {}, COUNT, RANGE_M, hidden, told
            )
            found = numbers.reshape(COUNT, SIZE).astype(np.float64)
            np.testing.assert_allclose(by_place(found), by_place(np.array(twin)), atol=2e-5)
            of_messages = found
            of_messages = of_messages[(of_messages[:, 0] > 0.0) & (of_messages[:, 9] == 0.0)]
            heard += len(of_messages)
            old += int((of_messages[:, 10] > 0.0).sum())
    assert heard > 50
    assert old > 10
    vec.close()


def test_without_messages_only_visible_vehicles_are_known() -> None:
    deaf, sight = made({"v2x.channel.loss": 1.0}), made({"sensors.conflicts.heard": False})
    for one, other in zip(driven(deaf, 60), driven(sight, 60), strict=True):
        heard = one[..., part(deaf)].reshape(-1, COUNT, SIZE)
        seen = other[..., part(sight)].reshape(-1, COUNT, SIZE - 2)
        np.testing.assert_array_equal(heard[..., :9], seen)
        np.testing.assert_array_equal(heard[..., 9], seen[..., 0] > 0.0)
        assert not heard[..., 10].any()
    deaf.close()
    sight.close()


def test_the_true_state_of_a_hidden_vehicle_has_no_effect() -> None:
    vec = made()
    for _ in driven(vec, 60):
        pass
    shard = vec.worlds.simulation.shards[0]
    rows = vec.worlds.simulation.vehicles(0).copy()
    walls = shard.optional.conflicts.walls
    sensor = conflicts_sensor.settings(
        vec.config.sensors, 0, walls, vec.config.v2x.inbox.objects, 64
    )
    inboxes = vec.simulation.messages.mail.objects[0]
    phase, tick = np.zeros(0, np.int32), ticks(vec)

    def observed(rows: NDArray[np.void], i: int) -> NDArray[np.float32]:
        out = np.zeros(COUNT * SIZE, np.float32)
        fill_grid(rows, len(rows), shard.grid)
        forget_others(sensor)
        told = inboxes[rows[i]["agent"]]
        observe_conflicts(
            shard.roads, shard.travel, rows, i, shard.grid, phase, told, tick, 0.1, sensor, out
        )
        return out

    changed = 0
    for i in np.flatnonzero(rows["agent"] >= 0):
        hidden = np.isin(rows["id"], hidden_from(rows, rows[i]))
        other = rows.copy()
        for name in ("speed", "heading", "accel", "lane", "goal", "way", "length"):
            other[name][hidden] = 0
        np.testing.assert_array_equal(observed(rows, i), observed(other, i))
        changed += int(hidden.sum())
    assert changed > 0
    vec.close()


@pytest.mark.parametrize("split", [{"zones": 2}, {"zones": 4}, {"zones": 2, "workers": 2}])
def test_zones_and_workers_change_no_result(split: dict[str, int]) -> None:
    lossy = {"v2x.channel.loss": 0.3}
    whole, divided = made(lossy), made(lossy, **split)
    for one, other in zip(driven(whole, 40), driven(divided, 40), strict=True):
        np.testing.assert_array_equal(one, other)
        assert whole.observation_space.contains(one)
    whole.close()
    divided.close()
