"""The program that `cavmarl verify determinism` starts three times: it steps one world on demand.

Standard input has a job as one line of JSON, then one line per step: an empty line to continue, or
the path of a file in which to save the state before the program ends. Standard output has the
hashes after each step.
"""

from __future__ import annotations

import hashlib
import json
import sys
from collections.abc import Iterator
from typing import Any

import numpy as np

from cavmarl.config.world_spec import WorldSpec
from cavmarl.core import errors
from cavmarl.core.tracebacks import print_traceback
from cavmarl.engine.world_setup import load_world
from cavmarl.env.vector import CavVectorEnv
from cavmarl.parallel.worlds.local_worlds import LocalWorlds
from cavmarl.verify.differences import Arrays, DrivenRun, single_arrays, snapshot


def main() -> None:
    """Run the job that standard input describes."""
    job = json.loads(sys.stdin.readline())
    try:
        for line in _steps(job):
            print(json.dumps(line), flush=True)
    except errors.CavmarlError as error:
        print(json.dumps({"error": type(error).__name__, "message": str(error)}), flush=True)
    except Exception as error:
        print_traceback(error)
        sys.exit(1)


def _steps(job: dict[str, Any]) -> Iterator[dict[str, Any]]:
    """Yield a line for the reset and for each step, until a dump is requested."""
    spec = WorldSpec(**job["spec"])
    vec = CavVectorEnv(LocalWorlds(load_world(spec.env, **spec.keywords), 1))
    run = DrivenRun(vec, job["policy"], spec.seed)
    for step in range(job["steps"] + 1):
        yield {
            "step": step,
            "tick": int(vec.simulation.ticks()[0]),
            "state": vec.state_hash(),
            "seen": _digest(run.results),
        }
        path = sys.stdin.readline().strip()
        if path:
            arrays: dict[str, Any] = snapshot(vec, run.results)
            np.savez(path, **arrays)
            yield {"dumped": path}
            return
        run.step()


def _digest(arrays: Arrays) -> str:
    digest = hashlib.blake2b(digest_size=16)
    for _, array in single_arrays(arrays):
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()


if __name__ == "__main__":
    main()
