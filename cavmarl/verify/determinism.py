"""Check that the same scenario gives the same bits in three fresh interpreters, step by step.

The interpreters have different `PYTHONHASHSEED` and run at the same time, while a fourth process
keeps a processor busy. Their hashes are compared after each step. At the first difference, the
interpreters stop and save their states. So even a difference that cannot be reproduced is found.
"""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Unpack

import numpy as np

from cavmarl.config.checks import check_count
from cavmarl.config.world_spec import WorldKeys, WorldSpec
from cavmarl.core.errors import EvaluationError
from cavmarl.core.processes import start_dying_with_process, start_python
from cavmarl.evaluate.subprocess_calls import told_error
from cavmarl.verify.differences import Arrays, Difference, find_difference

HASH_SEEDS = ("0", "1", "4294967295")  # hash seeds of the three processes
MAX_STEPS = 10_000_000


@dataclass(frozen=True)
class FirstDifference(Difference):
    """The first difference of two processes."""

    processes: tuple[int, int]  # indices of the two processes; `tick` is that of the first one


@dataclass(frozen=True)
class Determinism:
    """The result of `verify_determinism`."""

    steps: int  # number of compared steps
    ticks: int  # ticks of the world at the end
    hash_seeds: tuple[str, ...]  # `PYTHONHASHSEED` of the processes
    state_hash: str  # hash of the first process at the end
    difference: FirstDifference | None  # None if all processes were equal


def verify_determinism(
    env: str | Path | WorldSpec,
    policy: str | Path = "idm",
    *,
    steps: int = 600,
    progress: Callable[[int, int], None] | None = None,
    **keys: Unpack[WorldKeys],
) -> Determinism:
    """Drive one world in three processes and compare everything after each step.

    Args:
        env: see `make_vec`, also for the other keywords; `seed` also seeds the policy.
        policy: as in `load_policy`.
        steps: number of steps; episodes follow one another.
        progress: called after each step with its number and `steps`.
        keys: settings of the world.

    Raises:
        ConfigError: a number or a key is invalid.
        PolicyError: the policy cannot be loaded or does not fit.
        EvaluationError: a process died.
    """
    spec = WorldSpec.of(env, **keys)
    check_count("steps", steps, MAX_STEPS)
    job = {"spec": asdict(spec), "policy": str(policy), "steps": steps}
    with ExitStack() as stack:
        room = Path(stack.enter_context(TemporaryDirectory()))
        programs = [stack.enter_context(_Program(job, HASH_SEEDS[0]))]
        # If kernels must be compiled, one process compiles them for all.
        programs[0].wait_for_line()
        stack.enter_context(_load_beside())
        programs += [stack.enter_context(_Program(job, key)) for key in HASH_SEEDS[1:]]
        for step in range(steps + 1):
            lines = [program.read() for program in programs]
            odd = next((k for k, line in enumerate(lines) if line != lines[0]), None)
            if odd is not None or step == steps:
                break
            for program in programs:
                program.write("")
            if progress is not None:
                progress(step, steps)
        difference = None
        if odd is not None:
            states = [programs[k].dump(room / f"{k}.npz") for k in (0, odd)]
            found = find_difference(step, lines[0]["tick"], *states)
            difference = FirstDifference(**vars(found), processes=(0, odd))
        return Determinism(step, lines[0]["tick"], HASH_SEEDS, lines[0]["state"], difference)


class _Program:
    """A process that runs a job of `lockstep`; as a context manager, it ends the process."""

    def __init__(self, job: dict[str, Any], hash_seed: str) -> None:
        self._hash_seed = hash_seed
        self._line = ""
        self._process = start_python(
            ["-m", "cavmarl.verify.lockstep"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env={"PYTHONHASHSEED": hash_seed},
        )
        self.write(json.dumps(job))

    def __enter__(self) -> _Program:
        return self

    def __exit__(self, *_: object) -> None:
        self._process.kill()
        self._process.communicate()

    def write(self, line: str) -> None:
        assert self._process.stdin is not None
        try:
            self._process.stdin.write(f"{line}\n")
            self._process.stdin.flush()
        except BrokenPipeError as error:
            raise self._died() from error

    def wait_for_line(self) -> None:
        """Wait for the next line, which `read` then returns."""
        assert self._process.stdout is not None
        self._line = self._process.stdout.readline()
        if not self._line:
            raise self._died()

    def read(self) -> dict[str, Any]:
        if not self._line:
            self.wait_for_line()
        line, self._line = self._line, ""
        content: dict[str, Any] = json.loads(line)
        if "error" in content:
            raise told_error(content["error"], content["message"])
        return content

    def dump(self, path: Path) -> Arrays:
        self.write(str(path))
        self.read()
        with np.load(path) as arrays:
            return dict(arrays)

    def _died(self) -> EvaluationError:
        return EvaluationError(
            f"the process with PYTHONHASHSEED={self._hash_seed} ended with exit code "
            f"{self._process.wait()}; see its own message above"
        )


@contextmanager
def _load_beside() -> Iterator[None]:
    """Keep a processor busy with an unrelated process."""
    busy = start_dying_with_process([sys.executable, "-c", "while True: pass"])
    try:
        yield
    finally:
        busy.kill()
        busy.wait()
