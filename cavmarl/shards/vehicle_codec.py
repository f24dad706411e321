"""`TransferCodec`: encodes the complete state of one vehicle as bytes, without loss.

    4 bytes  "CVMV"      2 × 2 bytes  version, major and minor
    8 bytes  tick of the state          8 bytes  the vehicle's id
    8 bytes  digest of the record's layout
    3 × 4 bytes  lengths of the following parts: the record, its agent's delayed commands, the
                 frames that its agent's next observation repeats; the last two are 0 without an
                 agent

All numbers are little-endian. The map, the vehicle types and the table of routes are the same in
all processes of a world, so the record contains indices into them. The state has no readings of
sensors, which are taken again.

Reader and writer must have the same layout of the record. The header has a digest of the layout,
and a change of the layout needs a new major version (`RECORD_VERSION`). A minor version may append
data that no tick reads, after the frames. A reader skips unknown data and tolerates missing data,
so all minor versions can read each other.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Mapping
from hashlib import blake2b
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.errors import MessageError
from cavmarl.core.records.arrays import Outputs, Worlds
from cavmarl.core.records.codes import AUTHORITATIVE
from cavmarl.driving.vehicles import RECORD_VERSION

MAGIC = b"CVMV"
MINOR_VERSION = 0

# The groups of state that a transfer must carry, and the fields of VEHICLE in each group.
GROUPS: dict[str, tuple[str, ...]] = {
    group: tuple(fields.split())
    for group, fields in {
        "identity and ownership": "id agent order owner source_zone target_zone epoch",
        "kinematics": "x y z heading pitch speed accel yaw_rate jerk",
        "control and route": "throttle steering target_speed target_lane blinker "
        "lane side_lane s d link goal way leg stop stops_end to_go",
        "actor configuration": "driver vtype length width height sensor_phase",
        "synchronization": "tick departed due transfer",
        "agent logic": "rng_key speed_factor hold wait_s stopped_at stopped_s last_change hit "
        "events step_to_go step_jerk distance_m free_s episode_return lane_stood "
        "throttle_1 steering_1 speed_1 throttle_2 steering_2 speed_2",
    }.items()
}

_HEADER = struct.Struct("<4sHHqq8sIII")
_LONG = struct.Struct("<q")
_INT = struct.Struct("<i")


class TransferHeader(NamedTuple):
    """The header of a state; lengths are in bytes."""

    magic: bytes
    major: int
    minor: int
    tick: int
    vehicle: int
    layout: bytes
    record: int
    commands: int
    frames: int


class TransferCodec:
    """Packs and unpacks the vehicles of W worlds.

    Attributes:
        schema: a number in [0, 2^63); codecs with equal numbers can unpack each other's states.
    """

    def __init__(
        self,
        record: np.dtype[np.void],  # dtype of a vehicle's record
        # (W, A, …) float64, the delayed commands of agents: `Worlds.pending`
        commands: NDArray[np.float64],
        # (W, A, F) float32, the part of an agent's observation that its next observation repeats
        frames: NDArray[np.float32],
        # returns what is wrong with VEHICLE (1,), empty if nothing; None: no check
        check: Callable[[NDArray[np.void]], str] | None = None,
    ) -> None:
        self._check = check
        self._record = record
        text = layout_text(record)
        if sum(kind.itemsize for _, kind, _ in _fields(record)) != record.itemsize:
            raise MessageError(f"the record of a vehicle has padding: {text}")
        self._layout = blake2b(text.encode(), digest_size=8).digest()
        self._size = record.itemsize
        self._bytes = np.dtype((np.void, record.itemsize))
        self._commands, self._frames = commands, frames
        self._slots = commands.shape[:2]
        self._lengths = (
            record.itemsize,
            commands[0, :1].nbytes if commands.size else 0,
            frames[0, :1].nbytes if frames.size else 0,
        )
        at = {name: place for name, _, place in _fields(record)}
        self._id_at, self._agent_at, self._transfer_at = at["id"], at["agent"], at["transfer"]
        same = f"{RECORD_VERSION} {text} {self._lengths}".encode()
        self.schema = int.from_bytes(blake2b(same, digest_size=8).digest()) >> 1

    @classmethod
    def of(
        cls,
        worlds: Worlds,
        outputs: Outputs,
        carried_from: int,
        check: Callable[[NDArray[np.void]], str] | None = None,
    ) -> TransferCodec:
        """Return the codec of a shard's worlds; see `sensors.observed` for `carried_from`."""
        frames = outputs.observations[:, :, carried_from:]
        return cls(worlds.rows.dtype, worlds.pending, frames, check)

    def pack(
        self,
        rows: NDArray[np.void],  # VEHICLE (W, C)
        world: int,
        i: int,
        # tick of the state, as `unpack` expects it. `VEHICLE["tick"]` is lower by one if the
        # vehicle entered after the reset
        tick: int,
    ) -> bytes:
        """Return the state of a vehicle."""
        record: bytes = rows[world, i : i + 1].tobytes()
        (vehicle,) = _LONG.unpack_from(record, self._id_at)
        (agent,) = _INT.unpack_from(record, self._agent_at)
        before = (MAGIC, RECORD_VERSION, MINOR_VERSION, tick, vehicle, self._layout)
        if agent < 0:
            return _HEADER.pack(*before, self._size, 0, 0) + record
        commands, frames = self._commands[world, agent], self._frames[world, agent]
        header = _HEADER.pack(*before, *self._lengths)
        return b"".join((header, record, commands.tobytes(), frames.tobytes()))

    def unpack(
        self, data: bytes, vehicle: int, tick: int, rows: NDArray[np.void], world: int, i: int
    ) -> None:
        """Write a state to `rows[world, i]` and its agent's arrays; if refused, write nothing."""
        header = self.header(data)
        if (header.vehicle, header.tick) != (vehicle, tick):
            raise MessageError(
                f"the state is of vehicle {header.vehicle} at tick {header.tick}, not of the "
                f"expected vehicle {vehicle} at tick {tick}"
            )
        first = _HEADER.size
        end = first + self._size
        agent = self._check_record(header, data)
        if self._check is not None:
            wrong = self._check(np.frombuffer(data, self._record, 1, first))
            if wrong:
                raise MessageError(f"the state of vehicle {vehicle} is of another world: {wrong}")
        rows.view(self._bytes)[world, i] = data[first:end]
        if agent < 0:
            return
        commands, frames = self._commands[world, agent], self._frames[world, agent]
        room = commands.size
        commands[:] = np.frombuffer(data, commands.dtype, room, end).reshape(commands.shape)
        frames[:] = np.frombuffer(data, frames.dtype, frames.size, end + header.commands)

    def header(self, data: bytes) -> TransferHeader:
        """Return the header of a state, after checking the layout and the length of the state."""
        if len(data) < _HEADER.size:
            raise MessageError(
                f"a state of {len(data)} bytes is shorter than a header of {_HEADER.size} bytes"
            )
        header = TransferHeader._make(_HEADER.unpack_from(data))
        if header.magic != MAGIC:
            raise MessageError(f"a state begins with {MAGIC!r}, not with {header.magic!r}")
        if header.major != RECORD_VERSION:
            raise MessageError(
                f"the state has version {header.major}.{header.minor}, but this build reads "
                f"{RECORD_VERSION}.*; run the same version of cavmarl on all machines"
            )
        more = len(data) - _HEADER.size - header.record - header.commands - header.frames
        if more < 0 or (more > 0 and header.minor <= MINOR_VERSION):
            raise MessageError(
                f"a state has {len(data)} bytes, but {len(data) - more} according to its header"
            )
        if header.layout != self._layout or header.record != self._size:
            raise MessageError(
                f"the record has {header.record} bytes and layout {header.layout.hex()}, but here "
                f"{self._size} and {self._layout.hex()}; run the same version of cavmarl on all "
                "machines"
            )
        return header

    def record(self, data: bytes, vehicle: int) -> bytes:
        """Return the record in a vehicle's state, after checking layout, length and vehicle."""
        header = self.header(data)
        self._check_record(header, data)
        if header.vehicle != vehicle:
            raise MessageError(f"the state is of vehicle {header.vehicle}, not of {vehicle}")
        return data[_HEADER.size : _HEADER.size + self._size]

    def _check_record(self, header: TransferHeader, data: bytes) -> int:
        first = _HEADER.size
        (vehicle,) = _LONG.unpack_from(data, first + self._id_at)
        if vehicle != header.vehicle:
            raise MessageError(
                f"the header names vehicle {header.vehicle}, its record vehicle {vehicle}"
            )
        (status,) = _INT.unpack_from(data, first + self._transfer_at)
        if status != AUTHORITATIVE:
            raise MessageError(f"vehicle {vehicle} has the unknown transfer status {status}")
        (agent,) = _INT.unpack_from(data, first + self._agent_at)
        if agent >= self._slots[1]:
            raise MessageError(
                f"vehicle {vehicle} is driven by agent {agent}, but there are {self._slots[1]} "
                "agents here"
            )
        expected = self._lengths[1:] if agent >= 0 else (0, 0)
        if (header.commands, header.frames) != expected:
            raise MessageError(
                f"vehicle {vehicle} has {header.commands} bytes of delayed commands and "
                f"{header.frames} of frames, but {expected[0]} and {expected[1]} are expected; use "
                "the same clock.control_latency_ticks and sensors"
            )
        return int(agent)


def layout_text(record: np.dtype[np.void]) -> str:
    """Return the names, formats and offsets of a record's fields as one text."""
    named = (f"{name}:{kind.str}@{place}" for name, kind, place in _fields(record))
    return f"{record.itemsize} {' '.join(named)}"


def _fields(record: np.dtype[np.void]) -> list[tuple[str, np.dtype[np.generic], int]]:
    entries: Mapping[str, Any] = record.fields or {}
    return [(name, entries[name][0], int(entries[name][1])) for name in record.names or ()]
