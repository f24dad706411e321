"""`HostedWorlds`: what a host does that runs some of the worlds for a caller elsewhere."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Sequence
from functools import cache, partial
from pathlib import Path
from typing import Any, NoReturn

import numba
import numpy as np
from numpy.typing import NDArray

from cavmarl.config import EnvConfig
from cavmarl.errors import WorkerStartError
from cavmarl.hosts.host import Outcome, serve
from cavmarl.rig.frames import Frames
from cavmarl.stepping.arrays import StepArrays
from cavmarl.stepping.job import Task, WorldsJob, fingerprint
from cavmarl.stepping.local import LocalWorlds
from cavmarl.worlds import make_world

__all__ = ["HostedWorlds", "code_stamp", "host_worlds", "inputs_of", "results_of"]

Array = NDArray[Any]

# Fields of `StepArrays` that every step writes.
_STEPPED = (
    "observations", "rewards", "terminations", "truncations", "acted", "vehicle_done", "mask",
    "vehicle_ids", "terms", "arrivals", "ticks", "episode_over",
)  # fmt: skip
# Those that a reset writes, of the worlds that it is about.
_BEGUN = ("observations", "mask", "vehicle_ids", "vehicle_done", "terms", "ticks", "episode_over")


def inputs_of(task: int, arrays: StepArrays) -> list[Array]:
    """What goes into a task, at both ends."""
    if task == Task.STEP:
        return [arrays.controls, arrays.meta_actions, arrays.declared]
    return [arrays.chosen] if task == Task.RESET else []


def results_of(task: int, arrays: StepArrays, ended: Sequence[int] | None) -> list[Array]:
    """What comes out of a task, at both ends.

    Args:
        task: the task.
        arrays: of the worlds that have done it.
        ended: worlds in which something ended; None: none.
    """
    if task == Task.STEP:
        finals = [arrays.final_observations, *_sensed(arrays.final_frames)]
        last = [array[w] for w in ended or () for array in finals]
        return [*(getattr(arrays, name) for name in _STEPPED), *_sensed(arrays.frames), *last]
    if task == Task.RESET:
        return [*(getattr(arrays, name) for name in _BEGUN), *_sensed(arrays.frames)]
    if task == Task.WRITE_STATES:
        return [arrays.states]
    return [arrays.suggested] if task == Task.SUGGEST else []


def _sensed(frames: Frames) -> Iterator[Array]:
    for sensor in frames.values():
        yield from sensor


@cache
def code_stamp() -> str:
    """What this machine runs: digest of all sources, and the libraries that compute."""
    package = Path(__file__).resolve().parents[1]
    digest = hashlib.sha256()
    for source in sorted(package.rglob("*.py")):
        name = source.relative_to(package).as_posix()
        if not name.startswith("data/"):  # which only a wheel has
            digest.update(name.encode() + b"\0" + source.read_bytes())
    sources = digest.hexdigest()[:12]
    return f"cavmarl of sources {sources}, numpy {np.__version__}, numba {numba.__version__}"


def host_worlds(recipe: str, place: tuple[str, int], secret: bytes, number: int) -> NoReturn:
    """The whole life of a process that hosts worlds; see `hosts.host.serve`.

    Args:
        recipe: what `remote.RemoteWorlds` writes.
        place: where it listens.
        secret: of its hosts.
        number: of this one.
    """
    serve(partial(HostedWorlds, json.loads(recipe)), place, secret, number)


class HostedWorlds:
    """Some of the worlds, next to each other; which ones, only their caller knows.

    Args:
        recipe: environment, and how many worlds there will be.

    Raises:
        WorkerStartError: this machine's files are not the caller's.
        CavmarlError: they cannot be read.
    """

    def __init__(self, recipe: dict[str, Any]) -> None:
        from cavmarl.config_io import validate  # pydantic is slow to import

        config = validate(EnvConfig, recipe["config"], "the environment")
        self._world = make_world(config, Path(recipe["base_dir"]))
        if fingerprint(self._world) != recipe["fingerprint"]:
            raise WorkerStartError(
                f"the files of '{config.name}' in {recipe['base_dir']} are not the caller's: copy "
                "them to all machines"
            )
        self._in_next_step: bool = recipe["in_next_step"]
        LocalWorlds(self._world, 1, warm=True)
        self._make(recipe["size"])

    @property
    def code(self) -> str:
        """What has to be the same on all machines for the same to come out."""
        return code_stamp()

    def fit(self, size: int) -> None:
        """Have that many worlds."""
        if size != len(self._worlds.arrays.mask):
            self._make(size)

    def inputs(self, task: int) -> list[Array]:
        """Arrays that an order of this task fills."""
        return inputs_of(task, self._worlds.arrays)

    def perform(self, task: int, letter: Any) -> Outcome:
        """Do a task; the answer to a step is in which worlds something ended."""
        arrays = self._worlds.arrays
        answer = self._job.perform(task, letter)
        if task == Task.STEP:
            ended = arrays.episode_over | arrays.terminations.any(axis=1)
            answer = np.flatnonzero(ended).tolist() or None
        return Outcome(answer, results_of(task, arrays, answer))

    def save(self) -> list[Array]:
        """All that the next task depends on."""
        begun = results_of(Task.RESET, self._worlds.arrays, None)
        return [*begun, *(log.words for log in self._logs), *self._worlds.save()]

    def load(self, saved: Sequence[Array]) -> None:
        """Go on from what `save` gave."""
        begun = results_of(Task.RESET, self._worlds.arrays, None)
        rest = iter(saved[len(begun) :])
        for log in self._logs:
            log.take_up(next(rest))
        self._worlds.load(list(rest))
        for array, kept in zip(begun, saved, strict=False):
            array[:] = kept

    def close(self) -> None:
        """End the processes that the worlds have."""
        self._worlds.close()

    def _make(self, size: int) -> None:
        self._worlds = LocalWorlds(self._world, size, in_next_step=self._in_next_step)
        self._logs = self._worlds.keep_logs()
        self._job = WorldsJob(self._worlds, 0)
        self._rehearse()

    def _rehearse(self) -> None:
        """Begin and step once: the first time takes longer, and is none of a death's business.

        Nothing of it stays, since whoever has these worlds begins with a seed, or loads.
        """
        self._worlds.arrays.chosen[:] = True
        self._job.perform(Task.RESET, {"seed": 0, "first_world": 0})
        self._job.perform(Task.STEP, None)
        self._job.perform(Task.SUGGEST, None)
        self.load([array.copy() for array in self.save()])
