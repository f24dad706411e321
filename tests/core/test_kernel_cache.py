"""Where compiled kernels are kept: code of a file that has changed is never used."""

from __future__ import annotations

import ast
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from numba.core import config

from cavmarl.core.cache_folder import cache_dir
from cavmarl.core.math.bearings import rough_atan2
from cavmarl.core.compiled import kernel
from cavmarl.core.compiled import kernel_cache as kernels

SOURCES = kernels._sources()
PACKAGE = Path(kernels.__file__).parents[2]


def _folders(monkeypatch: pytest.MonkeyPatch, changed: str = "") -> dict[str, Path]:
    """The folder of each file of kernels, if one of them has another line."""
    sources = {**SOURCES, **({changed: SOURCES[changed] + b"\n"} if changed else {})}
    monkeypatch.setattr(kernels, "_sources", lambda: sources)
    kernels._cache_dir_of.cache_clear()
    try:
        return {name: kernels._cache_dir_of(f"cavmarl.{name}") for name in SOURCES}
    finally:
        kernels._cache_dir_of.cache_clear()


def _folder_anew(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let kernels that are made from here on look up where they are kept."""
    monkeypatch.setattr(kernels, "_cache_dir_of", kernels._cache_dir_of.__wrapped__)


def test_every_folder_of_kernels_is_read() -> None:
    folders = {path.parent for path in PACKAGE.rglob("kernels/*.py")}
    assert len(folders) > 8
    for folder in folders:
        assert ".".join(folder.relative_to(PACKAGE).parts) in SOURCES
    assert {"core.math.rng", "core.records.codes", "core.numba.specialized"} <= SOURCES.keys()


def test_a_change_moves_the_kernels_that_call_what_has_changed_and_no_others(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    before = _folders(monkeypatch)
    after = _folders(monkeypatch, "core.math.geometry")
    moved = {name for name in SOURCES if before[name] != after[name]}
    # `group_phases` calls `world_phases`, which calls `contacts`.
    called = {"driving.kernels.contacts", "shards.kernels.world_phases"}
    assert {"core.math.geometry", "shards.kernels.group_phases", *called} <= moved
    assert moved.isdisjoint({"core.math.rng", "driving.kernels.krauss", "core.math.buckets"})


@pytest.mark.parametrize("changed", kernels._SHARED)
def test_flags_and_the_compiler_concern_all(monkeypatch: pytest.MonkeyPatch, changed: str) -> None:
    before, after = _folders(monkeypatch), _folders(monkeypatch, changed)
    assert all(before[name] != after[name] for name in SOURCES)


@pytest.mark.parametrize("name", sorted(SOURCES))
def test_every_import_of_another_file_is_seen(name: str) -> None:
    found = {other.decode() for other in kernels._IMPORT.findall(SOURCES[name])}
    imported = set()
    for node in ast.walk(ast.parse(SOURCES[name])):
        if isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{name}: imports by the full name are those looked for"
            module = node.module or ""
            if module.startswith("cavmarl."):
                imported.add(module.removeprefix("cavmarl."))
                # A module taken from its folder would be missed.
                assert not {f"{module[8:]}.{alias.name}" for alias in node.names} & set(SOURCES)
        elif isinstance(node, ast.Import):
            assert not any(alias.name.startswith("cavmarl") for alias in node.names)
    assert found == imported


@pytest.mark.skipif(config.DISABLE_JIT, reason="nothing is compiled")
@pytest.mark.parametrize("harm", [None, b"", b"cut", b"flipped"])
def test_what_is_damaged_is_compiled_anew(
    tmp_path: Path, harm: bytes | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    def run() -> list[float]:
        """What the kernel gives as another process has it, and how often it was kept."""
        known: Any = rough_atan2
        again: Any = kernel(known.py_func)
        return [again(1.0, 2.0), sum(again.stats.cache_hits.values())]

    monkeypatch.setenv("CAVMARL_CACHE_DIR", str(tmp_path))
    _folder_anew(monkeypatch)
    first = run()
    assert first[1] == 0
    files = [*tmp_path.rglob("*.nbi"), *tmp_path.rglob("*.nbc")]
    assert files
    for file in files if harm is not None else ():
        content = file.read_bytes()
        middle = len(content) // 2
        file.write_bytes(
            {
                b"": b"",
                b"cut": content[:middle],
                b"flipped": content[:middle]
                + bytes([content[middle] ^ 255])
                + content[middle + 1 :],
            }[harm]
        )
    assert run() == [first[0], 1 if harm is None else 0]
    assert run() == [first[0], 1]


@pytest.mark.skipif(config.DISABLE_JIT, reason="nothing is compiled")
def test_of_a_kernel_that_was_kept_there_is_machine_code_alone() -> None:
    """LLVM's would stay in memory; no kernel links it, and to try is an error."""
    known: Any = rough_atan2
    expected = known(1.0, 2.0)
    again: Any = kernel(known.py_func)
    assert again(1.0, 2.0) == expected
    assert sum(again.stats.cache_hits.values()) == 1
    (result,) = again.overloads.values()
    with pytest.raises(RuntimeError, match="unfit for linking"):
        result.library._get_module_for_linking()


def _kept_of_one(folder: Path) -> kernels._CheckedFile:
    return kernels._CheckedFile(str(folder), "kernel", "")


def test_no_flipped_or_missing_byte_of_an_index_is_an_error(tmp_path: Path) -> None:
    """Nor is any of it unpickled: a byte more in a length asks for terabytes."""
    kept = _kept_of_one(tmp_path)
    kept.save(("int64",), "machine code")
    assert kept.load(("int64",)) == "machine code"
    index = tmp_path / "kernel.nbi"
    content = index.read_bytes()
    for place, byte in enumerate(content):
        for other in {byte ^ 1, byte ^ 128, 0, 255} - {byte}:
            index.write_bytes(content[:place] + bytes([other]) + content[place + 1 :])
            assert kept.load(("int64",)) is None, (place, other)
        index.write_bytes(content[:place])
        assert kept.load(("int64",)) is None, place


def test_data_of_another_kernel_are_not_taken(tmp_path: Path) -> None:
    kept = _kept_of_one(tmp_path)
    kept.save("a", "code of a")
    kept.save("b", "code of b")
    one, other = tmp_path.glob("*.nbc")
    one.write_bytes(other.read_bytes())
    assert {kept.load("a"), kept.load("b")} in ({None, "code of a"}, {None, "code of b"})


def test_processes_that_compile_a_kernel_at_once_keep_their_own_code(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The other one, for other arguments, has read the index before and writes it after."""
    first, second = _kept_of_one(tmp_path), _kept_of_one(tmp_path)
    save_index = first._save_index

    def overtaken(overloads: dict[str, str]) -> None:
        save_index(overloads)
        with monkeypatch.context() as before:
            before.setattr(second, "_load_index", dict)
            second.save("float64", "code for float64")

    monkeypatch.setattr(first, "_save_index", overtaken)
    first.save("int64", "code for int64")
    assert first.load("int64") in (None, "code for int64")
    assert first.load("float64") == "code for float64"


WORLD = """
from cavmarl import parallel_env
parallel_env("ring", agents=1, background=0)
"""
KERNELS = """
from cavmarl.core.math.bearings import rough_atan2
from cavmarl.core.math.geometry import wrap_angle
print(rough_atan2(1.0, 2.0), wrap_angle(7.0))
"""


@pytest.mark.skipif(config.DISABLE_JIT, reason="nothing is compiled")
@pytest.mark.parametrize("how", ["no folder", "a file"])
def test_a_folder_that_cannot_be_written_is_named_once(tmp_path: Path, how: str) -> None:
    place = tmp_path / "cache" if how == "a file" else Path("/proc/cavmarl")
    if how == "a file":
        place.touch()
    told = subprocess.run(
        [sys.executable, "-c", KERNELS if how == "a file" else WORLD + KERNELS],
        env={**os.environ, "CAVMARL_CACHE_DIR": str(place), "PYTHONPATH": str(PACKAGE.parent)},
        check=True,
        capture_output=True,
        text=True,
    )
    assert [float(number) for number in told.stdout.split()] == pytest.approx(
        [0.46, 0.72], abs=0.01
    )
    assert told.stderr.count(f"{place} cannot be written") == 1
    assert "CAVMARL_CACHE_DIR" in told.stderr
    assert not list(PACKAGE.rglob("*.nbi")), "nothing beside the sources"


def test_where_the_cache_is(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("CAVMARL_CACHE_DIR", "XDG_CACHE_HOME"):
        monkeypatch.delenv(name, raising=False)
    assert cache_dir() == Path.home() / ".cache" / "cavmarl"
    monkeypatch.setenv("XDG_CACHE_HOME", "relative")
    assert cache_dir() == Path.home() / ".cache" / "cavmarl"
    monkeypatch.setenv("XDG_CACHE_HOME", "/var/shared")
    assert cache_dir() == Path("/var/shared/cavmarl")
    monkeypatch.setenv("CAVMARL_CACHE_DIR", "/own")
    assert cache_dir() == Path("/own")
