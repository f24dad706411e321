"""Calibrated weights, predicted costs, other zones: each finds again what was put in."""

from __future__ import annotations

import random

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from cavmarl.balance.calibration import Calibration, LoggedTick, calibrate
from cavmarl.balance.least_squares import fit_non_negative
from cavmarl.balance.load_score import WEIGHTS, Utilisation
from cavmarl.balance.prediction import CostModel, ShardContent, fit_costs
from cavmarl.core.errors import ConfigError
from cavmarl.engine.world_setup import find_map
from cavmarl.handoff.repartition_plan import propose_zones
from cavmarl.roads.cache import load_network
from cavmarl.zones.partition.zone_layouts import cut_map
from cavmarl.zones.partition.zone_partition import ZonePartition

NUMBERS = st.floats(-10.0, 10.0).map(lambda value: round(value, 3))


def log(weights: tuple[float, float, float], rows: int = 60) -> list[LoggedTick]:
    """Ticks of workers that lose the weighted share of their time."""
    draw = random.Random(3)
    found = []
    for _ in range(rows):
        use = Utilisation(*(draw.uniform(0.0, 0.8) for _ in range(3)))
        lost = float(np.dot(weights, (use.cpu, use.ram, use.gpu)))
        found.append(LoggedTick(use, 0.01, 0.01 / (1.0 - lost)))
    return found


@pytest.mark.parametrize("weights", [(0.6, 0.2, 0.2), (1.0, 0.0, 0.0), (0.3, 0.0, 0.7)])
def test_weights_are_found_again(weights: tuple[float, float, float]) -> None:
    found = calibrate(log(weights))
    assert found.explained
    assert found.weights == pytest.approx(weights, abs=1e-9)


def test_no_weight_is_below_zero() -> None:
    # Memory in use goes with less lost time: a free fit would reward it.
    rows = log((0.8, 0.0, 0.0))
    biased = [row._replace(tick_s=row.load_s / (1.0 - 0.8 * row.use.cpu + 0.15 * row.use.ram))
              for row in rows]  # fmt: skip
    assert min(calibrate(biased).weights) == 0.0
    assert sum(calibrate(biased).weights) == pytest.approx(1.0)


@pytest.mark.parametrize(
    "rows", [[], [LoggedTick(Utilisation(0.5, 0.5), 0.0, 0.0)], log((0.0, 0.0, 0.0))]
)
def test_where_nothing_can_be_learnt_the_given_weights_stay(rows: list[LoggedTick]) -> None:
    found = calibrate(rows)
    assert (found.weights, found.explained) == (WEIGHTS, False)
    assert isinstance(found, Calibration)


def test_costs_are_found_again() -> None:
    draw = random.Random(4)
    truth = CostModel(2e-5, 3e-7, 1e-6, 5e-5)
    contents = [
        ShardContent(draw.randrange(500), draw.randrange(50), draw.randrange(5)) for _ in range(40)
    ]
    found = fit_costs(contents, [truth.predict(content) for content in contents])
    assert found == pytest.approx(truth, rel=1e-6)


def test_what_never_was_there_costs_nothing() -> None:
    contents = [ShardContent(vehicles, 0, 0) for vehicles in (10, 20, 40)]
    found = fit_costs(contents, [1e-5, 2e-5, 4e-5])
    assert found == pytest.approx(CostModel(0.0, 1e-6, 0.0, 0.0), abs=1e-18)


def test_a_fit_needs_a_cost_for_each_row() -> None:
    with pytest.raises(ConfigError, match="1 contents and 0 costs"):
        fit_costs([ShardContent(1, 1, 1)], [])
    with pytest.raises(ConfigError, match="not finite"):
        fit_costs([ShardContent(1, 1, 1)], [float("nan")])
    with pytest.raises(ConfigError, match="one value a row"):
        fit_non_negative(np.ones((2, 2)), np.ones(3))
    with pytest.raises(ConfigError, match="at most 8"):
        fit_non_negative(np.ones((2, 9)), np.ones(2))


@settings(deadline=None)
@given(arrays(np.float64, (6, 3), elements=NUMBERS), arrays(np.float64, 6, elements=NUMBERS))
def test_the_fit_is_the_best_without_a_negative_coefficient(
    rows: np.ndarray, values: np.ndarray
) -> None:
    found = fit_non_negative(rows, values)
    assert (found >= 0.0).all()
    # Karush, Kuhn, Tucker: no coefficient could grow with profit, none above 0 change at all.
    slope = rows.T @ (values - rows @ found)
    assert (slope <= 1e-6).all()
    assert (np.abs(slope[found > 0.0]) <= 1e-6).all()


@pytest.fixture(scope="module")
def town() -> tuple[object, np.ndarray]:
    """Roads, and places of vehicles of which most are in one corner."""
    network = load_network(find_map("grid4x4"))
    min_x, min_y, max_x, max_y = network.extent_m
    draw = np.random.default_rng(5)
    everywhere = draw.uniform((min_x, min_y), (max_x, max_y), (60, 2))
    corner = draw.uniform((min_x, min_y), (min_x + 100.0, min_y + 100.0), (240, 2))
    return network, np.vstack([everywhere, corner])


def test_zones_follow_the_measured_cost(town: tuple[object, np.ndarray]) -> None:
    network, places = town
    partition = cut_map(network, "grid", 4)  # type: ignore[arg-type]
    counts = np.bincount(partition.zones_of(places), minlength=4)
    found = propose_zones(network, partition, places, (counts * 1e-6).tolist())  # type: ignore[arg-type]
    assert found is not None
    assert found.partition.count == 4
    assert found.after < 1.2 < 2.0 < found.before
    moved = (found.partition.zones_of(places) != partition.zones_of(places)).sum()
    assert found.moved == moved > 0


def test_other_zones_keep_their_numbers_where_they_can(town: tuple[object, np.ndarray]) -> None:
    network, places = town
    halves = cut_map(network, "strips", 2)  # type: ignore[arg-type]
    for rects in (halves.rects, halves.rects[::-1]):
        first = ZonePartition(halves.bounds, rects)
        counts = np.bincount(first.zones_of(places), minlength=2)
        found = propose_zones(network, first, places, counts.tolist())  # type: ignore[arg-type]
        assert found is not None
        assert found.moved < len(places) / 2


def test_zones_stay_where_they_are_good_enough(town: tuple[object, np.ndarray]) -> None:
    network, places = town
    first = cut_map(network, "grid", 4)  # type: ignore[arg-type]
    counts = np.bincount(first.zones_of(places), minlength=4)
    better = propose_zones(network, first, places, counts.tolist())  # type: ignore[arg-type]
    assert better is not None
    again = np.bincount(better.partition.zones_of(places), minlength=4)
    assert propose_zones(network, better.partition, places, again.tolist()) is None  # type: ignore[arg-type]
    assert propose_zones(network, first, places[:0], [0.0] * 4) is None  # type: ignore[arg-type]
    one_place = np.repeat(places[:1], 50, axis=0)
    costs = np.bincount(first.zones_of(one_place), minlength=4).tolist()
    assert propose_zones(network, first, one_place, costs) is None  # type: ignore[arg-type]


@pytest.mark.parametrize("costs", [[1.0] * 3, [1.0, 1.0, 1.0, float("nan")], [1.0, 1.0, 1.0, -1.0]])
def test_zones_need_a_cost_each(town: tuple[object, np.ndarray], costs: list[float]) -> None:
    network, places = town
    with pytest.raises(ConfigError, match="one a zone of 4"):
        propose_zones(network, cut_map(network, "grid", 4), places, costs)  # type: ignore[arg-type]
