from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest

from cavmarl.core.mapped_file import file_of
from cavmarl.engine.world_setup import find_map
from cavmarl.roads import cache
from cavmarl.roads.cache import load_network
from cavmarl.roads.network import RoadNetwork
from cavmarl.roads.sumo_net.reader import read_network


@pytest.fixture
def cache_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("CAVMARL_CACHE_DIR", str(tmp_path / "cache"))
    return tmp_path / "cache" / "maps"


def count_reads(monkeypatch: pytest.MonkeyPatch) -> list[Path]:
    reads: list[Path] = []

    def read(path: Path) -> RoadNetwork:
        reads.append(path)
        return read_network(path)

    monkeypatch.setattr(cache, "read_network", read)
    return reads


def test_a_second_load_restores_every_array(
    crossing: Callable[..., Path], cache_folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = crossing()
    reads = count_reads(monkeypatch)
    first, second = load_network(path), load_network(path)
    assert len(reads) == 1
    assert first.content_hash == second.content_hash == read_network(path).content_hash
    for field in fields(first):
        one, other = getattr(first, field.name), getattr(second, field.name)
        if isinstance(one, np.ndarray):
            assert one.dtype == other.dtype
            assert not other.flags.writeable
        else:
            assert one == other
    assert [entry.suffix for entry in cache_folder.iterdir()] == [".network"]


@pytest.mark.parametrize("max_copied", [0, 1 << 27])
def test_a_map_above_the_size_limit_is_mapped_from_its_file(
    crossing: Callable[..., Path],
    cache_folder: Path,
    monkeypatch: pytest.MonkeyPatch,
    max_copied: int,  # in bytes; larger maps are mapped from their file
) -> None:
    monkeypatch.setattr("cavmarl.roads.network.COPIED", max_copied)
    monkeypatch.setattr("cavmarl.core.huge_pages.LEAST", 1)
    path = crossing()
    first, second = load_network(path), load_network(path)
    assert first.content_hash == second.content_hash
    assert (file_of(second.arrays.lanes) is None) == (max_copied > 0)
    for one, other in zip(first.arrays, second.arrays, strict=True):
        assert one.tobytes() == other.tobytes()
    assert not second.lanes.flags.writeable


def test_a_changed_source_is_read_again(crossing: Callable[..., Path], cache_folder: Path) -> None:
    before = load_network(crossing())
    after = load_network(crossing(('speed="5"', 'speed="6"')))
    assert before.content_hash != after.content_hash
    assert len(list(cache_folder.iterdir())) == 2


@pytest.mark.parametrize("content", [b"", b"PK\x03\x04 nonsense", b"text"])
def test_an_invalid_entry_is_built_again(
    crossing: Callable[..., Path], cache_folder: Path, content: bytes
) -> None:
    path = crossing()
    whole = load_network(path)
    (entry,) = cache_folder.iterdir()
    entry.write_bytes(content)
    assert load_network(path).content_hash == whole.content_hash
    assert entry.read_bytes() != content


def test_a_truncated_entry_is_built_again(
    crossing: Callable[..., Path], cache_folder: Path
) -> None:
    path = crossing()
    whole = load_network(path)
    (entry,) = cache_folder.iterdir()
    entry.write_bytes(entry.read_bytes()[:-500])
    assert load_network(path).content_hash == whole.content_hash


def test_a_cached_network_has_the_name_of_the_loaded_file(
    crossing: Callable[..., Path], cache_folder: Path
) -> None:
    path = crossing()
    load_network(path)
    renamed = path.rename(path.with_name("other.net.xml"))
    assert load_network(renamed).name == "other"


# If these hashes change, raise `FORMAT`, and record golden rows and results (`make record`).
OF_FORMAT = 52
ROWS_SHA256 = {
    "merge": "2306899fd71f4dcfb40a199b3205e8d96babc4bcc392db1e47fc0b896e846ae0",
    "grid4x4": "0579bf6dbd8486be3dc902df8e16bbe63dbec6f5ff822aaefccbc50cd7190ede",
    "ring": "1b6ac6cc52fd982d9c900d815c869959a8d0a89d5a00bccd17dba1ae66b1beff",
}


@pytest.mark.parametrize("name", ROWS_SHA256)
def test_changed_rows_of_a_map_need_another_format_number(name: str) -> None:
    network = read_network(find_map(name))
    digest = hashlib.sha256()
    for array in network.arrays:
        digest.update(np.ascontiguousarray(array).tobytes())
    assert (cache.FORMAT, digest.hexdigest()) == (OF_FORMAT, ROWS_SHA256[name])
