"""Folders and files of a user that become artefacts of a service."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

from cavmarl.config.driver_form import CONFIG_FILE, WEIGHTS_FILE
from cavmarl.core.errors import ServiceError

ENVIRONMENT_FILE = "env.yaml"
DRIVER_FOLDER = "drivers"  # contains a folder for each uploaded driver
DRIVER_FILES = (CONFIG_FILE, WEIGHTS_FILE)
UNSENT = (".md", ".txt", ".netccfg", ".netgcfg")  # files that no world reads
MOST_BYTES = 64 * 1024 * 1024  # limit of one file


class Upload(NamedTuple):
    """A file to upload."""

    name: str
    sha256: str
    content: bytes


def environment_files(environment: str | Path) -> tuple[str, dict[str, Upload]]:
    """Return the name of an environment and, if it is a path, its files by relative path.

    Raises:
        ServiceError: the path is neither a folder with an env.yaml nor a file.
    """
    if not isinstance(environment, Path):
        return environment, {}
    if environment.is_file():
        return environment.name, {environment.name: _read(environment)}
    if not (environment / ENVIRONMENT_FILE).is_file():
        raise ServiceError(
            f"{environment}: is neither a map nor a folder with {ENVIRONMENT_FILE}; give one"
        )
    files = sorted(one for one in environment.rglob("*") if one.is_file())
    sent = {
        one.relative_to(environment).as_posix(): _read(one)
        for one in files
        if not one.name.endswith(UNSENT)
    }
    return environment.resolve().name, sent


def driver_files(drivers: Mapping[str, str | Path]) -> dict[str, Upload]:
    """Return the files of trained drivers by relative path.

    Raises:
        ServiceError: a folder does not contain a trained driver.
    """
    files = {}
    for name, folder in drivers.items():
        for file in DRIVER_FILES:
            path = Path(folder) / file
            if not path.is_file():
                raise ServiceError(f"{path}: does not exist; give the folder of a trained driver")
            files[f"{DRIVER_FOLDER}/{name}/{file}"] = _read(path)
    return files


def _read(path: Path) -> Upload:
    try:
        content = path.read_bytes()
    except OSError as error:
        raise ServiceError(f"{path}: {error.strerror}; give a file that you can read") from error
    if len(content) > MOST_BYTES:
        raise ServiceError(
            f"{path}: has {len(content)} bytes: at most {MOST_BYTES}; compress it (.gz)"
        )
    return Upload(path.name, hashlib.sha256(content).hexdigest(), content)
