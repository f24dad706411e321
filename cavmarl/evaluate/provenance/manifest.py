"""The manifest of an evaluation: what a result is made with, on record before there is one.

`open_manifest` writes it before the first step, `close_manifest` when all results lie beside it,
with their hashes. A process that dies in between leaves an open one. `read_closed` is the door
through which every report goes: results without a closed manifest that knows them are refused.
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
    """Each policy's name or path as given, and the hashes of its files."""
    return {
        name: {
            "given": given,
            "sha256": _hashes(policy_files(given)),
        }
        for name, given in policies.items()
    }


def _hashes(files: Sequence[Path]) -> dict[str, str]:
    """By name, with the folder in front where two files have one name."""
    names = Counter(file.name for file in files)
    return {
        file.name if names[file.name] == 1 else f"{file.parent.name}/{file.name}": hash_of_file(
            file
        )
        for file in files
    }


def open_manifest(folder: Path, document: Mapping[str, Any]) -> Document:
    """Write the manifest of results that are about to be made into `folder`.

    Args:
        folder: of the results; it exists and holds no manifest.
        document: what this evaluation is; machine, versions, commit and time are added.

    Raises:
        ManifestError: there is a manifest already.
    """
    path = folder / MANIFEST_FILE
    if path.exists():
        raise ManifestError(f"{path}: there are results of another run here; give a new folder")
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
    """The manifest of a folder of results that can be trusted to belong to it.

    Raises:
        ManifestError: no manifest, an open one, or results that it does not know.
    """
    path = folder / MANIFEST_FILE
    if not path.is_file():
        raise ManifestError(
            f"{folder}: no {MANIFEST_FILE}: the origin of these results is unknown; "
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
        if not isfile(file):  # unlike Path's, it takes names that no file can have
            raise ManifestError(f"{file}: is missing, though {path} lists it; run it again")
        if hash_of_file(file) != known:
            raise ManifestError(
                f"{file}: is not the file that {path} was closed with; restore it, or run it again"
            )
    return document


def hash_of_file(path: Path) -> str:
    """SHA-256 of a file, hex."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def write_text(path: Path, text: str) -> None:
    """Write a file that is there whole or not at all."""
    write_whole(path, text.encode())


def _is_typed(document: Document) -> bool:
    """Whether the keys that are read again hold what they are written with."""
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
        raise ManifestError(f"{path}: not a manifest of an evaluation; run it again")
    if document["schema"] != SCHEMA:
        raise ManifestError(
            f"{path}: schema {document['schema']}, but this version reads {SCHEMA}; use the "
            "version of cavmarl that wrote it"
        )
    return document


def _now() -> str:
    return datetime.now(UTC).isoformat(timespec="seconds")
