"""The recording of a session, in parts that end whenever the state of its worlds is saved.

A node that takes the session over begins with the part after the saved state and repeats the later
commands, so no part is missing. A part that the lost node had begun is recorded again.
"""

from __future__ import annotations

import io
import json
import zipfile
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

from cavmarl.client.uploads import DRIVER_FOLDER
from cavmarl.env.vector import CavVectorEnv
from cavmarl.recordings.extra_tables import RecordOptions
from cavmarl.recordings.recording_format import HEAD_FILE
from cavmarl.service.change_bodies import KeptRecording, Table

COMMAND = ["cavmarl", "node"]
PART = "recording-{:05d}.zip"  # name of the result with a part


class RecordingPart(NamedTuple):
    """A part that the service does not have yet."""

    name: str
    content: bytes  # a ZIP file of a recording


class SessionRecording:
    """The recording of a session on its node.

    Args:
        vec: the worlds.
        include: additional tables.
        part: number of the first part that this node records.
        files: folder with the files of the session; its path is removed from each part. Empty: the
            session has no files.

    Attributes:
        waiting: parts that have ended and are not stored with the service yet.

    Raises:
        ConfigError, MissingExtraError: the worlds or a table cannot be recorded.
    """

    def __init__(
        self, vec: CavVectorEnv, include: Sequence[Table], part: int = 0, files: str = ""
    ) -> None:
        self.waiting: list[RecordingPart] = []
        self._include, self._part, self._files = tuple(include), part, files
        self._folder: TemporaryDirectory[str] | None = None
        self.begin(vec)

    @property
    def kept(self) -> KeptRecording:
        """The data in a saved state from which a recording continues with its next part."""
        return KeptRecording(include=list(self._include), part=self._part)

    def begin(self, vec: CavVectorEnv) -> None:
        """Begin a part."""
        folder = TemporaryDirectory(prefix="cavmarl-recording-")
        try:
            vec.record(RecordOptions(Path(folder.name) / "recording", self._include))
        except BaseException:
            folder.cleanup()
            raise
        self._folder = folder

    def end_part(self, vec: CavVectorEnv) -> None:
        """End the present part; it waits to be stored."""
        if self._folder is None:
            return
        vec.record(None)
        place = Path(self._folder.name) / "recording"
        head = json.loads((place / HEAD_FILE).read_text(encoding="utf-8"))
        head["manifest"]["command"] = COMMAND  # the real command names folders of the node
        told = json.dumps(head)
        if self._files:  # a path of letters, digits, _ and - needs no escapes in JSON
            for folder in (f"{self._files}/{DRIVER_FOLDER}/", f"{self._files}/"):
                told = told.replace(folder, "")
        (place / HEAD_FILE).write_text(told, encoding="utf-8")
        content = io.BytesIO()
        with zipfile.ZipFile(content, "w") as packed:
            for file in sorted(place.rglob("*")):
                if file.is_file():
                    packed.write(file, file.relative_to(place))
        self._folder.cleanup()
        self._folder = None
        self.waiting.append(RecordingPart(PART.format(self._part), content.getvalue()))
        self._part += 1

    def close(self, vec: CavVectorEnv) -> None:
        """End the recording without its last part."""
        if self._folder is not None:
            vec.record(None)
            self._folder.cleanup()
            self._folder = None
