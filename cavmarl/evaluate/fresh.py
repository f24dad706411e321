"""Evaluates one run in a process of its own: the caller's side, and the program.

The program reads a job as JSON from standard input, tells its progress line by line on standard
output, and leaves arrays in a file. A run shares nothing with another but the files on disk.
"""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import asdict
from multiprocessing import get_context
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from cavmarl.core import errors
from cavmarl.evaluate.episodes import EpisodeJob, Progress, RunData, Speed, drive_run

Given = TypeVar("Given")
Found = TypeVar("Found")

PROGRAM = "from cavmarl.evaluate.fresh import main; main()"


def drive_in_fresh_process(
    job: EpisodeJob, folder: Path, progress: Progress | None = None
) -> dict[str, RunData]:
    """`drive_run` in a new interpreter.

    Args:
        job: what to drive.
        folder: for its file, which is gone again afterwards.
        progress: as in `drive_run`.

    Raises:
        CavmarlError: what `drive_run` raises there, and a process that died.
    """
    path = folder / f"run_{job.run}.npz"
    program = subprocess.Popen(
        [sys.executable, "-c", PROGRAM, str(path)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    assert program.stdin is not None
    assert program.stdout is not None
    with program:
        program.stdin.write(json.dumps(job.to_dict()))
        program.stdin.close()
        for line in program.stdout:
            told = json.loads(line)
            if "error" in told:
                raise told_error(told["error"], told["message"])
            if progress is not None:
                progress(told["policy"], told["steps"], told["most"])
    if program.returncode:
        raise errors.EvaluationError(
            f"run {job.run} (seed {job.seed}) ended with exit code {program.returncode}; "
            "its own message is above"
        )
    try:
        return _read(path, list(job.policies))
    finally:
        path.unlink()


@contextmanager
def fresh_process(died: errors.CavmarlError) -> Iterator[ProcessPoolExecutor]:
    """A process of its own; what is submitted runs there. `died` is raised if it ends by itself."""
    with ProcessPoolExecutor(1, get_context("spawn")) as process:
        try:
            yield process
        except BrokenProcessPool as error:
            raise died from error


def call_in_fresh_process(
    call: Callable[[Given], Found], given: Given, died: errors.CavmarlError
) -> Found:
    """Call a function in a process of its own; errors that it raises on purpose are raised here."""
    with fresh_process(died) as process:
        found, error = process.submit(_call, call, given).result()
    if error is not None:
        raise told_error(*error)
    result: Found = found
    return result


def _call(call: Callable[[Given], Found], given: Given) -> tuple[Any, tuple[str, str] | None]:
    try:
        return call(given), None
    except errors.CavmarlError as error:
        return None, (type(error).__name__, str(error))


def told_error(kind: str, message: str) -> errors.CavmarlError:
    """The error of another process; what it was made of, beside its words, has stayed there."""
    found: type[errors.CavmarlError] = getattr(errors, kind)
    return found.__new__(found, message)


def _read(path: Path, policies: list[str]) -> dict[str, RunData]:
    with np.load(path) as arrays:
        return {
            name: RunData(
                arrays[f"trips_{k}"],
                arrays[f"episodes_{k}"],
                arrays[f"tracks_{k}"],
                Speed(**json.loads(str(arrays[f"speed_{k}"]))),
                arrays[f"transfers_{k}"],
                json.loads(str(arrays[f"transfer_counts_{k}"])),
            )
            for k, name in enumerate(policies)
        }


def _write(path: Path, found: dict[str, RunData]) -> None:
    arrays: dict[str, Any] = {}
    for k, data in enumerate(found.values()):
        arrays[f"trips_{k}"] = data.trips
        arrays[f"episodes_{k}"] = data.episodes
        arrays[f"tracks_{k}"] = data.tracks
        arrays[f"speed_{k}"] = json.dumps(asdict(data.speed))
        arrays[f"transfers_{k}"] = data.transfers
        arrays[f"transfer_counts_{k}"] = json.dumps(data.transfer_counts)
    np.savez(path, **arrays)


def _tell(**what: Any) -> None:
    print(json.dumps(what), flush=True)


def main() -> None:
    """The program: a job from standard input."""
    job = EpisodeJob(**json.load(sys.stdin))
    try:
        found = drive_run(job, lambda name, k, n: _tell(policy=name, steps=k, most=n))
    except errors.CavmarlError as error:
        _tell(error=type(error).__name__, message=str(error))
        return
    _write(Path(sys.argv[1]), found)
