"""`SceneArrays`: the memory that a process of worlds and its sensor workers share.

The process writes what there is to see and which worker is to sense what, before it sends a
command; the workers write frames, and say here of which tick they are.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cavmarl.driving.vehicles import VEHICLE
from cavmarl.parallel.memory.shared_memory import Layout, Segment, arrays_in
from cavmarl.sensors.kernels.rig_frames import POSE, Due

NEVER = -1  # a tick that there is not


class SceneShape(NamedTuple):
    """How large it is."""

    worlds: int  # W
    capacity: int  # C, rows of a world
    agents: int
    signals: int
    sensors: int  # S, of the rig
    workers: int  # n

    @property
    def layout(self) -> Layout:
        w, c, a, signals, s, n = self
        return {
            "rows": ("|u1", (w, c, VEHICLE.itemsize)),
            "num_agents": ("<i8", (w,)),
            "num_rows": ("<i8", (w,)),
            "ticks": ("<i8", (w,)),
            "keys": ("<u8", (w,)),
            "signal_phase": ("<i4", (w, signals)),
            "before": ("|u1", (w, a, POSE.itemsize)),
            "due": ("<i8", (s, len(Due._fields), w)),
            "lines": ("<i4", (n, s, w, a, 2)),
            "delivered": ("<i8", (n, s, w)),
            "spent_s": ("<f8", (n, s)),
            "busy_s": ("<f8", (n,)),
        }


class SceneArrays(NamedTuple):
    """What there is to see in one tick, the workers' shares, and what has been delivered."""

    rows: NDArray[np.void]  # VEHICLE (W, C) of all zones: agents' vehicles before the others
    num_agents: NDArray[np.int64]  # (W,) rows of agents
    num_rows: NDArray[np.int64]  # (W,) rows
    ticks: NDArray[np.int64]  # (W,) since the reset
    keys: NDArray[np.uint64]  # (W,) see `Worlds`
    signal_phase: NDArray[np.int32]  # (W, num_signals) see `Worlds`
    before: NDArray[np.void]  # POSE (W, A) of the tick before
    due: NDArray[np.int64]  # (S, 3, W) each sensor's `Due`
    lines: NDArray[np.int32]  # (n, S, W, A, 2) [first, last) that a worker writes of each frame
    delivered: NDArray[np.int64]  # (n, S, W) tick of the frames that a worker has written
    spent_s: NDArray[np.float64]  # (n, S) processor time that it took for each that was due
    busy_s: NDArray[np.float64]  # (n,) time that it took for all

    @classmethod
    def of(cls, segment: Segment, shape: SceneShape) -> SceneArrays:
        """Those in a segment of `size_of(shape.layout)` bytes."""
        arrays: dict[str, NDArray[Any]] = arrays_in(segment.map(), shape.layout)
        for name, record in (("rows", VEHICLE), ("before", POSE)):
            arrays[name] = arrays[name].view(record)[..., 0]
        return cls(**arrays)

    def due_of(self, sensor: int) -> Due:
        return Due(*self.due[sensor])
