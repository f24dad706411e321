"""A peer in C for `cavmarl bench step`: `drive_peer.c`, compiled by the system's compiler.

Both sides drive the same cars on the same road, and make the same observation of them.
"""

from __future__ import annotations

import ctypes
import os
import shutil
import subprocess
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.errors import EvaluationError
from cavmarl.core.records.codes import DRIVER_AGENT
from cavmarl.env.vector import CavVectorEnv
from cavmarl.sensors.observed.highway import goal_places
from cavmarl.sensors.observed.road_segments import drive_lines

__all__ = ["PUFFER_DRIVE", "DrivePeer", "check_compiler", "compile_peer"]

SOURCE = Path(__file__).with_name("drive_peer.c")
OBSERVATION = 1847
COASTING = (3, 6)  # no acceleration, no steering
FIRST_TYPE = 4  # of a line of the road, there

# What of our sensors makes the same observation: that one alone.
PUFFER_DRIVE: dict[str, object] = {
    "sensors.puffer_drive.enabled": True,
    "sensors.ego.enabled": False,
    "sensors.signal.enabled": False,
    "sensors.route.points": 0,
    "sensors.neighbors.count": 0,
    "sensors.lanes.range_m": 0.0,
    "sensors.lidar.rays": 0,
}


def check_compiler() -> str:
    """The system's C compiler: what `CC` names, or `cc`.

    Raises:
        EvaluationError: there is none.
    """
    name = os.environ.get("CC", "cc")
    found = shutil.which(name)
    if found is None:
        raise EvaluationError(f"no C compiler '{name}': install one, or name another in CC")
    return found


def compile_peer(folder: Path, flags: Sequence[str]) -> ctypes.CDLL:
    """Build `drive_peer.c` and load it.

    Args:
        folder: where the library is put.
        flags: of the compiler.

    Raises:
        EvaluationError: there is no C compiler, or it fails.
    """
    library = folder / f"drive_peer{''.join(flags)}.so"
    command = [check_compiler(), *flags, "-shared", "-fPIC", "-o", str(library), str(SOURCE), "-lm"]
    built = subprocess.run(command, capture_output=True, text=True, check=False)
    if built.returncode != 0:
        raise EvaluationError(f"{' '.join(command)}: {built.stderr.strip()}")
    peer = ctypes.CDLL(str(library))
    peer.drive_make.restype = ctypes.c_void_p
    return peer


class DrivePeer:
    """Worlds of the peer with the cars that stand in ours, on the same road.

    Args:
        peer: of `compile_peer`.
        vec: after a reset; its agents are the cars, in the order of their ids.
    """

    def __init__(self, peer: ctypes.CDLL, vec: CavVectorEnv) -> None:
        self._peer = peer
        lines, corner = drive_lines(vec.network, vec.config.sensors.puffer_drive.spacing_m)
        places = np.concatenate([line for line, _ in lines])
        road = (
            np.cumsum([0, *(len(line) for line, _ in lines)], dtype=np.int32),
            np.array([FIRST_TYPE + kind for _, kind in lines], dtype=np.int32),
            np.ascontiguousarray(places[:, 0]),
            np.ascontiguousarray(places[:, 1]),
        )
        cars = [_cars(vec, world, corner) for world in range(vec.num_envs)]
        self.num_cars = sum(len(rows) for rows in cars)
        self._worlds = (ctypes.c_void_p * vec.num_envs)(
            *(
                peer.drive_make(len(rows), _pointer(rows), len(lines), *map(_pointer, road))
                for rows in cars
            )
        )
        self._starts = np.cumsum([0, *(len(rows) for rows in cars)])
        self._actions = np.tile(np.array(COASTING, dtype=np.int32), (self.num_cars, 1))
        self._rewards = np.zeros(self.num_cars, dtype=np.float32)
        # As ours in shard.py: on huge pages.
        self.observations = np.full((self.num_cars, OBSERVATION), 0.0, dtype=np.float32)

    def reset(self) -> None:
        """Put all cars back to where they stood, and observe."""
        for world, start in zip(self._worlds, self._starts, strict=False):
            self._peer.drive_reset(ctypes.c_void_p(world), _pointer(self.observations[start:]))

    def step(self) -> None:
        """All cars coast for 0.1 s."""
        self._peer.drive_step_all(
            self._worlds,
            len(self._worlds),
            _pointer(self._actions),
            _pointer(self.observations),
            _pointer(self._rewards),
        )

    def close(self) -> None:
        """Give the memory back."""
        for world in self._worlds:
            self._peer.drive_free(ctypes.c_void_p(world))


def _pointer(array: NDArray[np.generic]) -> ctypes.c_void_p:
    return ctypes.c_void_p(array.ctypes.data)


def _cars(vec: CavVectorEnv, world: int, corner: tuple[float, float]) -> NDArray[np.float32]:
    """(A, 8) x, y, heading, speed, length, width, goal x, goal y; places from the map's corner."""
    rows = vec.simulation.vehicles(world)
    rows = rows[rows["driver"] == DRIVER_AGENT]
    rows = rows[np.argsort(rows["id"])]
    goals = goal_places(vec.network, vec.simulation.plans)[rows["goal"]]
    columns = [
        rows["x"] - corner[0],
        rows["y"] - corner[1],
        *(rows[name] for name in ("heading", "speed", "length", "width")),
        goals[:, 0] - corner[0],
        goals[:, 1] - corner[1],
    ]
    return np.stack(columns, axis=1).astype(np.float32)
