"""The manifest of an evaluation, which records how results are made before they exist.

`open_manifest` writes the manifest before the first step. `close_manifest` completes it with the
hashes of all results. If the process dies in between, the manifest stays open. Every report is read
through `read_closed`, which refuses results without a closed manifest that lists them.
"""

from __future__ import annotations

import hashlib
import json
import sys
from collections import Counter
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from os.path import isfile
from pathlib import Path
from typing import Any

from cavmarl.core.atomic_file import write_whole
from cavmarl.core.errors import ManifestError
from cavmarl.core.machine import describe_machine
from cavmarl.policies.loading import policy_files

MANIFEST_FILE = "manifest.json"
SCHEMA = 2

Document = dict[str, Any]


def describe_policies(policies: Mapping[str, str]) -> Document:
    """Return each policy's name or path as given, and the hashes of its files."""
    return {
        name: {
            "given": given,
            "sha256": _hashes(policy_files(given)),
        }
        for name, given in policies.items()
    }


def _hashes(files: Sequence[Path]) -> dict[str, str]:
    """Return hashes by file name, preceded by the folder if two files have the same name."""
    names = Counter(file.name for file in files)
    return {
        file.name if names[file.name] == 1 else f"{file.parent.name}/{file.name}": hash_of_file(
            file
        )
        for file in files
    }


def open_manifest(folder: Path, document: Mapping[str, Any]) -> Document:
    """Write the manifest of future results into `folder`.

    Args:
        folder: folder of the results; it exists and holds no manifest.
        document: description of the evaluation; machine, versions, commit and time are added.

    Raises:
        ManifestError: the folder has a manifest already.
    """
    path = folder / MANIFEST_FILE
    if path.exists():
        raise ManifestError(f"{path}: holds the results of another run; name a new folder")
    opened = {
        "schema": SCHEMA,
        "status": "open",
        "started": _now(),
        "ended": None,
        "command": [Path(sys.argv[0]).name, *sys.argv[1:]],
        **document,
        **describe_machine(),
        "results_sha256": {},
    }
    write_text(path, json.dumps(opened, indent=2) + "\n")
    return opened


def close_manifest(
    folder: Path, files: list[str], document: Mapping[str, Any] | None = None
) -> Document:
    """Mark the manifest as closed."""
    path = folder / MANIFEST_FILE
    closed: Document = {
        **_read(path),
        **(document or {}),
        "status": "closed",
        "ended": _now(),
        "results_sha256": {name: hash_of_file(folder / name) for name in files},
    }
    write_text(path, json.dumps(closed, indent=2) + "\n")
    return closed


def read_closed(folder: Path) -> Document:
    """Return the closed manifest of a results folder after checking all hashes.

    Raises:
        ManifestError: the manifest is missing or open, or a result is not listed in it.
    """
    path = folder / MANIFEST_FILE
    if not path.is_file():
        raise ManifestError(
            f"{folder}: has no {MANIFEST_FILE}: the origin of these results is unknown; "
            "make them with `cavmarl evaluate … --out FOLDER`"
        )
    document = _read(path)
    if document["status"] != "closed":
        raise ManifestError(
            f"{path}: open since {document['started']}: that evaluation has not ended, or it died; "
            f"run it again into a new folder: {' '.join(document['command'])}"
        )
    for name, known in document["results_sha256"].items():
        file = folder / name
        if not isfile(file):  # unlike methods of Path, isfile accepts impossible file names
            raise ManifestError(f"{file}: is missing, though {path} lists it; run it again")
        if hash_of_file(file) != known:
            raise ManifestError(
                f"{file}: is not the file that {path} was closed with; restore it, or run it again"
            )
    return document


def hash_of_file(path: Path) -> str:
    """Return the SHA-256 of a file in hexadecimal."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def write_text(path: Path, text: str) -> None:
    """Write a file atomically."""
    write_whole(path, text.encode())


def _is_typed(document: Document) -> bool:
    """Return whether the keys that are read again have the expected types."""
    command, known = document["command"], document["results_sha256"]
    return (
        isinstance(command, list)
        and all(isinstance(word, str) for word in command)
        and isinstance(known, dict)
        and all(isinstance(digest, str) for digest in known.values())
    )


def _read(path: Path) -> Document:
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        raise ManifestError(
            f"{path}: cannot be read ({error}); run the evaluation again"
        ) from error
    needed = {"schema", "status", "started", "command", "results_sha256"}
    if not isinstance(document, dict) or not needed <= document.keys() or not _is_typed(document):
        raise ManifestError(f"{path}: is not a manifest of an evaluation; run the evaluation again")
    if document["schema"] != SCHEMA:
        raise ManifestError(
            f"{path}: schema {document['schema']}, but this version reads {SCHEMA}; use the "
            "version of cavmarl that wrote it"
        )
    return document


def _now() -> str:
    return datetime.now(UTC).isoformat(timespec="seconds")
