"""Networks of real maps, which are cached between runs and built again if the sources change.

Only tests of netconvert and of the network reader run both each time; other tests use this cache.
"""

from __future__ import annotations

import fcntl
import hashlib
import shutil
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from importlib.metadata import version
from pathlib import Path

from cavmarl.core.atomic_file import write_whole
from cavmarl.core.cache_folder import cache_dir
from cavmarl.maps.netconvert import build_network
from cavmarl.roads.cache import pack_network, unpack_network
from cavmarl.roads.network import RoadNetwork
from cavmarl.roads.sumo_net.reader import map_name, read_network, source_hash

__all__ = ["built", "network_of"]

_FOLDER = cache_dir() / "tests"
_PACKAGE = Path(__file__).parents[2] / "cavmarl"
_OLD_S = 2 * 24 * 3600.0  # networks from older sources are removed after this time


def built(source: Path) -> Path:
    """Return the SUMO network of a map, built with `tolerant`."""
    digest = hashlib.sha256(source.read_bytes() + version("eclipse-sumo").encode()).hexdigest()

    def build(target: Path) -> None:
        build_network(source, target, tolerant=True)

    return _kept("maps", f"{source.name}-{digest[:16]}.net.xml", build)


def network_of(path: Path) -> RoadNetwork:
    """Return the road network of a SUMO network file."""
    digest = source_hash(path)

    def read(target: Path) -> None:
        write_whole(target, pack_network(read_network(path)))

    kept = _kept("roads", f"{digest}.network", read)
    network = unpack_network(kept.read_bytes(), map_name(path), digest)
    assert network is not None, f"{kept} is damaged: remove it"
    return network


def _kept(domain: str, name: str, make: Callable[[Path], None]) -> Path:
    """Return a cached file that depends on the sources of a domain; make it if it is missing."""
    folder = _FOLDER / f"{domain}-{_sources(domain)}"
    folder.mkdir(parents=True, exist_ok=True)
    target = folder / name
    with _alone(folder / f"{name}.lock"):
        if not target.exists():
            _remove_old()
            make(target)
    return target


@cache
def _sources(domain: str) -> str:
    """Return a hash of the source files of `core`, `roads` and a domain."""
    digest = hashlib.sha256()
    for part in ("core", "roads", domain):
        for path in sorted((_PACKAGE / part).rglob("*.py")):
            digest.update(path.relative_to(_PACKAGE).as_posix().encode() + path.read_bytes())
    return digest.hexdigest()[:16]


@contextmanager
def _alone(path: Path) -> Iterator[None]:
    """Lock a path against other processes within the block."""
    with path.open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        yield


def _remove_old() -> None:
    for folder in _FOLDER.iterdir():
        if time.time() - folder.stat().st_mtime > _OLD_S:
            shutil.rmtree(folder, ignore_errors=True)
