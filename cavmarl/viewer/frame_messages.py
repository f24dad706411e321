"""Binary frame messages: nine bytes per vehicle, plus a roster of fields that rarely change.

A vehicle's id, size, kind, zone and transfer are a row of the *roster*. A change of the roster is a
separate message with a version; the messages of consecutive versions add up to the whole roster. A
*frame* names its roster version and has the vehicles in the order of their ids in that roster. A
watcher may therefore miss frames, but no change of the roster.

All data is little-endian. Positions are in centimetres from a corner `MARGIN_M` below and left of
the map's origin; headings are in 1/2048 turns, speeds in quarters of m/s.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.records.codes import EVENT_COLLIDED
from cavmarl.engine.world_frame import WorldFrame
from cavmarl.render.shapes import level_of

ROSTER_MESSAGE = 2
FRAME_MESSAGE = 3

ROSTER_HEAD = struct.Struct("<BBxxIII")  # message, is whole, version, rows, removed ids
# message, flags, world, version, time, tick, pace, vehicles, signals, ghost zones
FRAME_HEAD = struct.Struct("<BBHIdIfIII")
PAUSED = 1  # flag of a frame: the world is paused

ROSTER_ROW = np.dtype(
    [
        ("id", "<f8"),
        ("agent", "<i4"),
        ("length_cm", "<u2"),
        ("width_cm", "<u2"),
        ("height_cm", "<u2"),
        ("zone", "<i2"),
        ("target", "<i2"),  # target zone of a transfer; -1: none
        ("vclass", "u1"),
        ("driver", "u1"),
        ("level", "i1"),
        ("unused", "u1"),
    ]
)
ROW_BYTES = 9
MARGIN_M = 1000.0
MOST = 2**24 - 1  # largest coordinate, cm
HEADINGS = 2048  # headings in a full turn
SPEEDS_PER_MPS = 4.0
BRAKING_MPS2 = -0.8  # brake lights are on at or below this
# The whole roster is sent after this many changed rows plus twice the number of vehicles.
REBASE_ROWS = 1000
REBASE_CHANGES = 256  # it is also sent after this many messages of changes


class Change(NamedTuple):
    """One roster message."""

    version: int
    message: bytes


@dataclass(frozen=True)
class Publication:
    """The messages for one frame: the frame itself, and the roster changes that lead to it."""

    frame: bytes
    roster: tuple[Change, ...]  # by version; the first one has all rows

    def since(self, version: int) -> list[bytes]:
        """Return the roster messages after a version; 0: the watcher has none yet."""
        return [change.message for change in self.roster if change.version > version]

    @property
    def version(self) -> int:
        return self.roster[-1].version


class FrameEncoder:
    """Encodes successive frames of one world as publications.

    `origin`: (2,) origin of the map's message, in m.
    """

    def __init__(self, origin: NDArray[np.float64]) -> None:
        self._origin = origin
        self._roster = np.zeros(0, ROSTER_ROW)
        self._changes: tuple[Change, ...] = ()
        self._version = 0
        self._changed_rows = 0
        self._tick = -1

    def publication(
        self,
        frame: WorldFrame,
        *,
        paused: bool = False,
        pace: float = 1.0,
        ghosts_of: tuple[int, ...] = (),
    ) -> Publication:
        """Encode a frame for watchers.

        Args:
            frame: a frame of the world, not older than the previous one unless the world has
                restarted.
            paused: whether the world is paused.
            pace: simulated seconds per second; 0: as fast as possible.
            ghosts_of: zones whose ghosts are marked.
        """
        vehicles = frame.vehicles
        self._keep_roster(_roster_of(vehicles), begun_anew=frame.tick < self._tick)
        self._tick = frame.tick
        ghosts = [(zone, frame.ghosts[zone]) for zone in ghosts_of if zone < len(frame.ghosts)]
        head = FRAME_HEAD.pack(
            FRAME_MESSAGE,
            PAUSED if paused else 0,
            frame.world,
            self._version,
            frame.time_s,
            frame.tick,
            pace,
            len(vehicles),
            len(frame.signals),
            len(ghosts),
        )
        parts = [head, frame.signals.astype("<u4").tobytes()]
        for zone, seen in ghosts:
            rows = np.flatnonzero(np.isin(vehicles["id"], seen)).astype("<u4")
            parts += [struct.pack("<II", zone, len(rows)), rows.tobytes()]
        parts.append(self._rows(vehicles))
        return Publication(b"".join(parts), self._changes)

    def _rows(self, vehicles: NDArray[np.void]) -> bytes:
        """Return ROW_BYTES bytes per vehicle: three each for x and y, and three for the rest."""
        words = np.zeros((len(vehicles), 3), dtype="<u4")
        for k, name in enumerate(("x", "y")):
            place = (vehicles[name] - (self._origin[k] - MARGIN_M)) * 100.0
            words[:, k] = np.clip(np.rint(place), 0, MOST)
        turns = np.rint(vehicles["heading"] * (HEADINGS / (2.0 * np.pi))).astype(np.int64)
        speeds = np.clip(np.rint(np.abs(vehicles["speed"]) * SPEEDS_PER_MPS), 0, 511)
        bits = turns & (HEADINGS - 1)
        bits |= speeds.astype(np.int64) << 11
        bits |= (vehicles["accel"] < BRAKING_MPS2).astype(np.int64) << 20
        bits |= (vehicles["blinker"] > 0).astype(np.int64) << 21
        bits |= (vehicles["blinker"] < 0).astype(np.int64) << 22
        bits |= (vehicles["events"] & EVENT_COLLIDED).astype(bool).astype(np.int64) << 23
        words[:, 2] = bits
        return np.ascontiguousarray(words.view(np.uint8).reshape(-1, 3, 4)[:, :, :3]).tobytes()

    def _keep_roster(self, roster: NDArray[np.void], begun_anew: bool) -> None:
        """Add the changes since the last frame to the roster messages."""
        before = self._roster
        if self._changes and not begun_anew and np.array_equal(before, roster):
            return
        self._version += 1
        self._roster = roster
        old = np.searchsorted(before["id"], roster["id"])
        known = old < len(before)
        known[known] = before["id"][old[known]] == roster["id"][known]
        fresh = ~known
        fresh[known] = before[old[known]] != roster[known]
        left = before["id"][~np.isin(before["id"], roster["id"])]
        self._changed_rows += int(fresh.sum()) + len(left)
        too_much = self._changed_rows > 2 * len(roster) + REBASE_ROWS
        if not self._changes or begun_anew or too_much or len(self._changes) >= REBASE_CHANGES:
            whole = self._message(True, roster, left[:0])
            self._changes = (Change(self._version, whole),)
            self._changed_rows = 0
        else:
            change = Change(self._version, self._message(False, roster[fresh], left))
            self._changes = (*self._changes, change)

    def _message(self, whole: bool, rows: NDArray[np.void], left: NDArray[np.float64]) -> bytes:
        head = ROSTER_HEAD.pack(ROSTER_MESSAGE, whole, self._version, len(rows), len(left))
        return head + left.astype("<f8").tobytes() + rows.tobytes()


def _roster_of(vehicles: NDArray[np.void]) -> NDArray[np.void]:
    """Convert SEEN (n,) to ROSTER_ROW."""
    rows = np.zeros(len(vehicles), ROSTER_ROW)
    for name in ("id", "agent", "zone", "vclass", "driver"):
        rows[name] = vehicles[name]
    for name in ("length", "width", "height"):
        rows[f"{name}_cm"] = np.clip(np.rint(vehicles[name] * 100.0), 0, 65535)
    moving = vehicles["transfer"] != 0
    rows["target"] = np.where(moving, vehicles["target_zone"], -1)
    rows["level"] = np.clip(level_of(vehicles["z"]), -30, 30)
    return rows
