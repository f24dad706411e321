"""The driver `gap_taker` at a blind junction, with and without messages."""

from __future__ import annotations

from typing import Any

import pytest

import cavmarl
from cavmarl import load_policy, make_vec
from cavmarl.config.terms import TERMS
from cavmarl.core.errors import PolicyError

LOSS = "v2x.channel.loss"
COLLISION, DELAY = TERMS.index("collision"), TERMS.index("delay")


def driven(loss: float, seed: int, worlds: int = 8, **overrides: Any) -> tuple[int, int, float]:
    """Run worlds; return the numbers of ended trips and of collisions, and the mean delay in s."""
    vec = make_vec("blind_junction", num_envs=worlds, overrides={LOSS: loss, **overrides})
    driver = load_policy("gap_taker", vec)
    driver.reset(seed)
    observations, infos = vec.reset(seed=seed)
    trips = collisions = 0
    delay_s = 0.0
    for _ in range(499):
        observations, *_, infos = vec.step(driver.act_batch(observations, infos["mask"]))
        trips += int(infos["vehicle_done"].sum())
        collisions += int((infos["terms"][..., COLLISION] > 0.0).sum())
        delay_s += float(infos["terms"][..., DELAY].sum())
    vec.close()
    return trips, collisions, delay_s / trips


def test_messages_halve_the_collisions_without_more_delay() -> None:
    trips, collisions, delay_s = driven(0.0, seed=8)
    deaf_trips, deaf_collisions, deaf_delay_s = driven(1.0, seed=8)
    assert min(trips, deaf_trips) > 60
    assert collisions / trips < 0.5 * deaf_collisions / deaf_trips
    assert delay_s < deaf_delay_s


def test_results_do_not_depend_on_zones() -> None:
    whole = driven(0.3, seed=3, worlds=2)
    assert driven(0.3, seed=3, worlds=2, **{"zones.count": 2}) == whole


@pytest.mark.parametrize(
    "settings",
    [
        {"sensors.conflicts.count": 0},
        {"sensors.conflicts.heard": False},
        {"sensors.signal.enabled": False},
        {"action.kind": "discrete"},
    ],
)
def test_the_error_names_missing_requirements(settings: dict[str, Any]) -> None:
    env = cavmarl.make_vec("blind_junction", overrides=settings)
    with pytest.raises(PolicyError, match=r"sensors\.conflicts\.heard"):
        load_policy("gap_taker", env)
    env.close()
