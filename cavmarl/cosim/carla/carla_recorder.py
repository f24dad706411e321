"""`CarlaRecorder`: CARLA's recorder. Its files are recordings of cavmarl, with a list of actors.

A recording is a folder, which `cavmarl replay` also reads (docs/guides/recordings.md). The file
`carla_actors.jsonl` in it has one line for the session and one for each vehicle or walker.
"""

from __future__ import annotations

import json
import logging
import re
import shutil
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, TextIO

import numpy as np

from cavmarl.core.errors import CavmarlError, RecordingError
from cavmarl.cosim.carla.call_arguments import CallRefused, shown
from cavmarl.cosim.carla.carla_actors import CarlaActor
from cavmarl.cosim.carla.carla_blueprints import BLUEPRINTS
from cavmarl.cosim.carla.carla_geometry import CarlaPose, Vector
from cavmarl.cosim.carla.hosted_world import EndedVehicle
from cavmarl.engine.world_frame import ENDED, frame_of
from cavmarl.env.recorded_worlds import WorldRecorder

if TYPE_CHECKING:
    from cavmarl.cosim.carla.carla_session import CarlaSession

log = logging.getLogger("cavmarl.carla")

ACTORS_FILE = "carla_actors.jsonl"
_MOST_BYTES = 1 << 26  # limit of the list of actors
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,99}")
_NOWHERE = CarlaPose(0.0, 0.0, 0.0)


@dataclass(frozen=True)
class RecordedActor:
    """A vehicle, walker or prop of a recording; fields as in `CarlaActor`."""

    vehicle: int
    number: int
    type_id: str
    attributes: dict[str, str]
    centre: Vector
    half_m: Vector
    tags: str  # hexadecimal

    @classmethod
    def of(cls, actor: CarlaActor) -> RecordedActor:
        return cls(
            actor.vehicle,
            actor.number,
            actor.type_id,
            actor.attributes,
            actor.centre,
            actor.half_m,
            actor.tags.hex(),
        )

    @classmethod
    def read(cls, given: Any) -> RecordedActor:
        """Return an actor from the values of a line. Raises ValueError: they are invalid."""
        attributes, vectors = given["attributes"], (given["centre"], given["half_m"])
        texts = [given["type_id"], *attributes, *attributes.values()]
        vehicle, number = given["vehicle"], given["number"]
        if (
            not all(isinstance(one, str) for one in texts)
            or given["type_id"] not in BLUEPRINTS
            or not (isinstance(vehicle, int) and 0 <= vehicle < 1 << 63)
            or not (isinstance(number, int) and 0 <= number < 1 << 32)
            or not all(len(one) == 3 and all(map(_is_small, one)) for one in vectors)
        ):
            raise ValueError("it is not an actor")
        (cx, cy, cz), (hx, hy, hz) = vectors
        bytes.fromhex(given["tags"])
        boxes = (cx, cy, cz), (hx, hy, hz)
        return cls(vehicle, number, given["type_id"], attributes, *boxes, given["tags"])

    def actor(self, number: int) -> CarlaActor:
        """Return the actor, with a given number."""
        return CarlaActor(
            number,
            self.type_id,
            _NOWHERE,
            attributes=dict(self.attributes),
            centre=self.centre,
            half_m=self.half_m,
            tags=bytes.fromhex(self.tags),
            vehicle=self.vehicle,
        )


def _is_small(value: Any) -> bool:
    return isinstance(value, int | float) and abs(value) < 1000.0


@dataclass(frozen=True)
class RecordedSession:
    """The session of a recording, and its actors by the ids of their vehicles."""

    map: str
    session: str
    episode: int
    actors: dict[int, RecordedActor]


def read_session(path: Path) -> RecordedSession:
    """Read the list of actors of a recording.

    Raises RecordingError: there is no such list, or it is damaged.
    """
    file = path / ACTORS_FILE
    try:
        if file.stat().st_size > _MOST_BYTES:
            raise ValueError(f"it has more than {_MOST_BYTES} bytes")
        head, *lines = file.read_text(encoding="utf-8").splitlines()
        first = json.loads(head)
        actors = [RecordedActor.read(json.loads(line)) for line in lines]
        name, key, number = first["map"], first["session"], first["episode"]
        if not (isinstance(name, str) and isinstance(key, str) and isinstance(number, int)):
            raise ValueError("its first line is not a session")
        return RecordedSession(name, key, number, {one.vehicle: one for one in actors})
    except OSError as error:
        raise RecordingError(
            f"{path.name}: is not a recording of a CARLA server ({error.strerror}); start_recorder "
            "makes one"
        ) from error
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise RecordingError(
            f"{path.name}/{ACTORS_FILE}: is damaged ({error}); record again"
        ) from error


class CarlaRecorder:
    """Records the world of a session after each tick.

    `folder`: folder of the recordings; None: recordings are refused. `most_rows`: a recording ends
    when it has this number of rows, one per vehicle and tick.
    """

    def __init__(self, folder: Path | None, most_rows: int) -> None:
        self._folder, self._most_rows = folder, most_rows
        self._writer: WorldRecorder | None = None
        self._list: TextIO | None = None
        self._listed: set[int] = set()
        self._rows = 0

    @property
    def is_on(self) -> bool:
        """Whether a recording is being written."""
        return self._writer is not None

    def finished(self, name: str) -> Path:
        """Return the folder of a recording that is complete; raise CallRefused otherwise."""
        path = self.path_of(name)
        if self._writer is not None and self._writer.path == path:
            raise CallRefused(f"{name} is being recorded; call stop_recorder first")
        return path

    def path_of(self, name: str) -> Path:
        """Return the folder of a recording; raise CallRefused if the name is not allowed.

        A client cannot read or write anywhere else, because the protocol has no login.
        """
        if self._folder is None:
            raise CallRefused(
                "this server has no folder for recordings; start it with --recordings FOLDER"
            )
        if not _NAME.fullmatch(name):
            raise CallRefused(
                f"{shown(name)} is not the name of a recording: use letters, digits, '.', '_' and "
                "'-', without a path; the server keeps recordings in a folder of its own"
            )
        return self._folder / name

    def start(self, session: CarlaSession, key: str, name: str) -> Path:
        """Begin a recording; a recording of this name is replaced.

        `key`: text that is unique to the session.

        Raises:
            CallRefused: the name is not allowed.
            RecordingError: the folder cannot be written, or is not a recording.
            MissingExtraError: pyarrow is not installed.
        """
        path = self.path_of(name)
        self.stop()
        env = session.world.env
        try:
            if (path / ACTORS_FILE).is_file():
                shutil.rmtree(path)
            self._writer = WorldRecorder(path, env.worlds, env.simulation, None)
            self._list = (path / ACTORS_FILE).open("w", encoding="utf-8")
            self._write(map=session.map.name, session=key, episode=session.episode)
        except OSError as error:
            self.stop()
            raise RecordingError(
                f"{name}: cannot be written ({error.strerror}); use another name, or free space in "
                "the server's folder of recordings"
            ) from error
        self._listed, self._rows = set(), 0
        self.take(session)
        return path

    def take(self, session: CarlaSession, ended: Sequence[EndedVehicle] = ()) -> None:
        """Record the current state of the world, if a recording has begun.

        `ended`: the agents' vehicles that have left in this tick.
        """
        writer = self._writer
        if writer is None:
            return
        try:
            for actor in session.actors.vehicles:
                if actor.vehicle not in self._listed:
                    self._listed.add(actor.vehicle)
                    self._write(**vars(RecordedActor.of(actor)))
            left = np.array([one[:2] for one in ended], ENDED)
            frame = frame_of(session.world.simulation, ended=left, room=writer.room)
            writer.add([frame], None)
        except (CavmarlError, OSError) as problem:
            log.warning("the recording ends: %s", problem)
            self.stop()
            return
        self._rows += len(frame.vehicles)
        if self._rows >= self._most_rows:
            log.warning("the recording ends: it has reached its limit of %d rows", self._most_rows)
            self.stop()

    def stop(self) -> None:
        """End the recording, if there is one."""
        writer, self._writer = self._writer, None
        if self._list is not None:
            with suppress(OSError):  # a full disk has ended the recording already
                self._list.close()
            self._list = None
        if writer is not None:
            try:
                writer.close()
            except CavmarlError as problem:
                log.warning("the recording is incomplete: %s", problem)

    def _write(self, **values: Any) -> None:
        assert self._list is not None
        self._list.write(json.dumps(values) + "\n")
        self._list.flush()
