"""Recordings that a service has stored in parts, written to a folder."""

from __future__ import annotations

import io
import zipfile
from collections.abc import Mapping
from pathlib import Path

from cavmarl.core.errors import RecordingError

MOST_BYTES = 1 << 32  # limit of one unpacked part


def unpack_recordings(parts: Mapping[str, bytes], folder: str | Path) -> list[Path]:
    """Write each part, a ZIP file, as a recording in a new folder; return the recordings.

    Raises:
        RecordingError: the folder exists already, or a part is damaged.
    """
    place = Path(folder)
    try:
        place.mkdir(parents=True)
    except OSError as error:
        raise RecordingError(f"{place}: {error.strerror}; give a new folder") from error
    found = []
    for name, content in sorted(parts.items()):
        path = place / name.removesuffix(".zip")
        try:
            with zipfile.ZipFile(io.BytesIO(content)) as packed:
                if sum(one.file_size for one in packed.infolist()) > MOST_BYTES:
                    raise RecordingError(f"{name}: has over {MOST_BYTES} bytes; it is not written")
                packed.extractall(path)  # extractall never writes outside of the folder
        except zipfile.BadZipFile as error:
            raise RecordingError(f"{name}: is not a ZIP file ({error}); fetch it again") from error
        found.append(path)
    return found
