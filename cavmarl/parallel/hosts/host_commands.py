"""What hosts run, a command under way, and what is committed."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.errors import WorkerFailureError

Array = NDArray[Any]
Arrays = Sequence[Array]
Say = Callable[[int, bool], tuple[Any, Arrays]]
"""Part, whether its host knows what is committed → the payload to it, and its arrays."""


@dataclass(frozen=True)
class HostProgram:
    """What hosts run."""

    parts: tuple[str, ...]  # of the job, in words
    sizes: tuple[int, ...]  # of each part to begin with, as the job counts
    tasks: tuple[str, ...]  # names of the job's tasks
    noted: int  # the task whose inputs are noted, in the place of an image
    code: str  # what all machines have to have in common


@dataclass
class OpenOrder:
    """A command that is being carried out."""

    number: int  # of the order
    task: int
    say: Say  # what is said to each part
    outputs: Callable[[int, Any], Arrays]  # part, answer → arrays that what comes out is written to
    sizes: Sequence[int]  # of the parts once it has been carried out
    saves: bool  # an image is to come of each part
    ordered_s: float  # when it was given, by `time.monotonic`
    first_death: int  # how many hosts had died before
    pending: set[int]  # parts that have not carried it out
    is_void: bool = False  # it was interrupted, and only has to come to its end
    answers: dict[int, Any] = field(default_factory=dict)  # of the parts that have
    images: dict[int, Array] = field(default_factory=dict)  # of theirs
    failure: WorkerFailureError | None = None  # the exception of the first part that had one


@dataclass
class CommittedState:
    """What is committed of one part."""

    size: int  # of the part, as the job counts
    # (n,) bytes of an image of its state; none: it has not begun yet
    image: Array = field(default_factory=lambda: np.zeros(0, dtype=np.uint8))
    # (n,) bytes of the inputs of each command since
    since: list[Array] = field(default_factory=list)

    def after(self, order: OpenOrder, part: int) -> CommittedState:
        """What is committed of a part once a command has been carried out."""
        if order.saves:
            return CommittedState(order.sizes[part], order.images[part])
        return CommittedState(
            self.size, self.image, [*self.since, _bytes_of(order.say(part, True)[1])]
        )


def _bytes_of(arrays: Arrays) -> Array:
    """(n,) A copy of the bytes of arrays, one behind the other."""
    return np.concatenate(
        [np.zeros(0, dtype=np.uint8), *(array.reshape(-1).view(np.uint8) for array in arrays)]
    )
