"""Shared parts of the targets: a scratch file, and the class of targets."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from cavmarl.core.errors import CavmarlError

__all__ = ["ROOT", "Target", "scratch", "seed"]

ROOT = Path(__file__).resolve().parents[1]


@cache
def _folder() -> tempfile.TemporaryDirectory[str]:
    return tempfile.TemporaryDirectory(prefix="cavmarl-fuzz-")


def scratch(name: str, content: bytes) -> Path:
    """Write `content` to a file of this process, which stays until the next file of that name."""
    path = Path(_folder().name) / name
    path.parent.mkdir(exist_ok=True)
    path.write_bytes(content)
    return path


def seed(name: str) -> bytes:
    """Return the content of a file of `fuzz/seeds/`."""
    return (ROOT / "fuzz" / "seeds" / name).read_bytes()


@dataclass(frozen=True)
class Target:
    """A parser that is fuzzed.

    Attributes:
        parse: parses the bytes of a file; any error but a `CavmarlError` is a bug.
        seeds: makes small valid files to start from.
        slow: whether an input takes so long that only few can be tried.
    """

    parse: Callable[[bytes], object]
    seeds: Callable[[], tuple[bytes, ...]]
    slow: bool = False

    def accepts(self, content: bytes) -> bool:
        """Return whether the parser accepts the content; False: it raised a `CavmarlError`."""
        try:
            self.parse(content)
        except CavmarlError:
            return False
        return True
