"""The files of a world, identified by content. Nodes on other machines receive each file once."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from cavmarl.config.env import EnvConfig
from cavmarl.config.registry import (
    resolve_buildings,
    resolve_demand,
    resolve_maps,
    resolve_programs,
    resolve_zones,
)
from cavmarl.core.atomic_file import sha256_of, write_whole
from cavmarl.core.cache_folder import cache_dir
from cavmarl.core.errors import MessageError, WorkerError

_DIGEST = re.compile("[0-9a-f]{64}")


class WorldFile(NamedTuple):
    """A file, and the key of the configuration that names it."""

    key: str
    nth: int  # index among the files of the key; -1: the key names a single file
    path: str  # path on the machine of the caller
    digest: str  # SHA-256 of the content

    @property
    def kept(self) -> Path:
        """Where a node stores the file if it has none at the path."""
        if not _DIGEST.fullmatch(self.digest):
            raise MessageError(f"{self.digest!r} is not an SHA-256 digest")
        return cache_dir() / "files" / self.digest / Path(self.path).name

    def found(self) -> Path | None:
        """Return where the file is on this machine; None: it is missing."""
        for path in (Path(self.path), self.kept):
            if path.is_file() and sha256_of(path) == self.digest:
                return path
        return None

    def keep(self, content: bytes) -> None:
        """Store the content where `found` looks, completely or not at all.

        Raises:
            MessageError: the content has another digest.
            WorkerError: the file cannot be written.
        """
        if hashlib.sha256(content).hexdigest() != self.digest:
            raise MessageError(f"the received content of {self.path} has another SHA-256 digest")
        try:
            self.kept.parent.mkdir(mode=0o700, parents=True, exist_ok=True)  # private to this user
            write_whole(self.kept, content)
        except OSError as error:
            raise WorkerError(
                f"{self.kept}: {error}; set CAVMARL_CACHE_DIR to a folder with room"
            ) from error


def files_of(config: EnvConfig, base_dir: Path) -> list[WorldFile]:
    """Return the files that a configuration names."""
    buildings = resolve_buildings(config, base_dir) if config.map.buildings != "osm" else None
    paths = [
        *(("map.source", n, path) for n, path in enumerate(resolve_maps(config, base_dir))),
        ("map.buildings", -1, buildings),
        ("zones.layout", -1, resolve_zones(config, base_dir)),
        *(("map.programs", n, path) for n, path in enumerate(resolve_programs(config, base_dir))),
        *(("traffic.demand", n, path) for n, path in enumerate(resolve_demand(config, base_dir))),
    ]
    return [
        WorldFile(key, n, str(path.resolve()), sha256_of(path))
        for key, n, path in paths
        if path is not None
    ]


def with_local_files(message: Mapping[str, Any], files: Sequence[WorldFile]) -> dict[str, Any]:
    """Return a message whose configuration has the paths of the files on this machine."""
    config = dict(message["config"])
    maps = [str(file.found()) for file in files if file.key == "map.source"]
    config["map"] = {**config["map"], "source": maps[0] if len(maps) == 1 else maps}
    for file in files:
        if file.key == "map.source":
            continue
        section, _, field = file.key.partition(".")
        values = dict(config[section])
        path = str(file.found())
        if file.nth < 0:
            values[field] = path
        else:
            values[field] = [*values[field]]
            values[field][file.nth] = path
        config[section] = values
    return {**message, "config": config}
