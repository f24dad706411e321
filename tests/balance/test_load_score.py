"""LoadScore and the worker that it selects, with the figures of the paper and exact thresholds."""

from __future__ import annotations

import math
from itertools import permutations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from cavmarl.balance.load_score import (
    RESOURCES,
    THRESHOLDS,
    WEIGHTS,
    Candidate,
    LoadRule,
    Rejection,
    Utilisation,
    find_rejections,
    load_score,
    select,
)
from cavmarl.core.errors import ConfigError, NoAdmissibleWorkerError

SHARES = st.floats(0.0, 1.0)
USES = st.builds(Utilisation, SHARES, SHARES, SHARES)
FLEETS = st.lists(USES, min_size=1, max_size=6).map(
    lambda uses: [Candidate(number, use) for number, use in enumerate(uses)]
)


def fleet(*uses: tuple[float, float, float]) -> list[Candidate]:
    return [Candidate(number, Utilisation(*use)) for number, use in enumerate(uses)]


def test_the_default_rule_equals_the_rule_of_the_paper() -> None:
    assert LoadRule().weights == (0.6, 0.2, 0.2)
    assert LoadRule().thresholds == (0.85, 0.90, 0.95)


@pytest.mark.parametrize(
    ("use", "score"),
    [
        ((0.50, 0.40, 0.30), 0.44),
        ((0.20, 0.85, 0.90), 0.47),
        ((1.0, 1.0, 1.0), 1.0),
        ((0.0, 0.0, 0.0), 0.0),
        ((0.10, 0.91, 0.05), 0.252),
        ((0.80, 0.80, 0.80), 0.80),
    ],
)
def test_scores_equal_those_of_the_paper(use: tuple[float, float, float], score: float) -> None:
    assert load_score(Utilisation(*use)) == pytest.approx(score, abs=1e-15)


def test_one_resource_above_its_threshold_excludes_a_worker_with_other_free_resources() -> None:
    found = select(fleet((0.10, 0.91, 0.05), (0.80, 0.80, 0.80)))
    assert found.worker == 1
    assert found.rejections == (Rejection(0, "ram", 0.91, 0.90),)
    assert str(found.rejections[0]) == "worker 0: ram 0.91 > 0.9"


@pytest.mark.parametrize(("resource", "threshold"), [*zip(RESOURCES, THRESHOLDS, strict=True)])
def test_a_use_equal_to_its_threshold_is_allowed_and_the_next_float_is_not(
    resource: str, threshold: float
) -> None:
    def use(value: float) -> list[Candidate]:
        return [Candidate(0, Utilisation(**{"cpu": 0.0, "ram": 0.0, resource: value}))]

    assert find_rejections(use(threshold)) == ()
    above = math.nextafter(threshold, 2.0)
    assert find_rejections(use(above)) == (Rejection(0, resource, above, threshold),)


@given(FLEETS)
def test_the_best_worker_below_all_thresholds_is_chosen(
    workers: list[Candidate],
) -> None:
    def fits(use: Utilisation) -> bool:
        return use.cpu <= 0.85 and use.ram <= 0.90 and use.gpu <= 0.95

    good = {one.worker: load_score(one.use) for one in workers if fits(one.use)}
    if not good:
        with pytest.raises(NoAdmissibleWorkerError) as caught:
            select(workers)
        assert {reason[0] for reason in caught.value.rejections} == {one.worker for one in workers}
        return
    found = select(workers)
    assert dict(found.scores) == good
    assert good[found.worker] == min(good.values())
    assert {one.worker for one in workers} == good.keys() | {one.worker for one in found.rejections}


@given(FLEETS)
def test_the_order_of_workers_does_not_matter(workers: list[Candidate]) -> None:
    def choose(order: tuple[Candidate, ...]) -> object:
        try:
            return select(order)
        except NoAdmissibleWorkerError as error:
            return error.rejections

    assert len({repr(choose(order)) for order in permutations(workers[:4])}) == 1


@given(USES, SHARES, SHARES)
def test_a_score_is_between_0_and_1_and_rises_with_use(
    use: Utilisation, first: float, rest: float
) -> None:
    weights = (first, (1.0 - first) * rest, (1.0 - first) * (1.0 - rest))
    score = load_score(use, weights)
    assert 0.0 <= score <= 1.0 + 1e-12
    assert score <= load_score(Utilisation(1.0, use.ram, use.gpu), weights)


def test_with_equal_scores_the_worker_with_fewer_shards_or_the_lower_number_is_chosen() -> None:
    use = Utilisation(0.5, 0.5, 0.5)
    assert select([Candidate(2, use), Candidate(1, use), Candidate(3, use)]).worker == 1
    assert select([Candidate(1, use, hosted=2), Candidate(3, use, hosted=1)]).worker == 3


def test_equal_workers_get_equal_numbers_of_shards() -> None:
    hosted = dict.fromkeys(range(5), 0)
    for _ in range(50):
        workers = [Candidate(n, Utilisation(0.0, 0.0), hosted[n]) for n in hosted]
        hosted[select(workers).worker] += 1
    assert set(hosted.values()) == {10}


@pytest.mark.parametrize(
    ("preferred", "worker", "outcome"),
    [
        (None, 0, "lowest score"),
        (0, 0, "preferred"),
        (1, 1, "preferred"),
        (2, 0, "preferred above margin"),
        (3, 0, "preferred excluded"),
        (4, 0, "preferred unavailable"),
    ],
)
def test_a_preferred_worker_is_kept_within_the_margin(
    preferred: int | None, worker: int, outcome: str
) -> None:
    workers = fleet((0.1, 0.1, 0.1), (0.15, 0.1, 0.1), (0.3, 0.1, 0.1), (0.9, 0.1, 0.1))
    workers.append(Candidate(4, Utilisation(0.0, 0.0), available=False))
    found = select(workers, preferred=preferred)
    assert (found.worker, found.outcome) == (worker, outcome)
    assert found.redirected == (preferred not in (None, worker))
    assert {(one.worker, one.resource) for one in found.rejections} == {
        (3, "cpu"),
        (4, "unavailable"),
    }


def test_a_score_exactly_at_the_margin_is_within_the_margin() -> None:
    workers = fleet((0.0, 0.0, 0.0), (0.0, 0.5, 0.0))
    assert select(workers, LoadRule(margin=0.1), preferred=1).worker == 1
    assert select(workers, LoadRule(margin=math.nextafter(0.1, 0.0)), preferred=1).worker == 0


def test_the_error_without_admissible_workers_has_every_reason() -> None:
    workers = [*fleet((0.9, 0.95, 0.1)), Candidate(1, Utilisation(0.0, 0.0), available=False)]
    with pytest.raises(NoAdmissibleWorkerError, match="no admissible worker") as caught:
        select(workers)
    assert caught.value.rejections == (
        Rejection(0, "cpu", 0.9, 0.85),
        Rejection(0, "ram", 0.95, 0.90),
        Rejection(1, "unavailable", None, None),
    )
    assert all(str(reason) in str(caught.value) for reason in caught.value.rejections)


def test_without_workers_no_worker_is_admissible() -> None:
    with pytest.raises(NoAdmissibleWorkerError, match="there are no workers"):
        select([])


def test_an_unknown_preferred_worker_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"preferred worker 7: must be one of \[0\]"):
        select(fleet((0.0, 0.0, 0.0)), preferred=7)


def test_a_repeated_worker_is_refused() -> None:
    with pytest.raises(ConfigError, match="must be named once"):
        select([Candidate(0, Utilisation(0.0, 0.0))] * 2)


@pytest.mark.parametrize("value", [-0.01, 1.01, 50.0, math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("resource", RESOURCES)
def test_utilisations_outside_of_0_to_1_are_refused(resource: str, value: float) -> None:
    shares = {"cpu": 0.0, "ram": 0.0, "gpu": 0.0, resource: value}
    with pytest.raises(ConfigError, match=f"utilisation {resource} = "):
        Utilisation(**shares)


def test_the_error_for_a_percentage_names_the_fraction() -> None:
    with pytest.raises(ConfigError, match=r"percentage, use 0\.55"):
        Utilisation(55.0, 0.0)


@pytest.mark.parametrize(
    ("weights", "said"),
    [
        ((-0.2, 0.6, 0.6), "weight cpu = -0.2"),
        ((0.6, math.nan, 0.2), "weight ram = nan"),
        ((0.6, 0.2, 0.3), "sum to 1.1"),
        ((0.0, 0.0, 0.0), "sum to 0"),
        ((60.0, 20.0, 20.0), "sum to 100"),
    ],
)
def test_invalid_weights_are_refused(weights: tuple[float, float, float], said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        LoadRule(weights)


@pytest.mark.parametrize("weights", [WEIGHTS, (1.0, 0.0, 0.0), (0.1, 0.2, 0.7), (1 / 3,) * 3])
def test_weights_that_sum_to_one_are_accepted(weights: tuple[float, float, float]) -> None:
    assert LoadRule(weights).weights == weights


@pytest.mark.parametrize(
    ("rule", "said"),
    [
        ({"thresholds": (85.0, 0.9, 0.95)}, "threshold cpu = 85.0"),
        ({"thresholds": (1.0, 1.0, 1.0)}, "without free resources"),
        ({"margin": -0.1}, "margin = -0.1"),
        ({"margin": math.nan}, "margin = nan"),
    ],
)
def test_invalid_thresholds_and_margins_are_refused(rule: dict[str, object], said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        LoadRule(**rule)  # type: ignore[arg-type]
