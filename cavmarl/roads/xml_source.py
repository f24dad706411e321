"""Reading XML that nobody vouches for: no entities, no document types, no bombs, errors by line."""

from __future__ import annotations

import gzip
import io
import zlib
from pathlib import Path
from xml.sax import SAXParseException
from xml.sax.handler import ContentHandler

import defusedxml.sax
from defusedxml.common import DefusedXmlException

from cavmarl.errors import MapError

__all__ = ["MAX_XML_BYTES", "read_bytes", "read_xml"]

# A country in OSM is larger than this, but no world that one machine can drive.
MAX_XML_BYTES = 1 << 30

_GZIP_MAGIC = b"\x1f\x8b"


class _Limited(io.RawIOBase):
    """A stream that refuses to deliver more than `MAX_XML_BYTES`: the cure for compressed bombs."""

    def __init__(self, stream: io.BufferedIOBase) -> None:
        self._stream = stream
        self._left = MAX_XML_BYTES

    def readable(self) -> bool:
        return True

    def read(self, size: int = -1) -> bytes:
        data = self._stream.read(size)
        self._left -= len(data)
        if self._left < 0:
            raise MapError(f"the XML is larger than {MAX_XML_BYTES} bytes: cut the map first")
        return data


def read_xml(path: Path, handler: ContentHandler) -> None:
    """Feed the elements of a plain or gzipped XML file to a SAX `handler`.

    Raises:
        MapError: the file is missing, is not well-formed XML, is too large, or declares a document
            type or entities. The message names the file and, where there is one, the line.
    """
    try:
        with path.open("rb") as raw:
            packed = raw.read(2) == _GZIP_MAGIC
            raw.seek(0)
            stream = gzip.GzipFile(fileobj=raw) if packed else raw
            defusedxml.sax.parse(_Limited(stream), handler, forbid_dtd=True)
    except SAXParseException as error:
        raise MapError(
            f"{path}, line {error.getLineNumber()}: broken XML ({error.getMessage()}): "
            "export or download the file again"
        ) from error
    except DefusedXmlException as error:
        raise MapError(
            f"{path}: a map needs no document type and no entities, and this file declares some "
            f"({type(error).__name__}): remove its <!DOCTYPE …>"
        ) from error
    except (EOFError, zlib.error, gzip.BadGzipFile) as error:
        raise MapError(f"{path}: broken gzip ({error}): download the file again") from error
    except OSError as error:
        raise MapError(f"{path}: cannot be read ({error.strerror or error})") from error


def read_bytes(path: Path) -> bytes:
    """The XML text of a plain or gzipped file.

    Raises:
        OSError: the file cannot be read.
    """
    content = path.read_bytes()
    return gzip.decompress(content) if content.startswith(_GZIP_MAGIC) else content
