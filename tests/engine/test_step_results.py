from __future__ import annotations

import numpy as np
import pytest

from cavmarl.core.records.arrays import DepartureQueue, Outputs
from cavmarl.core.records.codes import EVENT_ARRIVED, EVENT_COLLIDED, EVENT_OUT_OF_TIME, NUM_COUNTS
from cavmarl.driving.vehicles import blank_vehicle
from cavmarl.engine.kernels.step_results import Results, keep_last, report, report_continuation
from cavmarl.engine.world_setup import load_world
from cavmarl.roads.network import RoadNetwork
from cavmarl.traffic.departure_queue import make_departure_queue
from tests.naive import step_results as naive

WORLDS, AGENTS, TERMS, HORIZON = 5, 4, 3, 7
LATE = EVENT_OUT_OF_TIME
KINDS = [0, 1 << 20, EVENT_COLLIDED, EVENT_ARRIVED, LATE, LATE | EVENT_COLLIDED]


@pytest.fixture(scope="module")
def network() -> RoadNetwork:
    return load_world("merge").network


def outputs_of(rng: np.random.Generator) -> Outputs:
    shape = (WORLDS, AGENTS)
    present = rng.random(shape) < 0.4
    return Outputs(
        observations=np.zeros((*shape, 2), np.float32),
        terms=rng.random((*shape, TERMS), dtype=np.float32),
        rewards=rng.random(shape, dtype=np.float32),
        terminated=present & (rng.random(shape) < 0.2),
        present=present,
        acted=present & (rng.random(shape) < 0.8),
        events=rng.choice(KINDS, shape).astype(np.int32),
        vehicle_ids=rng.integers(-1, 99, shape),
        places=np.zeros((*shape, 2)),
    )


def gate_of(rng: np.random.Generator, network: RoadNetwork) -> DepartureQueue:
    departures = make_departure_queue(WORLDS, 6, network.arrays, blank_vehicle().dtype)
    departures.num_queue[:] = rng.integers(0, 3, WORLDS)
    departures.queue["agent"] = rng.integers(-1, 2, departures.queue.shape)
    departures.counts[:] = rng.integers(0, 50, (WORLDS, NUM_COUNTS))
    return departures


def results_of() -> Results:
    flags = [np.ones((WORLDS, AGENTS), np.bool_) for _ in range(5)]
    terminations, truncations, acted, done, mask = flags
    return Results(
        rewards=np.zeros((WORLDS, AGENTS), np.float32),
        terms=np.zeros((WORLDS, AGENTS, TERMS), np.float32),
        terminations=terminations,
        truncations=truncations,
        acted=acted,
        vehicle_done=done,
        vehicle_ids=np.zeros((WORLDS, AGENTS), np.int64),
        mask=mask,
        arrivals=np.zeros(WORLDS, np.int64),
        episode_over=np.ones(WORLDS, np.bool_),
    )


@pytest.mark.parametrize("seed", range(20))
def test_the_step_results_equal_those_of_the_slow_twin(seed: int, network: RoadNetwork) -> None:
    rng = np.random.default_rng(seed)
    has_signals = seed % 2 == 1
    outputs, departures = outputs_of(rng), gate_of(rng, network)
    steps = rng.integers(0, HORIZON + 1, WORLDS)
    expected_steps, found, expected = steps.copy(), results_of(), results_of()
    ended = report(outputs, steps, HORIZON, found)
    assert ended == naive.report(outputs, expected_steps, HORIZON, expected)
    over = report_continuation(outputs, departures, steps, HORIZON, has_signals, found)
    assert over == naive.report_continuation(
        outputs, departures, expected_steps, HORIZON, has_signals, expected
    )
    np.testing.assert_array_equal(steps, expected_steps)
    for name in Results._fields:
        np.testing.assert_array_equal(getattr(found, name), getattr(expected, name), name)


@pytest.mark.parametrize("in_next_step", [False, True])
@pytest.mark.parametrize("seed", range(10))
def test_last_observations_of_ended_agents_are_kept(
    seed: int, in_next_step: bool, network: RoadNetwork
) -> None:
    rng = np.random.default_rng(seed)
    results = results_of()
    report(outputs_of(rng), np.zeros(WORLDS, np.int64), HORIZON, results)
    results.episode_over[:] = rng.random(WORLDS) < 0.3
    seen = rng.random((WORLDS, AGENTS, 6), dtype=np.float32)
    found, expected = (seen.copy(), np.zeros_like(seen)), (seen.copy(), np.zeros_like(seen))
    keep_last(results, *found, in_next_step)
    naive.keep_last(results, *expected, in_next_step)
    for array, other in zip(found, expected, strict=True):
        np.testing.assert_array_equal(array, other)
