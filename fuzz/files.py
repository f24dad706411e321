"""What the targets share: a scratch file, and how one of them treats its input."""

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
    """A file of this process that holds `content`; it stays until another of that name."""
    path = Path(_folder().name) / name
    path.parent.mkdir(exist_ok=True)
    path.write_bytes(content)
    return path


def seed(name: str) -> bytes:
    """The content of a file of `fuzz/seeds/`."""
    return (ROOT / "fuzz" / "seeds" / name).read_bytes()


@dataclass(frozen=True)
class Target:
    """One parser under attack.

    Attributes:
        parse: gives it the bytes of a file; whatever it raises but a `CavmarlError` is a bug.
        seeds: makes small valid files to start from.
        slow: whether an input takes so long that only few can be tried.
    """

    parse: Callable[[bytes], object]
    seeds: Callable[[], tuple[bytes, ...]]
    slow: bool = False

    def accepts(self, content: bytes) -> bool:
        """Whether the parser takes it; False: it was refused on purpose."""
        try:
            self.parse(content)
        except CavmarlError:
            return False
        return True
