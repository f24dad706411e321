"""Frames of the snapshot stream: little-endian records, packed without padding.

A frame has a head that all streams share, a head of snapshots, and one record per actor. The last
54 bytes of a record depend on the type of the actor.
"""

from __future__ import annotations

import struct
import time
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cavmarl.cosim.carla.carla_geometry import CarlaPose

_FRAME_HEAD = struct.Struct("<QQd6f")
_SNAPSHOT_HEAD = struct.Struct("<Qdf3iI")
_MAP_CHANGED = 1  # bit of the flags of a snapshot
ACTIVE = 1  # state of an actor

_STATE_BYTES = 119
_SHARED_FIELDS: dict[str, tuple[Any, int]] = {
    "id": ("<u4", 0),
    "state": ("u1", 4),
    "place": ("<3f4", 5),
    "turn": ("<3f4", 17),
    "velocity": ("<3f4", 29),  # m/s
    "spin": ("<3f4", 41),  # deg/s
    "acceleration": ("<3f4", 53),  # m/s²
}


def _state(**own: tuple[Any, int]) -> np.dtype[np.void]:
    fields = _SHARED_FIELDS | own
    return np.dtype(
        {
            "names": list(fields),
            "formats": [form for form, _ in fields.values()],
            "offsets": [offset for _, offset in fields.values()],
            "itemsize": _STATE_BYTES,
        }
    )


ACTOR_STATE = _state()
VEHICLE_STATE = _state(
    throttle=("<f4", 65),
    steer=("<f4", 69),
    brake=("<f4", 73),
    hand_brake=("u1", 77),
    reverse=("u1", 78),
    manual_gear=("u1", 79),
    gear=("<i4", 80),
    speed_limit=("<f4", 84),  # km/h
    light_state=("u1", 88),
    is_at_light=("u1", 89),
    light=("<u4", 90),
    failure=("u1", 94),
)
WALKER_STATE = _state(direction=("<3f4", 65), speed=("<f4", 77), jump=("u1", 81))
LIGHT_STATE = _state(
    signal_id=("S32", 65),
    times_s=("<3f4", 97),  # green, yellow, red
    elapsed_s=("<f4", 109),
    pole=("<u4", 113),
    is_frozen=("u1", 117),
    light_state=("u1", 118),
)


def frame_head(kind: int, frame: int, time_s: float, pose: CarlaPose) -> bytes:
    """Return the head of a frame; `kind`: number of the sensor's kind in the client."""
    return _FRAME_HEAD.pack(kind, frame, time_s, *pose)


def snapshot_body(
    episode: int, delta_s: float, map_changed: bool, states: Sequence[NDArray[np.void]]
) -> bytes:
    """Return the body of a snapshot; `states`: arrays of the records above."""
    flags = _MAP_CHANGED if map_changed else 0
    head = _SNAPSHOT_HEAD.pack(episode, time.monotonic(), delta_s, 0, 0, 0, flags)
    return b"".join([head, *(one.tobytes() for one in states)])


def place_state(state: np.void, pose: CarlaPose) -> None:
    """Write a pose to a record."""
    state["place"] = pose[:3]
    state["turn"] = pose[3:]
