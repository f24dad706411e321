"""Reads untrusted XML: no entities, no document types, no bombs, errors by line."""

from __future__ import annotations

import gzip
import io
import os
import re
import zlib
from pathlib import Path
from xml.sax import SAXParseException
from xml.sax.handler import ContentHandler

import defusedxml.sax
from defusedxml.common import DefusedXmlException

from cavmarl.core.errors import CavmarlError, ConfigError, MapError

# A country in OSM is larger than this, but no world that one machine can drive.
MAX_XML_BYTES = 1 << 30
LIMIT = "CAVMARL_MAX_XML_BYTES"  # the environment's variable with another limit

# What XML files of maps and demand come in; UTF-16 is told by its first bytes.
_ENCODINGS = frozenset(
    "utf-8 utf8 utf-16 us-ascii ascii iso-8859-1 iso-8859-15 latin-1 windows-1252 cp1252".split()
)
_DECLARATION_BYTES = 256
_DECLARED = re.compile(rb"""\s*(?:\xef\xbb\xbf)?<\?xml[^>]*?encoding\s*=\s*["']([^"'>]*)""")

_GZIP_MAGIC = b"\x1f\x8b"


class _Limited(io.RawIOBase):
    """A stream that refuses to deliver more than `MAX_XML_BYTES`: the cure for compressed bombs."""

    def __init__(self, stream: io.BufferedIOBase, failure: type[CavmarlError]) -> None:
        self._stream = stream
        self._failure = failure
        self._most = self._left = most_bytes()

    def readable(self) -> bool:
        return True

    def read(self, size: int = -1) -> bytes:
        data = self._stream.read(size)
        self._left -= len(data)
        if self._left < 0:
            raise self._failure(
                f"the XML is larger than {self._most} bytes: cut it first, or set {LIMIT}"
            )
        return data


def read_xml(path: Path, handler: ContentHandler, failure: type[CavmarlError] = MapError) -> None:
    """Feed the elements of a plain or gzipped XML file to a SAX `handler`.

    `handler`: takes the elements; what it raises passes through. `failure`: the error to raise, by
    what kind of file this is.

    Raises:
        CavmarlError: of the type `failure`: the file is missing, is not well-formed XML, is too
            large, or declares a document type or entities. The message names the file and, where
            there is one, the line.
    """
    try:
        with path.open("rb") as raw:
            packed = raw.read(2) == _GZIP_MAGIC
            raw.seek(0)
            stream = gzip.GzipFile(fileobj=raw) if packed else raw
            _check_encoding(path, stream, failure)
            defusedxml.sax.parse(_Limited(stream, failure), handler, forbid_dtd=True)
    except SAXParseException as error:
        raise failure(
            f"{path}, line {error.getLineNumber()}: broken XML ({error.getMessage()}): "
            "export or download the file again"
        ) from error
    except DefusedXmlException as error:
        raise failure(
            f"{path}: no document type and no entities are needed, and this file declares some "
            f"({type(error).__name__}): remove its <!DOCTYPE …>"
        ) from error
    except (EOFError, zlib.error, gzip.BadGzipFile) as error:
        raise failure(f"{path}: broken gzip ({error}): download the file again") from error
    except OSError as error:
        raise failure(f"{path}: cannot be read ({error.strerror or error})") from error


def _check_encoding(path: Path, stream: io.BufferedIOBase, failure: type[CavmarlError]) -> None:
    """Refuse encodings for which the parser would raise errors of other kinds."""
    declared = declared_encoding(stream.read(_DECLARATION_BYTES))
    stream.seek(0)
    if declared and declared.lower() not in _ENCODINGS:
        raise failure(f"{path}, line 1: encoding '{declared}': save the file as UTF-8")


def declared_encoding(content: bytes) -> str:
    """The encoding that the first line of an XML file names; empty: none."""
    declared = _DECLARED.match(content)
    return declared[1].decode("latin-1") if declared else ""


def read_bytes(path: Path) -> bytes:
    """The XML text of a plain or gzipped file.

    Raises:
        OSError: the file cannot be read, or its text is larger than `most_bytes`.
    """
    most = most_bytes()
    with path.open("rb") as raw:
        packed = raw.read(2) == _GZIP_MAGIC
        raw.seek(0)
        content = (gzip.GzipFile(fileobj=raw) if packed else raw).read(most + 1)
    if len(content) > most:
        raise OSError(f"larger than {most} bytes: cut it first, or set {LIMIT}")
    return content


def most_bytes() -> int:
    """How large the text of one file may be: `CAVMARL_MAX_XML_BYTES`, or 1 GiB.

    Raises:
        ConfigError: that is no number above 0.
    """
    return limit(LIMIT, MAX_XML_BYTES)


def limit(variable: str, usual: int) -> int:
    """A limit of the environment, or the usual one.

    Raises:
        ConfigError: it is no number above 0.
    """
    given = os.environ.get(variable, "")
    if not given:
        return usual
    if not given.isdecimal() or int(given) < 1:
        raise ConfigError(f"{variable} = {given!r}: must be a whole number above 0")
    return int(given)
