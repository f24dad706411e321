"""`population.fleet`: parts of the agents have different types, sensors and drivers."""

from __future__ import annotations

from collections import Counter
from typing import Any

import numpy as np
import pytest

import cavmarl
from cavmarl.config.fleet import FleetPart, parts_in_turn
from cavmarl.core.errors import ConfigError, PolicyError
from cavmarl.parallel.nodes.node_worlds import NodeWorlds

RIG = {
    "roof": {"type": "lidar", "rate_hz": 10.0, "z_m": 1.5, "rays": 12, "range_m": 60.0},
    "front": {"type": "depth_camera", "rate_hz": 5.0, "z_m": 1.2, "height": 4, "width": 6},
    "gnss": {"type": "gnss", "rate_hz": 5.0, "noise": [0.5]},
    "imu": {"type": "imu", "rate_hz": 10.0},
    "touch": {"type": "collision"},
}
OWN = {"van": {"like": "truck", "length_m": 6.4, "width_m": 2.1, "max_speed_mps": 36.0}}
FLEET = [
    {"type": "car", "rig": ["roof", "gnss"], "share": 2.0},
    {"type": "van", "rig": ["gnss", "front", "imu", "touch"], "driver": "never_yield"},
]
# The part of each agent 0 to 5; the first part has two thirds of the agents.
PARTS = [0, 1, 0, 0, 1, 0]
SMALL: dict[str, Any] = {"agents": 6, "background": 12}


def overrides(**more: Any) -> dict[str, Any]:
    return {
        "rig": RIG,
        "population.own_types": OWN,
        "population.fleet": FLEET,
        "population.mode": "respawn",
        "observation.mode": "sensors",
        "observation.kind": "dict",
        **more,
    }


def test_parts_have_their_shares_of_any_number_of_agents() -> None:
    parts = [FleetPart(share=2.0), FleetPart(share=1.0)]
    assert parts_in_turn(parts, 6).tolist() == PARTS
    parts = [FleetPart(share=0.5), FleetPart(share=0.3), FleetPart(share=0.2)]
    for count in (1, 7, 10, 1000):
        found = Counter(parts_in_turn(parts, count).tolist())
        for part, one in enumerate(parts):
            assert abs(found[part] - one.share * count) < 1.0


def test_agents_have_the_types_of_their_parts() -> None:
    vec = cavmarl.make_vec("grid4x4", overrides=overrides(), **SMALL)
    vec.reset(seed=1)
    rows = vec.simulation.vehicles(0)
    types = vec.simulation.types
    for row in rows[rows["agent"] >= 0]:
        kind = types[row["vtype"]]
        if PARTS[row["agent"]]:
            assert (kind["length"], kind["width"], kind["max_speed"]) == (6.4, 2.1, 36.0)
            assert kind["accel"] == kind["most_accel"] == 1.5  # the acceleration of a truck in m/s²
            assert kind["wheelbase"] == 4.8
        else:
            assert kind["length"] == 5.0


def test_only_agents_that_carry_a_sensor_get_its_samples() -> None:
    env = cavmarl.parallel_env("grid4x4", overrides=overrides(), **SMALL)
    # For comparison, all agents carry all sensors. Their types, and so their trips, are equal.
    whole = [{**part, "rig": None} for part in FLEET]
    everything = cavmarl.parallel_env(
        "grid4x4", overrides=overrides(**{"population.fleet": whole}), **SMALL
    )
    seen, of_all = env.reset(seed=3)[0], everything.reset(seed=3)[0]
    for _ in range(20):
        for agent, observation in seen.items():
            names = FLEET[PARTS[int(agent.split("_")[1])]]["rig"]
            assert sorted(observation) == sorted(names)
            assert env.observation_space(agent).contains(observation)
            for name in names:
                np.testing.assert_array_equal(observation[name], of_all[agent][name])
        actions = env.suggest_actions()
        seen, of_all = env.step(actions)[0], everything.step(actions)[0]
    assert len(seen) == 6
    env.close()
    everything.close()


def test_a_batch_has_zeros_for_agents_without_the_sensor_and_a_mask_of_carriers() -> None:
    vec = cavmarl.make_vec("grid4x4", num_envs=2, overrides=overrides(), **SMALL)
    observations, _ = vec.reset(seed=3)
    for _ in range(3):
        observations, *_ = vec.step(vec.suggest_actions())
    assert vec.carriers["roof"].tolist() == [part == 0 for part in PARTS]
    assert vec.carriers["gnss"].all()
    frames = vec.frames()
    for name, carriers in vec.carriers.items():
        assert not observations[name][:, ~carriers].any()
        assert not frames[name].fresh[:, ~carriers].any()
        if name != "touch":
            assert (
                observations[name][:, carriers]
                .any(axis=tuple(range(2, observations[name].ndim)))
                .all()
            )


@pytest.mark.parametrize("backend", ["local", "processes:2", "nodes:2"])
def test_scans_of_a_fleet_do_not_depend_on_zones(backend: str) -> None:
    """A lidar at 10 Hz scans exactly every 0.1 s, even if its vehicle changes the zone."""
    one = cavmarl.make_vec("grid4x4", overrides=overrides(), **SMALL)
    many = cavmarl.make_vec("grid4x4", zones=4, backend=backend, overrides=overrides(), **SMALL)
    try:
        one.reset(seed=5)
        many.reset(seed=5)
        scans = np.zeros(6, dtype=np.int64)
        for _ in range(60):
            actions = one.suggest_actions()
            one.step(actions)
            many.step(actions)
            frames, others = one.frames(), many.frames()
            for name in RIG:
                for ours, theirs in zip(frames[name], others[name], strict=True):
                    np.testing.assert_array_equal(ours, theirs)
            scans += frames["roof"].fresh[0]
        assert scans.tolist() == [round(60 * one.step_s * 10.0) * (part == 0) for part in PARTS]
        assert one.state_hash() == many.state_hash()
        if isinstance(many.worlds, NodeWorlds):
            assert many.worlds.migrations > 0
    finally:
        one.close()
        many.close()


def test_sensor_workers_compute_the_same_samples_of_a_fleet() -> None:
    here = cavmarl.make_vec("grid4x4", overrides=overrides(), **SMALL)
    there = cavmarl.make_vec("grid4x4", sensor_workers=1, overrides=overrides(), **SMALL)
    try:
        here.reset(seed=5)
        there.reset(seed=5)
        for _ in range(10):
            actions = here.suggest_actions()
            here.step(actions)
            there.step(actions)
            for name, frames in here.frames().items():
                for ours, theirs in zip(frames, there.frames()[name], strict=True):
                    np.testing.assert_array_equal(ours, theirs)
    finally:
        here.close()
        there.close()


def test_the_policy_fleet_gives_each_part_its_driver() -> None:
    vec = cavmarl.make_vec(
        "grid4x4", overrides={"population.fleet": DRIVEN, "population.mode": "respawn"}, **SMALL
    )
    vec.reset(seed=2)
    policies = {name: cavmarl.load_policy(name, vec) for name in ("fleet", "idm", "never_yield")}
    mask = np.ones((1, 6), dtype=np.bool_)
    for _ in range(40):
        observations, *_, infos = vec.step(vec.suggest_actions())
        mask = infos["mask"]
        acts = {name: policy.act_batch(observations, mask) for name, policy in policies.items()}
        for agent, part in enumerate(PARTS):
            name = ("idm", "never_yield")[part]
            np.testing.assert_array_equal(acts["fleet"][:, agent], acts[name][:, agent])


DRIVEN = [{"share": 2.0}, {"driver": "never_yield"}]


def test_a_policy_acts_on_dicts_with_different_sensors() -> None:
    class Seen(cavmarl.Policy):
        """A policy that keeps its last batch of flat observations."""

        def act_batch(self, observations: Any, mask: Any) -> Any:
            self.observations = observations.copy()
            return np.zeros((*mask.shape, 2), dtype=np.float32)

    flat = overrides(**{"observation.kind": "flat"})
    env = cavmarl.parallel_env("grid4x4", overrides=overrides(), **SMALL)
    batch = cavmarl.make_vec("grid4x4", overrides=flat, **SMALL)
    policy = Seen(env)
    observations, padded = env.reset(seed=3)[0], batch.reset(seed=3)[0]
    for _ in range(3):
        actions = policy.act(observations)
        np.testing.assert_array_equal(policy.observations, padded)
        assert sorted(actions) == sorted(observations)
        observations, padded = env.step(actions)[0], batch.step(np.zeros((1, 6, 2)))[0]


def test_invalid_fleets_are_refused() -> None:
    def refused(match: str, **keys: Any) -> None:
        with pytest.raises(ConfigError, match=match):
            cavmarl.make_vec("grid4x4", overrides=overrides(**keys), **SMALL)

    refused(
        "population.fleet.0.type = 'lorry': must be one of car, truck, bus, van; define others",
        **{"population.fleet": [{"type": "lorry"}]},
    )
    refused(
        r"population.fleet.0.rig.*must name sensors of rig: roof, front, gnss",
        **{"population.fleet": [{"rig": ["rear"]}]},
    )
    refused("population.fleet.0.share", **{"population.fleet": [{"share": 0.0}]})
    refused("population.fleet sets the types", **{"population.types": ["truck"]})
    refused("wheelbase_m = 6.9: must be at most the length", **{
        "population.own_types": {"van": {"length_m": 6.4, "wheelbase_m": 6.9}}
    })  # fmt: skip
    refused("must be an identifier", **{"population.own_types": {"car": {"length_m": 3.0}}})
    refused(
        r"rig.roof.z_m = 1.5: outside the vehicle's body",
        **{
            "population.own_types": {"van": {"height_m": 1.0}},
            "population.fleet": [{"type": "van", "rig": ["roof"]}],
        },
    )
    vec = cavmarl.make_vec("grid4x4", **SMALL)
    with pytest.raises(PolicyError, match=r"has no population.fleet; set it"):
        cavmarl.load_policy("fleet", vec)
