"""Recordings and clips of failed trips of a run."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cavmarl.engine.simulation import Simulation
from cavmarl.env.recorded_worlds import WorldRecorder
from cavmarl.env.vector import CavVectorEnv
from cavmarl.evaluate.failure_clips import Failure, FailureClips
from cavmarl.recordings.extra_tables import RecordOptions


class RunWatch:
    """Observes the worlds of one policy in one run, part by part.

    Args:
        vec: the worlds.
        standing: the worlds, or a copy of remote worlds.
        policy: name of the policy in the results.
        run: number of the run.
        seed: seed of the run.
        record: options of the recording; None: no recording.
        failures: number of failed trips to keep.
        look: called after each reset and step of the worlds.
    """

    def __init__(
        self,
        vec: CavVectorEnv,
        standing: Simulation,
        policy: str,
        run: int,
        seed: int,
        record: RecordOptions | None,
        failures: int,
        look: Callable[[], None] | None = None,
    ) -> None:
        self._vec = vec
        self._show = look
        self._first = 0
        about = {"policy": policy, "run": run, "seed": seed}
        self._writer = None
        if record is not None:
            self._writer = WorldRecorder(record, vec.worlds, standing, None, **about)
        observations = vec.worlds.arrays.observations
        self._clips = FailureClips(failures, vec.config, about, observations) if failures else None

    @property
    def failures(self) -> Sequence[Failure]:
        return () if self._clips is None else self._clips.failures

    def begin(self, first: int, running: NDArray[np.bool_]) -> None:
        """Observe the worlds after a reset; `first` is the episode of the first world."""
        self._first = first
        if self._clips is not None:
            self._clips.begin()
        self._look(running, None)

    def step(
        self,
        running: NDArray[np.bool_],
        over: NDArray[np.bool_],
        trips: NDArray[np.void],
        actions: NDArray[Any],
    ) -> None:
        """Observe a step.

        Args:
            running: (W,) worlds that were in their episode before the step.
            over: (W,) worlds whose episode ended in the step; they show the next episode already.
            trips: TRIP (n,) that ended in the step.
            actions: (W, A, …) of the step.
        """
        if self._clips is not None:
            self._clips.take(trips, self._first)
        self._look(running & ~over, actions)
        if self._writer is not None:
            self._writer.end(np.flatnonzero(running & over).tolist(), actions, self._first)

    def _look(self, chosen: NDArray[np.bool_], actions: NDArray[Any] | None) -> None:
        if self._show is not None:
            self._show()
        if self._writer is None and self._clips is None:
            return
        frames = self._vec.world_frames(np.flatnonzero(chosen).tolist(), ghosts=True)
        if self._clips is not None:
            self._clips.add(frames)
        if self._writer is not None:  # each world of the recording is an episode of the run
            self._writer.add(frames, actions, self._first)

    def close(self) -> None:
        """Close the recording, if there is one."""
        if self._writer is not None:
            self._writer.close()


def recording_path(
    record: RecordOptions | None, policy: str, run: int, is_only: bool
) -> RecordOptions | None:
    """Return the folder of one policy's run: the path itself if there is no other run."""
    if record is None or is_only:
        return record
    name = re.sub(r"[^\w.-]+", "_", policy).strip("._")
    return record.at(Path(record.path) / name / f"run-{run}")
