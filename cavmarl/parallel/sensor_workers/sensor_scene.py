"""`SceneArrays`: the memory that a process with worlds shares with its sensor workers.

Before a command, the process writes the scene and the share of each worker. The workers write their
frames to `Frames`, and the tick of these frames to `delivered`.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cavmarl.driving.vehicles import VEHICLE
from cavmarl.parallel.memory.shared_memory import Layout, Segment, arrays_in
from cavmarl.sensors.kernels.rig_frames import NUM_COUNTS, POSE, Due

NEVER = -1  # no tick


class SceneShape(NamedTuple):
    """Sizes of the shared arrays."""

    worlds: int  # W
    capacity: int  # C, rows of a world
    agents: int
    signals: int  # columns of `signal_phase`
    sensors: int  # S, number of sensors of the rig
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
            "due": ("<i8", (s, NUM_COUNTS, w)),
            "lines": ("<i4", (n, s, w, a, 2)),
            "delivered": ("<i8", (n, s, w)),
            "spent_s": ("<f8", (n, s)),
            "busy_s": ("<f8", (n,)),
        }


class SceneArrays(NamedTuple):
    """The scene of one tick, the shares of the workers, and what they have delivered."""

    rows: NDArray[np.void]  # VEHICLE (W, C) of all zones, vehicles of agents first
    num_agents: NDArray[np.int64]  # (W,) number of rows of agents
    num_rows: NDArray[np.int64]  # (W,) number of rows
    ticks: NDArray[np.int64]  # (W,) ticks since the reset
    keys: NDArray[np.uint64]  # (W,) see `Worlds`
    signal_phase: NDArray[np.int32]  # (W, columns) see `Worlds`
    before: NDArray[np.void]  # POSE (W, A) in the previous tick
    due: NDArray[np.int64]  # (S, 3, W) each sensor's `Due`, without the carriers
    lines: NDArray[np.int32]  # (n, S, W, A, 2) lines [first, last) of each frame for each worker
    delivered: NDArray[np.int64]  # (n, S, W) tick of the last frames of each worker
    spent_s: NDArray[np.float64]  # (n, S) processor time of each worker for each sensor
    busy_s: NDArray[np.float64]  # (n,) time of each worker for all sensors

    @classmethod
    def of(cls, segment: Segment, shape: SceneShape) -> SceneArrays:
        """Return the arrays in a segment of `size_of(shape.layout)` bytes."""
        arrays: dict[str, NDArray[Any]] = arrays_in(segment.map(), shape.layout)
        for name, record in (("rows", VEHICLE), ("before", POSE)):
            arrays[name] = arrays[name].view(record)[..., 0]
        return cls(**arrays)

    def due_of(self, sensor: int, carriers: NDArray[np.bool_]) -> Due:
        num, first, slot = self.due[sensor]
        return Due(num, first, slot, carriers)
