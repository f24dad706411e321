"""Files with secrets, which only their owner may read."""

from __future__ import annotations

import os
from functools import partial
from pathlib import Path

from cavmarl.core.errors import ConfigError


def check_private(what: str, path: Path) -> None:
    """Raise ConfigError if other users can read a file, and OSError if it is missing."""
    if path.stat().st_mode & 0o077:
        raise ConfigError(f"{what} {path}: other users can read it; run chmod 600 {path}")


def read_private(what: str, path: Path) -> str:
    """Return the secret in a file, without white space around it.

    Raises ConfigError: the file is missing, empty, or readable by other users; `what` names it.
    """
    try:
        check_private(what, path)
        secret = path.read_text("utf-8").strip()
    except (OSError, UnicodeError) as error:
        raise ConfigError(f"{what} {path}: cannot be read: {error}") from error
    if not secret:
        raise ConfigError(f"{what} {path}: the file is empty; write the secret into it")
    return secret


def write_private(path: Path, text: str) -> None:
    """Write a new file that only this user can read; raise OSError if the file exists."""
    with open(path, "x", opener=partial(os.open, mode=0o600), encoding="utf-8") as file:
        file.write(text)
