"""Rewards shared with nearby agents, as in the local coordination of CoPO."""

from __future__ import annotations

import numpy as np

from cavmarl import make_vec
from cavmarl.config.terms import TERMS

SHARE, RANGE_M = 0.3, 40.0


def test_a_share_of_the_reward_is_the_mean_reward_of_nearby_agents() -> None:
    near = {"terms.team_share": SHARE, "terms.team_range_m": RANGE_M}
    vec = make_vec("merge", num_envs=2, overrides={"terms.weights": {"delay": 1.0}, **near})
    vec.reset(seed=0)
    neighbours = set()
    for _ in range(20):
        _, rewards, _, _, infos = vec.step(vec.suggest_actions())
        for world in range(2):
            acted = infos["acted"][world]
            own = infos["terms"][world, acted, TERMS.index("delay")].astype(np.float64)
            places = vec.simulation.outputs.places[world, acted]
            apart = np.linalg.norm(places[:, None] - places[None], axis=2) <= RANGE_M
            neighbours |= set(apart.sum(1).tolist())
            expected = (1.0 - SHARE) * own + SHARE * (apart @ own) / apart.sum(1)
            np.testing.assert_allclose(rewards[world, acted], expected, rtol=1e-5, atol=1e-6)
    assert len(neighbours) > 2
