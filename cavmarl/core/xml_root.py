"""The root element of an XML file, found in its first bytes without reading the file."""

from __future__ import annotations

import re
import zlib
from pathlib import Path

_HEAD_BYTES = 1 << 16
_GZIP_MAGIC = b"\x1f\x8b"
_BEFORE_ROOT = re.compile(r"<\?.*?\?>|<!--.*?-->", re.DOTALL)
_ROOT = re.compile(r"\s*<([\w:.-]+)")

SUMO_CONFIG_SUFFIX = ".sumocfg"
_SUMO_CONFIG_ROOTS = ("configuration", "sumoConfiguration")


def head_of_file(path: Path) -> bytes:
    """Return the first bytes of a plain or gzipped file; b"" if it cannot be read."""
    try:
        with path.open("rb") as raw:
            head = raw.read(_HEAD_BYTES)
        if head.startswith(_GZIP_MAGIC):
            head = zlib.decompressobj(wbits=31).decompress(head, _HEAD_BYTES)
    except (OSError, ValueError, zlib.error):
        return b""
    return head


def root_tag(path: Path) -> str:
    """Return the name of the root element of a plain or gzipped file; "" if there is none."""
    head = head_of_file(path)
    encoding = "utf-16" if head[:2] in (b"\xff\xfe", b"\xfe\xff") else "utf-8-sig"
    found = _ROOT.match(_BEFORE_ROOT.sub("", head.decode(encoding, errors="replace")))
    return found[1] if found else ""


def is_sumo_config(path: Path) -> bool:
    """Return whether a file is a configuration of SUMO, by its root element or its suffix."""
    return path.name.endswith(SUMO_CONFIG_SUFFIX) or root_tag(path) in _SUMO_CONFIG_ROOTS
