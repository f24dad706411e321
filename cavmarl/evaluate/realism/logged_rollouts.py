"""Rollouts of a logged scene with a driver, and their realism."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import closing
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.errors import ConfigError
from cavmarl.core.records.codes import DRIVER_EXTERNAL
from cavmarl.env.vector import CavVectorEnv, make_vec
from cavmarl.evaluate.realism.realism_metric import ROLLOUTS, YEAR, Realism, realism_of
from cavmarl.evaluate.realism.rollout_features import Trajectories, features_of
from cavmarl.maps.scenes.logged_scene import Track
from cavmarl.policies.loading import load_policy
from cavmarl.traffic.scenarios.scene import LoggedTraffic

Numbers = NDArray[np.float64]


@dataclass(frozen=True)
class RealismRun:
    """The realism of rollouts of one scene with one driver."""

    scene: str
    driver: str
    rollouts: int
    seed: int
    steps: int  # number of compared steps
    evaluated: int  # vehicles that agents or built-in drivers drove
    replayed: int  # road users that followed the log
    # object steps of the log that are missing in rollouts because a vehicle had left, per cent
    missing_percent: float
    ade_m: float  # mean distance from the logged position, over rollouts, vehicles and steps
    min_ade_m: float  # the smallest mean distance of a rollout
    realism: Realism

    def to_dict(self) -> dict[str, Any]:
        plain = {key: value for key, value in asdict(self).items() if key != "realism"}
        return plain | {"challenge_year": YEAR, "realism": self.realism.to_dict()}


def measure_realism(
    env: str | Path,
    driver: str = "idm",
    *,
    rollouts: int = ROLLOUTS,
    agents: int | None = None,
    seed: int = 0,
    overrides: Mapping[str, Any] | None = None,
    told: Callable[[int, int], None] | None = None,
) -> RealismRun:
    """Measure the realism of a driver in a logged scene.

    Args:
        env: a scene file, or an environment with a logged scene.
        driver: driver of the agents.
        rollouts: number of episodes with different random numbers.
        agents: number of agents; None: as configured.
        seed: seed of the first episode.
        overrides: values of further keys.
        told: called with the number of finished steps and the number of steps.

    Raises:
        ConfigError: the environment has no logged scene, or its step length differs from the log's.
        ScenarioError: the scene has no road edges, or too few samples.
    """
    if rollouts < 1:
        raise ConfigError(f"rollouts = {rollouts}: must be at least 1")
    vec = make_vec(
        env,
        num_envs=rollouts,
        agents=agents,
        seed=seed,
        autoreset_mode="NextStep",
        overrides=overrides,
    )
    with closing(vec):
        log = _log_of(vec)
        step_s, own_s = log.scene.step_s, vec.config.clock.ctrl_dt_s
        if abs(step_s - own_s) > 1e-6:
            raise ConfigError(
                f"clock.ctrl_dt_s = {own_s:g}: must be {step_s:g}, the time between two samples of "
                "the scene"
            )
        steps = min(log.scene.num_times - 1 - log.first, vec.config.max_steps)
        driven = [*log.seated, *(one.track for one in log.reacting)]
        tracks = [*driven, *log.replayed]
        poses, valid = _roll(vec, log, driver, seed, steps, told)
    return _compared(
        RealismSetup(log, tracks, len(driven), steps), poses, valid, driver=driver, seed=seed
    )


@dataclass(frozen=True)
class RealismSetup:
    """The compared tracks (the first `evaluated` ones) and steps."""

    log: LoggedTraffic
    tracks: list[Track]
    evaluated: int
    steps: int


def _log_of(vec: CavVectorEnv) -> LoggedTraffic:
    scene = vec.simulation.scene
    if scene is None or scene.log is None:
        raise ConfigError(
            f"scenario.name = {vec.config.scenario.name!r}: is not a logged scene; give a scene "
            "file (.pkl of ScenarioNet, .json of GPUDrive)"
        )
    return scene.log


def _roll(
    vec: CavVectorEnv,
    log: LoggedTraffic,
    driver: str,
    seed: int,
    steps: int,
    told: Callable[[int, int], None] | None,
) -> tuple[Numbers, NDArray[np.bool_]]:
    """Return poses (W, N, steps, 3) and presence (W, N, steps) of all tracks in all worlds."""
    num_seats, num_driven = len(log.seated), len(log.seated) + len(log.reacting)
    count = num_driven + len(log.replayed)
    poses = np.zeros((vec.num_envs, count, steps, 3))
    valid = np.zeros((vec.num_envs, count, steps), dtype=np.bool_)
    policy = load_policy(driver, vec)
    observations, infos = vec.reset(seed=seed)
    policy.reset(seed)
    mask = infos["mask"]
    is_over = np.zeros(vec.num_envs, dtype=np.bool_)
    first_slot = vec.config.population.external
    for step in range(steps):
        results = vec.step(policy.act_batch(observations, mask))
        observations, mask = results[0], results[4]["mask"]
        for w in np.flatnonzero(~is_over).tolist():
            rows = vec.simulation.vehicles(w)
            place = np.where(rows["agent"] >= 0, rows["agent"], num_seats + rows["order"])
            is_posed = rows["driver"] == DRIVER_EXTERNAL
            place = np.where(is_posed, num_driven + rows["order"] - first_slot, place)
            for axis, name in enumerate(("x", "y", "heading")):
                poses[w, place, step, axis] = rows[name]
            valid[w, place, step] = True
        is_over |= results[4]["episode_over"]
        if told is not None:
            told(step + 1, steps)
    return poses, valid


def _compared(
    setup: RealismSetup, poses: Numbers, valid: NDArray[np.bool_], *, driver: str, seed: int
) -> RealismRun:
    """Return the realism of recorded rollouts."""
    log, evaluated = setup.log, setup.evaluated
    end = log.first + 1 + setup.steps
    logged = Trajectories(
        np.stack([track.poses[:end] for track in setup.tracks]),
        np.stack([track.valid[:end] for track in setup.tracks]),
        np.array([track.size_m[:2] for track in setup.tracks]),
    )
    past = log.first + 1
    edges, step_s = log.scene.road_edges, log.scene.step_s
    features = []
    for own, there in zip(poses, valid, strict=True):
        joined = Trajectories(
            np.concatenate([logged.poses[:, :past], own], axis=1),
            np.concatenate([logged.valid[:, :past], there], axis=1),
            logged.sizes_m,
        )
        features.append(features_of(joined, evaluated, edges, step_s))
    realism = realism_of(features_of(logged, evaluated, edges, step_s), features, past)
    seen = logged.valid[:evaluated, past:]
    both = valid[:, :evaluated] & seen
    apart = poses[:, :evaluated, :, :2] - logged.poses[:evaluated, past:, :2]
    error = np.sqrt(apart[..., 0] * apart[..., 0] + apart[..., 1] * apart[..., 1])
    ade = (error * both).sum(axis=2) / np.maximum(both.sum(axis=2), 1)
    counted = both.any(axis=2)
    per_rollout = (ade * counted).sum(axis=1) / np.maximum(counted.sum(axis=1), 1)
    missing = 1.0 - both.sum() / max(seen.sum() * len(valid), 1)
    return RealismRun(
        scene=log.scene.name,
        driver=driver,
        rollouts=len(valid),
        seed=seed,
        steps=setup.steps,
        evaluated=evaluated,
        replayed=len(log.replayed),
        missing_percent=float(100.0 * missing),
        ade_m=float(per_rollout.mean()),
        min_ade_m=float(per_rollout.min()),
        realism=realism,
    )
