"""The rows of `bench step` with pufferlib's observation: ours beside the peer in C."""

from __future__ import annotations

import time
from functools import partial
from pathlib import Path

import numpy as np

from cavmarl.bench.drive_peer import PUFFER_DRIVE, DrivePeer, check_compiler, compile_peer
from cavmarl.bench.highway_worlds import overrides, straight_road
from cavmarl.bench.speed_rows import Runner
from cavmarl.env.vector import CavVectorEnv, make_vec

__all__ = ["check_compiler", "drive_world", "peer_runners"]

STEPS = 100  # from a fresh reset: nobody reaches the end of the road
STEP_S = 0.1  # the peer's; in one tick, as there

# How pufferlib is built, and the most that its compiler can do with exact arithmetic.
FLAGS = {"c": ("-O2",), "c_native": ("-O3", "-march=native")}


def drive_world(road: Path, agents: int, worlds: int, copy: bool) -> CavVectorEnv:
    """Ours, with that observation and nothing else.

    Args:
        road: of `straight_road`.
        agents: controlled vehicles a world.
        worlds: stepped together.
        copy: whether observations are copied; the peer's are not.
    """
    settings = {
        **overrides(PUFFER_DRIVE, agents),
        "clock.sim_dt_s": STEP_S,
        "clock.ctrl_dt_s": STEP_S,
        "action.kind": "continuous",
    }
    return make_vec(
        road, num_envs=worlds, agents=agents, background=0, copy=copy, overrides=settings
    )


def peer_runners(folder: Path, road_m: float, agents: int, worlds: int) -> list[Runner]:
    """Ours and the peer's, each with the same cars in the same places at first, which coast.

    Args:
        folder: for the road and the compiled peers.
        road_m: length of the road that the cars stand on.
        agents: controlled vehicles a world.
        worlds: stepped together, on both sides.

    Raises:
        EvaluationError: the peer cannot be compiled.
    """
    road = straight_road(folder, road_m)
    runners = []
    for who, copy in (("batched", False), ("copied", True)):
        vec = drive_world(road, agents, worlds, copy)
        _our_rate(vec, 2)
        runners.append(Runner("puffer_drive", who, agents, worlds, partial(_our_rate, vec)))
    vec.reset(seed=0)
    for who, flags in FLAGS.items():
        peer = DrivePeer(compile_peer(folder, flags), vec)
        _their_rate(peer, 2)
        runners.append(Runner("puffer_drive", who, agents, worlds, partial(_their_rate, peer)))
    return runners


def _our_rate(vec: CavVectorEnv, steps: int = STEPS) -> float:
    """Agent-steps a second from a fresh reset, which is not timed."""
    vec.reset(seed=0)
    actions = np.zeros((vec.num_envs, vec.num_agents, 2), dtype=np.float32)
    decisions = 0
    began = time.process_time()
    for _ in range(steps):
        decisions += int(vec.step(actions)[4]["acted"].sum())
    return decisions / (time.process_time() - began)


def _their_rate(peer: DrivePeer, steps: int = STEPS) -> float:
    peer.reset()
    began = time.process_time()
    for _ in range(steps):
        peer.step()
    return peer.num_cars * steps / (time.process_time() - began)
