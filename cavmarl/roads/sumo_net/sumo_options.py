"""Reads SUMO's configurations: options by SUMO's names, and the files that they name.

As in SUMO 1.28, an option may be in any section and have any of its synonyms, but no abbreviation.
`${NAME}` in a value stands for an environment variable. Files are separated by commas and relative
to the configuration; `%20` in a file name stands for a space.

The text file beside this module lists all options of SUMO by kind:

- `files`: net-file, route-files and additional-files.
- `time`, `seed`: begin, end and step length; random numbers.
- `read`: options that change traffic and that `traffic.demand` implements.
- `traffic`: further options that change the traffic of road vehicles.
- `beyond`: options about pedestrians, trains, the mesoscopic model and SUMO's own computation.
- `unread`: files and options that cavmarl never passes to SUMO.
- `report`: outputs, messages, the GUI and remote control, which change no traffic.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Mapping
from difflib import get_close_matches
from functools import cache
from os.path import isfile
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import unquote
from xml.sax.handler import ContentHandler

from cavmarl.core.errors import CavmarlError, MapError
from cavmarl.roads.sumo_net.xml_source import read_xml

_VARIABLE = re.compile(r"\$\{([^}]*)\}")
_OTHER_ROOTS = ("routes", "additional", "add", "net", "osm", "OpenDRIVE")


class KnownOption(NamedTuple):
    """An option of SUMO."""

    name: str  # SUMO's main name
    kind: str  # one of the kinds above
    default: str


class GivenOption(NamedTuple):
    """An option of a configuration."""

    value: str  # not empty; variables are replaced
    line: int


@cache
def known_options() -> Mapping[str, KnownOption]:
    """Return SUMO's options by name; an option is listed under each of its synonyms."""
    known: dict[str, KnownOption] = {}
    text = Path(__file__).with_name("sumo_options.txt").read_text(encoding="utf-8")
    for line in text.splitlines()[1:]:
        kind, name, default, *synonyms = line.split("\t")
        option = KnownOption(name, kind, "" if default == "~" else default)
        known |= dict.fromkeys((name, *synonyms), option)
    return known


def differs_from_default(option: KnownOption, value: str) -> bool:
    """Return whether an option's value differs from SUMO's default."""
    try:
        return float(value) != float(option.default)
    except ValueError:
        return value.lower() != option.default.lower()


class _Handler(ContentHandler):
    def __init__(self, path: Path, failure: type[CavmarlError]) -> None:
        super().__init__()
        self.given: dict[str, GivenOption] = {}
        self._path = path
        self._failure = failure
        self._depth = 0
        self._text = ""
        self._locator: Any = None

    def startElement(self, name: str, attrs: Any) -> None:
        self._depth += 1
        self._text = ""
        if self._depth == 1:
            if name in _OTHER_ROOTS:
                raise self._error(name, "is not the root of a SUMO configuration",
                                  "give a file with <configuration>")  # fmt: skip
            return
        value = attrs.get("value", attrs.get("v"))
        if value is not None:
            self._set(name, value)

    def characters(self, content: str) -> None:
        self._text += content

    def endElement(self, name: str) -> None:
        self._depth -= 1
        if self._text.strip():
            self._set(name, self._text)
        self._text = ""

    def _set(self, name: str, text: str) -> None:
        value = _VARIABLE.sub(lambda found: os.environ.get(found[1], ""), text).strip()
        if not value:
            return
        option = known_options().get(name)
        if option is None:
            close = get_close_matches(name, known_options(), n=3)
            meant = f"did you mean {' or '.join(close)}?" if close else "remove it"
            raise self._error(name, "is not an option of SUMO", meant)
        if option.name in self.given:
            first = self.given[option.name].line
            raise self._error(
                name, f"sets {option.name} again, after line {first}", "keep only one of them"
            )
        self.given[option.name] = GivenOption(value, self._locator.getLineNumber())

    def _error(self, name: str, problem: str, cure: str) -> CavmarlError:
        line = self._locator.getLineNumber()
        return self._failure(f"{self._path}, line {line}: <{name}> {problem}: {cure}")


def read_options(path: Path, failure: type[CavmarlError]) -> dict[str, GivenOption]:
    """Return the options of a configuration by their main names.

    `failure`: type of the error to raise.

    Raises CavmarlError (of the type `failure`): the file cannot be read or is not a configuration,
    SUMO does not have an option, or an option is set twice.
    """
    handler = _Handler(path, failure)
    read_xml(path, handler, failure)
    return handler.given


def files_of(
    path: Path,
    options: Mapping[str, GivenOption],
    names: Iterable[str],
    failure: type[CavmarlError],
) -> list[Path]:
    """Return the files that options of a configuration name, in the order of the names.

    `failure`: type of the error to raise.

    Raises CavmarlError (of the type `failure`): a file does not exist.
    """
    found: list[Path] = []
    for name in names:
        for part in options[name].value.split(",") if name in options else ():
            if not part.strip():
                continue
            file = path.parent / unquote(part.strip())
            if not isfile(file):  # unlike Path.is_file, isfile accepts names that no file can have
                raise failure(
                    f"{path}, line {options[name].line}: <{name}> names {str(file)!r}, which does "
                    "not exist: give the path of a file, relative to the configuration"
                )
            found.append(file)
    return found


def map_of_config(path: Path) -> Path:
    """Return the road network of a configuration.

    Raises MapError: the configuration cannot be read, or does not name one existing network.
    """
    options = read_options(path, MapError)
    found = files_of(path, options, ["net-file"], MapError)
    if len(found) != 1:
        raise MapError(
            f"{path}: names {len(found)} networks under <net-file>; name one, or give the map "
            "itself"
        )
    return found[0]


def additional_files_of(path: Path) -> list[Path]:
    """Return the additional files of a configuration, which may contain signal programs.

    Raises MapError: the configuration cannot be read.
    """
    return files_of(path, read_options(path, MapError), ["additional-files"], MapError)
