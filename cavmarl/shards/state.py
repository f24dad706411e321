"""The table of arrays that are the state of worlds, because they outlive a tick.

Code that saves, moves or digests worlds takes the arrays from this table. The state also includes
the owned rows, the arrays of rerouting, and the arrays of components (`Component.arrays`).
"""

from __future__ import annotations

from collections.abc import Iterator
from enum import Enum, auto
from functools import cache
from typing import Any, NamedTuple

from numpy.typing import NDArray

from cavmarl.core.records.arrays import DepartureQueue, Outputs, SharedState


class Use(Enum):
    """The uses of an array of the state."""

    SAVED = auto()  # stored in checkpoints, and sent with a world that moves to another worker
    DIGESTED = auto()  # part of the hash of a world's state


S, D = Use.SAVED, Use.DIGESTED


class StateArray(NamedTuple):
    """An array of the state and its uses."""

    bundle: type[tuple[Any, ...]]  # the class that has the array
    name: str
    uses: tuple[Use, ...]
    place: int = 0  # position in the digest


STATE = (
    StateArray(SharedState, "ticks", (S, D), 4),
    StateArray(SharedState, "keys", (S, D), 5),
    StateArray(SharedState, "signal_phase", (S, D), 1),
    StateArray(SharedState, "controllers", (S, D), 2),
    StateArray(SharedState, "detected_s", (S, D), 3),
    StateArray(SharedState, "pending", (S,)),  # digested agent by agent
    StateArray(SharedState, "cues", (S, D), 6),
    StateArray(DepartureQueue, "next_order", (S, D), 8),
    StateArray(DepartureQueue, "num_queue", (S,)),
    StateArray(DepartureQueue, "next_id", (S, D), 7),
    StateArray(DepartureQueue, "num_entered", (S, D), 9),
    StateArray(DepartureQueue, "counts", (S,)),
    StateArray(DepartureQueue, "sums", (S,)),
    StateArray(Outputs, "observations", (S,)),  # saved if observations contain earlier frames
    StateArray(Outputs, "terms", (S,)),
    StateArray(Outputs, "rewards", (S,)),
    StateArray(Outputs, "terminated", (S,)),
    StateArray(Outputs, "present", (S,)),
    StateArray(Outputs, "acted", (S,)),
    StateArray(Outputs, "events", (S,)),
    StateArray(Outputs, "vehicle_ids", (S,)),
)


@cache
def names_of(bundle: type[tuple[Any, ...]], use: Use) -> tuple[str, ...]:
    """Return the names of a bundle's arrays with a use; DIGESTED: in the order of `place`."""
    kept = (entry for entry in STATE if entry.bundle is bundle and use in entry.uses)
    return tuple(entry.name for entry in sorted(kept, key=lambda entry: entry.place * (use is D)))


def arrays_of(source: Any, bundle: type[tuple[Any, ...]], use: Use) -> Iterator[NDArray[Any]]:
    """Return the arrays that `names_of` names. `source`: a bundle; for `SharedState`, `Worlds`."""
    return (getattr(source, name) for name in names_of(bundle, use))
