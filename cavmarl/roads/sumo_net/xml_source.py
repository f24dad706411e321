"""Reads untrusted XML: rejects entities, document types and XML bombs; errors name the line.

Three limits can be changed by environment variables: the size of the text in bytes, its ratio to
the size of the gzipped file, and the nesting depth of elements.
"""

from __future__ import annotations

import gzip
import io
import os
import re
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element, TreeBuilder
from xml.sax import SAXParseException
from xml.sax.handler import ContentHandler

import defusedxml.ElementTree
from defusedxml.common import DefusedXmlException
from defusedxml.expatreader import DefusedExpatParser

from cavmarl.core.errors import CavmarlError, ConfigError, MapError

# OSM data of a country is larger than this, but not the data of a world that one machine can run.
MAX_XML_BYTES = 1 << 30
LIMIT = "CAVMARL_MAX_XML_BYTES"  # environment variable that overrides this limit
# Maps and demand are compressed by a factor of 5 to 40, bombs by up to 1,032.
MAX_XML_RATIO = 100
RATIO_LIMIT = "CAVMARL_MAX_XML_RATIO"
_ANY_RATIO_BYTES = 1 << 24  # a text of this size may be compressed by any factor
MAX_XML_DEPTH = 100  # map and demand files have a depth of at most twelve
DEPTH_LIMIT = "CAVMARL_MAX_XML_DEPTH"

# Encodings of maps and demand; UTF-16 is recognized by its first bytes.
_ENCODINGS = frozenset(
    "utf-8 utf8 utf-16 us-ascii ascii iso-8859-1 iso-8859-15 latin-1 windows-1252 cp1252".split()
)
_DECLARATION_BYTES = 256
_DECLARED = re.compile(rb"""\s*(?:\xef\xbb\xbf)?<\?xml[^>]*?encoding\s*=\s*["']([^"'>]*)""")

_GZIP_MAGIC = b"\x1f\x8b"


class _Depth:
    """Counts open elements and limits them, because deep nesting would use unlimited memory."""

    def __init__(self) -> None:
        self._most, self._open = limit(DEPTH_LIMIT, MAX_XML_DEPTH), 0

    def opens(self) -> None:
        self._open += 1
        if self._open > self._most:
            raise OSError(
                f"its elements are nested over {self._most} deep: repair it or set {DEPTH_LIMIT}"
            )

    def closes(self) -> None:
        self._open -= 1


class _Parser(DefusedExpatParser):
    def __init__(self) -> None:
        super().__init__(forbid_dtd=True)
        self._depth = _Depth()

    def start_element(self, name: str, attrs: Mapping[str, str]) -> None:
        self._depth.opens()
        super().start_element(name, attrs)

    def end_element(self, name: str) -> None:
        self._depth.closes()
        super().end_element(name)


class _Builder(TreeBuilder):
    def __init__(self) -> None:
        super().__init__()
        self._depth = _Depth()

    def start(self, tag: Any, attrs: Any, /) -> Element:
        self._depth.opens()
        return super().start(tag, attrs)

    def end(self, tag: str, /) -> Element:
        self._depth.closes()
        return super().end(tag)


class _Limited(io.RawIOBase):
    """A stream that raises an error above a maximum size, against decompression bombs."""

    def __init__(self, raw: io.BufferedReader) -> None:
        packed = raw.read(2) == _GZIP_MAGIC
        raw.seek(0)
        self.stream: io.BufferedIOBase = gzip.GzipFile(fileobj=raw) if packed else raw
        self._most, self._cure = most_bytes(), LIMIT
        if packed:
            ratio = limit(RATIO_LIMIT, MAX_XML_RATIO)
            unpacked = max(_ANY_RATIO_BYTES, ratio * os.fstat(raw.fileno()).st_size)
            if unpacked < self._most:
                self._most, self._cure = unpacked, RATIO_LIMIT
        self._left = self._most

    def readable(self) -> bool:
        return True

    def read(self, size: int = -1) -> bytes:
        data = self.stream.read(self._left + 1 if size < 0 else size)
        self._left -= len(data)
        if self._left < 0:
            raise OSError(
                f"its text is larger than {self._most} bytes: cut it first, or set {self._cure}"
            )
        return data


def read_xml(path: Path, handler: ContentHandler, failure: type[CavmarlError] = MapError) -> None:
    """Pass the elements of a plain or gzipped XML file to a SAX `handler`.

    Exceptions of the handler are not caught. `failure`: type of the errors to raise, by kind of
    file.

    Raises:
        CavmarlError: (of the type `failure`) the file is missing, is not well-formed XML, is too
            large or too deeply nested, or declares a document type or entities. The message names
            the file and, if known, the line.
    """
    try:
        with path.open("rb") as raw:
            limited = _Limited(raw)
            _check_encoding(path, limited.stream, failure)
            parser = _Parser()
            parser.setContentHandler(handler)
            parser.parse(limited)
    except SAXParseException as error:
        raise failure(
            f"{path}, line {error.getLineNumber()}: broken XML ({error.getMessage()}): "
            "export or download the file again"
        ) from error
    except DefusedXmlException as error:
        raise failure(
            f"{path}: declares a document type or entities, which are not allowed "
            f"({type(error).__name__}): remove its <!DOCTYPE …>"
        ) from error
    except (EOFError, zlib.error, gzip.BadGzipFile) as error:
        raise failure(f"{path}: broken gzip ({error}): download the file again") from error
    except OSError as error:
        raise failure(f"{path}: cannot be read ({error.strerror or error})") from error


def _check_encoding(path: Path, stream: io.BufferedIOBase, failure: type[CavmarlError]) -> None:
    """Refuse encodings outside of `_ENCODINGS`, for which the parser raises other error types."""
    declared = declared_encoding(stream.read(_DECLARATION_BYTES))
    stream.seek(0)
    if declared and declared.lower() not in _ENCODINGS:
        raise failure(f"{path}, line 1: encoding '{declared}' is not supported: use UTF-8")


def declared_encoding(content: bytes) -> str:
    """Return the encoding that the first line of an XML file declares, or an empty text."""
    declared = _DECLARED.match(content)
    return declared[1].decode("latin-1") if declared else ""


def read_bytes(path: Path) -> bytes:
    """Return the XML text of a plain or gzipped file.

    Raises:
        OSError: the file cannot be read, or its text is too large.
    """
    with path.open("rb") as raw:
        return _Limited(raw).read()


def read_tree(path: Path) -> Element:
    """Return the root of a plain or gzipped XML file.

    Raises:
        OSError: the file cannot be read, or its text is too large or nested too deeply.
        ParseError, DefusedXmlException, ValueError, LookupError: see `defusedxml.ElementTree`.
    """
    parser = defusedxml.ElementTree.DefusedXMLParser(target=_Builder(), forbid_dtd=True)
    parser.feed(read_bytes(path))
    root: Element = parser.close()
    return root


def most_bytes() -> int:
    """Return the maximum size of a file's text: `CAVMARL_MAX_XML_BYTES`, or 1 GiB.

    Raises:
        ConfigError: the variable is not a number above 0.
    """
    return limit(LIMIT, MAX_XML_BYTES)


def limit(variable: str, usual: int) -> int:
    """Return a limit from an environment variable, or the default limit.

    Raises:
        ConfigError: the variable is not a number above 0.
    """
    given = os.environ.get(variable, "")
    if not given:
        return usual
    if not given.isdecimal() or int(given) < 1:
        raise ConfigError(f"{variable} = {given!r}: must be a whole number above 0")
    return int(given)
