"""`CheckpointLog`: an occasional image of worlds, and the commands of the steps after it.

Writing an image takes a tenth of the time of a step. If several workers run a world of ten thousand
vehicles together, it takes half the time of a tick. The state and the commands determine a step, so
a successor may resume from an older image and repeat the steps after it.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from cavmarl.config.env import EnvConfig
from cavmarl.core.records.external_records import EXTERNAL_FIELDS
from cavmarl.parallel.memory.shared_memory import Layout, Segment, arrays_in, size_of
from cavmarl.parallel.state.state_image import Arrays, Image
from cavmarl.parallel.state.sumo_log import FIRST_LOG_BYTES, KeptLog
from cavmarl.shards.shard import COMMANDS, Commands
from cavmarl.traffic.sumo.sumo_history import ToldLog

STEPS = 16  # limit on the steps from one image to the next, which a successor has to repeat
_FIRST_IMAGE_BYTES = 1 << 12


def make_segments(config: EnvConfig, num_worlds: int, num_signals: int) -> list[Segment]:
    """Make the memory of a checkpoint log, which outlives the writers of the log.

    Raises:
        WorkerError: there is not enough memory.
    """
    images = [Segment.make(_FIRST_IMAGE_BYTES) for _ in range(2)]
    steps = Segment.make(size_of(_layout(config, num_worlds, num_signals)))
    num_logs = num_worlds if config.tells_sumo else 0
    return [*images, steps, *(Segment.make(FIRST_LOG_BYTES) for _ in range(2 * num_logs))]


class CheckpointLog:
    """The state of worlds between two commands: an image, and the steps after it.

    There are two images, each with room for the steps after it. While one image is written, the
    committed state starts with the other image. Beside each image is a copy of the SUMO logs.

    Attributes:
        place: (2,) number of the image, and number of steps after it; part of the committed state.
        entries: buffers for the commands of the steps after the first and after the second image.
    """

    def __init__(
        self, config: EnvConfig, num_worlds: int, num_signals: int, descriptors: list[int]
    ) -> None:
        *images, steps = (Segment(fd, 0) for fd in descriptors[:3])
        self.place = np.zeros(2, dtype=np.int64)
        self.is_prepared = False  # whether the other image has the state at the end of the log
        self._images = [Image(segment) for segment in images]
        kept = [KeptLog(Segment(fd, 0)) for fd in descriptors[3:]]
        self._logs = kept[::2], kept[1::2]  # logs for each image, by world
        arrays = arrays_in(steps.map(), _layout(config, num_worlds, num_signals))
        self.entries = tuple(map(Commands, *(arrays[name] for name in COMMANDS)))

    def __len__(self) -> int:
        return self.place.item(1)

    @property
    def is_full(self) -> bool:
        """True if there is no room for another step."""
        return len(self) == STEPS

    def note(self, commands: Commands) -> None:
        """Add the commands of a step."""
        entry = self.entries[self.place.item(0) * STEPS + len(self)]
        for name in COMMANDS:
            getattr(entry, name)[...] = getattr(commands, name)
        self.place[1] += 1
        self.is_prepared = False

    def prepare(self, state: Arrays, logs: Sequence[ToldLog] = ()) -> None:
        """Write the current state to the other image, with which the log can restart."""
        image = 1 - self.place.item(0)
        self._images[image].write(state)
        for kept, log in zip(self._logs[image], logs, strict=True):
            kept.write(log)
        self.is_prepared = True

    def begin(self) -> None:
        """Restart with the prepared image."""
        self.place[:] = 1 - self.place.item(0), 0
        self.is_prepared = False

    def go_to(self, place: NDArray[np.int64]) -> None:
        """Return to an earlier `place`."""
        self.place[:] = place
        self.is_prepared = False

    def state(self, like: Arrays) -> Arrays:
        """Return the state of the image, with the dtypes of `like`.

        Raises:
            WorkerError: the image is damaged.
        """
        dtypes = [array.dtype for array in like]
        return list(self._images[self.place.item(0)].read(dtypes))

    def read_logs(self, logs: Sequence[ToldLog]) -> None:
        """Restore the SUMO logs that belong to the image.

        Raises:
            WorkerError: a log is damaged.
        """
        for kept, log in zip(self._logs[self.place.item(0)], logs, strict=True):
            log.take_up(kept.read())

    def steps(self) -> tuple[Commands, ...]:
        """Return the commands of the steps after the image."""
        first = self.place.item(0) * STEPS
        return self.entries[first : first + len(self)]


def _layout(config: EnvConfig, num_worlds: int, num_signals: int) -> Layout:
    worlds: tuple[int, ...] = (2 * STEPS, num_worlds)
    agents = (*worlds, config.population.num_ids)
    inserted = (*worlds, config.population.insertions, 3)
    external = (*worlds, config.population.external, EXTERNAL_FIELDS)
    overridden = (*worlds, config.signals.overrides, 2)
    kinds = (
        ("<f8", (*agents, 2)),
        ("<i8", agents),
        ("<i4", agents),
        ("<f8", inserted),
        ("<f8", external),
        ("<i4", overridden),
        ("<f8", (*worlds, config.map.changed_lanes, 3)),
        ("<i8", (*worlds, num_signals)),
    )
    return dict(zip(COMMANDS, kinds, strict=True))
