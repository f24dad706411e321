"""`CarlaReplay`: the states of a recording, shown to clients instead of the states of the world."""

from __future__ import annotations

import logging
import math
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.errors import RecordingError
from cavmarl.core.records.codes import CLASS_PEDESTRIAN, DRIVER_BACKGROUND, EVENT_COLLIDED
from cavmarl.cosim.carla.carla_recorder import RecordedSession, read_session
from cavmarl.engine.world_frame import WorldFrame
from cavmarl.recordings.recording import Recording
from cavmarl.recordings.replay_pictures import drawable
from cavmarl.roads.network import VEHICLE_CLASSES, RoadNetwork

log = logging.getLogger("cavmarl.carla")

_SOON_S = 1e-6
_BEFORE_LANE_M = -1e6  # recordings have no position along the lane, so no vehicle is at its light


class RecordedMoment(NamedTuple):
    """A frame of a recording."""

    time_s: float  # since the first frame
    frame: WorldFrame


class CarlaRecording:
    """A recording of a CARLA server, read part by part.

    `path`: folder of the recording.

    Attributes:
        session: the session that was recorded, and its actors.
        times_s: (frames,) since the first frame.

    Raises:
        RecordingError: there is no such recording, or it is damaged or empty.
        MissingExtraError: pyarrow is not installed.
    """

    def __init__(self, path: Path) -> None:
        self.name = path.name
        self.session: RecordedSession = read_session(path)
        self._recording = Recording.open(path)
        self._index: list[tuple[int, int]] = []  # episode and tick of each frame
        times_s: list[float] = []
        self.most_rows = 0
        self.classes: set[int] = set()
        for moment, episode in self._moments():
            self._recording.check_on_map(moment.frame)
            times_s.append(moment.time_s)
            self._index.append((episode, moment.frame.tick))
            self.most_rows = max(self.most_rows, len(moment.frame.vehicles))
            self.classes |= set(moment.frame.vehicles["vclass"].tolist())
        if not times_s:
            raise RecordingError(f"{self.name}: the recording is empty; record some ticks")
        self.times_s = np.array(times_s)

    @property
    def duration_s(self) -> float:
        return float(self.times_s[-1])

    @property
    def started(self) -> str:
        """Date and time at which the recording started."""
        return str(self._recording.manifest.get("started", "unknown"))

    def check_map(self, network: RoadNetwork, name: str) -> None:
        """Raise RecordingError if the recording is of another map than `network`, named `name`."""
        if self._recording.head.network["source_sha256"] != network.source_hash:
            raise RecordingError(
                f"{self.name}: was recorded on the map {self.session.map}, but the world has "
                f"{name}; load the map of the recording first: client.load_world("
                f"'{self.session.map}')"
            )

    def moments(self) -> Iterator[RecordedMoment]:
        """Yield all frames, in order. Raises RecordingError: a part is damaged."""
        return (moment for moment, _ in self._moments())

    def collisions(self) -> Iterator[tuple[float, int, WorldFrame]]:
        """Yield time and id of each vehicle that has collided, and the last frame with it."""
        hits: dict[tuple[int, int], list[int]] = {}
        for episode, event in self._recording.events():
            if event.kind == "collision":
                hits.setdefault((episode, event.tick), []).append(event.vehicle)
        before: WorldFrame | None = None
        for moment, episode in self._moments():
            for vehicle in hits.get((episode, moment.frame.tick), ()):
                frames = (moment.frame, before)
                last = next((one for one in frames if one and vehicle in one.vehicles["id"]), None)
                if last is not None:
                    yield moment.time_s, vehicle, last
            before = moment.frame

    def _moments(self) -> Iterator[tuple[RecordedMoment, int]]:
        head = self._recording.head
        time_s, last = 0.0, None
        for found in self._recording.recorded():
            tick = found.frame.tick
            if last is not None:
                is_same = found.episode == last[0]
                time_s += (tick - last[1]) * head.sim_dt_s if is_same else head.step_s
            last = found.episode, tick
            yield RecordedMoment(time_s, found.frame), found.episode

    def frame_at(self, time_s: float) -> tuple[int, WorldFrame]:
        """Return the number and the content of the last frame up to a time.

        Raises RecordingError: a part has been damaged or removed.
        """
        number = max(0, int(np.searchsorted(self.times_s, time_s + _SOON_S, side="right")) - 1)
        episode, tick = self._index[number]
        return number, self._recording.at(tick, 0, episode)


class CarlaReplay:
    """The part of a recording that is being shown.

    Args:
        recording: the recording.
        begin_s: its first second; a negative one counts from the end.
        duration_s: length of the part; 0: up to the end.
        types: VTYPE (n,) of the world.
        capacity: largest number of vehicles of the world.

    Attributes:
        rows: VEHICLE (n,) at the current time of the replay.
        signals: the signals at this time, see `Worlds.signal_phase`.
        is_over: whether the end has been reached.
        factor: recorded time per simulated time.

    Raises:
        RecordingError: the part is empty, or the world has no room for the vehicles.
    """

    def __init__(
        self,
        recording: CarlaRecording,
        begin_s: float,
        duration_s: float,
        types: NDArray[np.void],
        capacity: int,
    ) -> None:
        self.recording = recording
        last_s = recording.duration_s
        self.begin_s = max(0.0, last_s + begin_s if begin_s < 0.0 else begin_s)
        self.end_s = min(last_s, self.begin_s + duration_s) if duration_s > 0.0 else last_s
        if self.begin_s > last_s:
            raise RecordingError(
                f"{recording.name}: the replay cannot start at {begin_s:g} s, as the recording "
                f"lasts {last_s:g} s; start earlier"
            )
        if recording.most_rows > capacity:
            raise RecordingError(
                f"{recording.name}: has {recording.most_rows} vehicles at a time, but this world "
                f"has room for {capacity}; start the server with more vehicles (--set "
                "population.external=N)"
            )
        self._type_of = _types_of(recording, types)
        self.factor = 1.0
        self.is_over = False
        self.time_s = self.begin_s
        self._number, frame = recording.frame_at(self.time_s)
        self.rows = self._rows_of(frame)
        self.signals: NDArray[np.int32] = frame.signals

    def advance(self, step_s: float) -> None:
        """Advance by some simulated time; after the end, the last state remains."""
        self.time_s += step_s * self.factor
        self.is_over = self.time_s > self.end_s + _SOON_S
        try:
            number, frame = self.recording.frame_at(min(self.time_s, self.end_s))
        except RecordingError as problem:
            log.warning("the replay ends: %s", problem)
            self.is_over = True
            return
        if number == self._number:
            return
        rows = self._rows_of(frame)
        passed_s = self.recording.times_s[number] - self.recording.times_s[self._number]
        _, new, old = np.intersect1d(rows["id"], self.rows["id"], return_indices=True)
        turned = rows["heading"][new] - self.rows["heading"][old]
        turned = np.remainder(turned + math.pi, 2.0 * math.pi) - math.pi
        rows["yaw_rate"][new] = turned / passed_s
        self._number, self.rows, self.signals = number, rows, frame.signals

    def _rows_of(self, frame: WorldFrame) -> NDArray[np.void]:
        rows = drawable(frame.vehicles)
        rows["vtype"] = [self._type_of[one] for one in frame.vehicles["vclass"].tolist()]
        rows["driver"], rows["agent"] = DRIVER_BACKGROUND, -1
        rows["s"], rows["hit"] = _BEFORE_LANE_M, -1
        for row in np.flatnonzero(rows["events"] & EVENT_COLLIDED).tolist():
            rows["hit"][row] = nearest_to(row, rows)
        return rows


def nearest_to(row: int, rows: NDArray[np.void]) -> int:
    """Return the id of the vehicle nearest to the vehicle of a row; -1: no other vehicle."""
    apart_m = np.hypot(rows["x"] - rows["x"][row], rows["y"] - rows["y"][row])
    apart_m[row] = np.inf
    nearest = int(apart_m.argmin())
    return int(rows["id"][nearest]) if np.isfinite(apart_m[nearest]) else -1


def _types_of(recording: CarlaRecording, types: NDArray[np.void]) -> dict[int, int]:
    """Return the row in `types` of each vehicle class of a recording.

    Raises RecordingError: the world has no type of a class.
    """
    found = {}
    for vclass in recording.classes:
        rows = np.flatnonzero(types["vclass"] == vclass)
        if not len(rows):
            names = {**dict(enumerate(VEHICLE_CLASSES)), CLASS_PEDESTRIAN: "pedestrian"}
            raise RecordingError(
                f"{recording.name}: has vehicles of the class {names.get(vclass, vclass)}, which "
                "this world does not have; start the server with the world that was recorded"
            )
        found[vclass] = int(rows[0])
    return found
