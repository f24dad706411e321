"""`CheckpointLog`: an image of worlds now and then, and what their agents have done since.

An image takes a tenth of a step to write, and of ten thousand vehicles as long as half a tick that
several workers share. What a step does follows from the state and the actions, so a successor may
as well begin from an older image and go through the same steps again.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from cavmarl.config.env import EnvConfig
from cavmarl.parallel.memory.shared_memory import Layout, Segment, arrays_in, size_of
from cavmarl.parallel.state.state_image import Arrays, Image
from cavmarl.parallel.state.sumo_log import FIRST_LOG_BYTES, KeptLog
from cavmarl.shards.shard import COMMANDS, Commands
from cavmarl.traffic.sumo.sumo_history import ToldLog

STEPS = 16  # from one image to the next: a successor repeats that many at most
_FIRST_IMAGE_BYTES = 1 << 12


def make_segments(config: EnvConfig, num_worlds: int) -> list[Segment]:
    """Memory for the checkpoint log of some worlds, which outlives its writers.

    Raises:
        WorkerError: there is none.
    """
    images = [Segment.make(_FIRST_IMAGE_BYTES) for _ in range(2)]
    steps = Segment.make(size_of(_layout(config, num_worlds)))
    num_logs = num_worlds if config.traffic.source == "sumo-traffic" else 0
    return [*images, steps, *(Segment.make(FIRST_LOG_BYTES) for _ in range(2 * num_logs))]


class CheckpointLog:
    """What there is in it between two commands is the state of some worlds.

    There are two images, each with room for the steps after it: while one is written, the other one
    is what was committed begins with. What SUMOs were told is kept beside each of them.

    Attributes:
        place: (2,) which image it begins with, and how many steps follow; to be committed.
        entries: what the agents do in each of the steps that there is room for, of both images.
    """

    def __init__(self, config: EnvConfig, num_worlds: int, descriptors: list[int]) -> None:
        *images, steps = (Segment(fd, 0) for fd in descriptors[:3])
        self.place = np.zeros(2, dtype=np.int64)
        self.is_prepared = False  # the other image is that of the state at the end of the log
        self._images = [Image(segment) for segment in images]
        kept = [KeptLog(Segment(fd, 0)) for fd in descriptors[3:]]
        self._logs = kept[::2], kept[1::2]  # of each image, by world
        arrays = arrays_in(steps.map(), _layout(config, num_worlds))
        self.entries = tuple(map(Commands, *(arrays[name] for name in COMMANDS)))

    def __len__(self) -> int:
        return self.place.item(1)

    @property
    def is_full(self) -> bool:
        """Whether the next entry has to be an image."""
        return len(self) == STEPS

    def note(self, commands: Commands) -> None:
        """Write down what the agents do in one more step."""
        entry = self.entries[self.place.item(0) * STEPS + len(self)]
        for name in COMMANDS:
            getattr(entry, name)[...] = getattr(commands, name)
        self.place[1] += 1
        self.is_prepared = False

    def prepare(self, state: Arrays, logs: Sequence[ToldLog] = ()) -> None:
        """Write the image of the present state that it will begin anew with."""
        image = 1 - self.place.item(0)
        self._images[image].write(state)
        for kept, log in zip(self._logs[image], logs, strict=True):
            kept.write(log)
        self.is_prepared = True

    def begin(self) -> None:
        """Begin anew with the image that was prepared."""
        self.place[:] = 1 - self.place.item(0), 0
        self.is_prepared = False

    def go_to(self, place: NDArray[np.int64]) -> None:
        """Let it be what it was when that was its `place`."""
        self.place[:] = place
        self.is_prepared = False

    def state(self, like: Arrays) -> Arrays:
        """The state it begins with, in arrays of the same dtypes as those.

        Raises:
            WorkerError: it is not what was written.
        """
        dtypes = [array.dtype for array in like]
        return list(self._images[self.place.item(0)].read(dtypes))

    def read_logs(self, logs: Sequence[ToldLog]) -> None:
        """Let logs go on from what they were in that state.

        Raises:
            WorkerError: it is not what was written.
        """
        for kept, log in zip(self._logs[self.place.item(0)], logs, strict=True):
            log.take_up(kept.read())

    def steps(self) -> tuple[Commands, ...]:
        first = self.place.item(0) * STEPS
        return self.entries[first : first + len(self)]


def _layout(config: EnvConfig, num_worlds: int) -> Layout:
    worlds: tuple[int, ...] = (2 * STEPS, num_worlds)
    agents = (*worlds, config.population.num_ids)
    inserted = (*worlds, config.population.insertions, 3)
    kinds = (("<f8", (*agents, 2)), ("<i8", agents), ("<i4", agents), ("<f8", inserted))
    return dict(zip(COMMANDS, kinds, strict=True))
