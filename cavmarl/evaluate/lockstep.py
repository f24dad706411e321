"""The program that `verify-determinism` starts three times: one world, a hash a step, on demand.

Standard input brings a job as one line of JSON, then one line a step: an empty one to go on, or the
path of a file to leave the state in before the end. Standard output tells the hashes of each step.
"""

from __future__ import annotations

import hashlib
import json
import sys
from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cavmarl import errors
from cavmarl.policies import load_policy
from cavmarl.vector_env import CavVectorEnv
from cavmarl.worlds import load_world

__all__: list[str] = []


def _main() -> None:
    job = json.loads(sys.stdin.readline())
    try:
        for told in _steps(job):
            print(json.dumps(told), flush=True)
    except errors.CavmarlError as error:
        print(json.dumps({"error": type(error).__name__, "message": str(error)}), flush=True)


def _steps(job: dict[str, Any]) -> Iterator[dict[str, Any]]:
    """Drive; what is told after the reset and after each step, until a dump is asked for."""
    config, network, demand, partition = load_world(job["env"], **job["world"])
    vec = CavVectorEnv(config, network, 1, demand, partition)
    driver = load_policy(job["policy"], vec)
    observations, infos = vec.reset(seed=job["seed"])
    driver.reset(job["seed"])
    results: list[NDArray[Any]] = [observations]
    for step in range(job["steps"] + 1):
        yield {
            "step": step,
            "tick": int(vec.simulation.ticks()[0]),
            "state": vec.state_hash(),
            "seen": _digest(results),
        }
        wanted = sys.stdin.readline().strip()
        if wanted:
            _dump(wanted, vec, results)
            return
        actions = driver.act_batch(observations, infos["mask"])
        observations, rewards, terminated, truncated, infos = vec.step(actions)
        results = [observations, rewards, terminated, truncated, infos["terms"], actions]


def _digest(arrays: list[NDArray[Any]]) -> str:
    digest = hashlib.blake2b(digest_size=16)
    for array in arrays:
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()


def _dump(path: str, vec: CavVectorEnv, results: list[NDArray[Any]]) -> None:
    """Leave everything that the hashes are made of."""
    vehicles = vec.simulation.vehicles()
    names = ("observations", "rewards", "terminations", "truncations", "terms", "actions")
    arrays: dict[str, Any] = {
        "vehicles": vehicles[np.argsort(vehicles["id"])],
        "signals": vec.simulation.signal_phases(),
        **dict(zip(names, results, strict=False)),  # after a reset there are observations alone
    }
    np.savez(path, **arrays)
    print(json.dumps({"dumped": path}), flush=True)


if __name__ == "__main__":
    _main()
