"""A worker program for worlds in which nothing happens."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cavmarl.config.env import EnvConfig
from cavmarl.config.io import validate
from cavmarl.parallel.memory.shared_memory import Segment, arrays_in
from cavmarl.parallel.processes.worker_loop import Job, serve
from cavmarl.parallel.worlds.step_arrays import StepArrays, layout_of
from cavmarl.signals.signal_table import SignalSizes

__all__ = ["TrivialJob", "make_jobs"]


class TrivialJob(Job):
    """Worlds in which every agent observes the number of executed tasks.

    Args:
        arrays: arrays of these worlds.
    """

    def __init__(self, arrays: StepArrays) -> None:
        self._arrays = arrays
        self._tasks = np.zeros(1, dtype=np.int64)
        arrays.mask[:] = True
        arrays.acted[:] = True

    def perform(self, task: int, letter: Any) -> None:
        """Write the number of this task to all observations."""
        self._tasks += 1
        self._arrays.observations[:] = self._tasks[0]

    def save(self) -> list[NDArray[Any]]:
        """Return the number of executed tasks."""
        return [self._tasks]

    def load(self, saved: Sequence[NDArray[Any]]) -> None:
        """Restore the state returned by `save`."""
        self._tasks[:] = saved[0]


def make_jobs(message: Mapping[str, Any]) -> list[Job]:
    """Return the jobs of all workers."""
    config = validate(EnvConfig, message["config"], "the environment")
    layout = layout_of(config, message["capacity"], message["num_worlds"], SignalSizes())
    arrays = StepArrays.of(arrays_in(Segment(message["arrays"], 0).map(), layout))
    return [TrivialJob(arrays.part(first, last)) for first, last, _ in message["parts"]]


if __name__ == "__main__":
    serve(make_jobs)
