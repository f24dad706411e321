"""The state of worlds: which arrays outlive a tick, and which part keeps which, in one table.

What saves, moves, commits or digests worlds takes its arrays from here. Beside these there
are the owned rows, the arrays of rerouting, and those of attached parts (`Attached.arrays`).
"""

from __future__ import annotations

from collections.abc import Iterator
from enum import Enum, auto
from functools import cache
from typing import Any, NamedTuple

from numpy.typing import NDArray

from cavmarl.core.records.arrays import Common, Gate, Outputs, Zoned


class Use(Enum):
    """What is done with an array of the state."""

    SAVED = auto()  # in checkpoints, and with a world that changes its worker
    COMMITTED = auto()  # in the store from which a tick is begun again
    DIGESTED = auto()  # in the hash of a world's state


S, C, D = Use.SAVED, Use.COMMITTED, Use.DIGESTED


class StateArray(NamedTuple):
    """An array, and what is done with it."""

    bundle: type[tuple[Any, ...]]
    name: str
    uses: tuple[Use, ...]
    place: int = 0  # in the digest


STATE = (
    StateArray(Common, "ticks", (S, C, D), 4),
    StateArray(Common, "keys", (S, C, D), 5),
    StateArray(Common, "signal_phase", (S, C, D), 1),
    StateArray(Common, "controllers", (S, C, D), 2),
    StateArray(Common, "detected_s", (S, C, D), 3),
    StateArray(Common, "pending", (S, C)),  # digested agent by agent
    StateArray(Common, "cues", (S, C, D), 6),
    StateArray(Zoned, "num_owned", (C,)),
    StateArray(Zoned, "num_rows", (C,)),
    StateArray(Zoned, "num_through", (C,)),
    StateArray(Zoned, "num_touching", (C,)),
    StateArray(Zoned, "num_contacts", (C,)),  # saved as the sum of all zones
    StateArray(Gate, "next_order", (S, C, D), 8),
    StateArray(Gate, "queue", (C,)),  # saved and digested as far as vehicles wait
    StateArray(Gate, "num_queue", (S, C)),
    StateArray(Gate, "next_id", (S, C, D), 7),
    StateArray(Gate, "num_entered", (S, C, D), 9),
    StateArray(Gate, "counts", (S, C)),
    StateArray(Gate, "sums", (S, C)),
    StateArray(Gate, "num_passing", (C,)),  # between two steps no vehicle is passing the gate
    StateArray(Gate, "lane_taken", (C,)),
    StateArray(Outputs, "observations", (S, C)),  # saved where an observation has earlier frames
    StateArray(Outputs, "terms", (S, C)),
    StateArray(Outputs, "rewards", (S, C)),
    StateArray(Outputs, "terminated", (S, C)),
    StateArray(Outputs, "present", (S, C)),
    StateArray(Outputs, "acted", (S, C)),
    StateArray(Outputs, "events", (S, C)),
    StateArray(Outputs, "vehicle_ids", (S, C)),
    StateArray(Outputs, "places", (C,)),  # written before each use
)


@cache
def names_of(bundle: type[tuple[Any, ...]], use: Use) -> tuple[str, ...]:
    """The fields of a bundle that are put to a use, in the order of the table or the digest."""
    kept = (entry for entry in STATE if entry.bundle is bundle and use in entry.uses)
    return tuple(entry.name for entry in sorted(kept, key=lambda entry: entry.place * (use is D)))


def arrays_of(source: Any, bundle: type[tuple[Any, ...]], use: Use) -> Iterator[NDArray[Any]]:
    """Those of an object with the fields of a bundle; all shards have those of `Common`."""
    return (getattr(source, name) for name in names_of(bundle, use))
