"""Where compiled kernels are kept: code of a file that has changed is never used."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

from cavmarl.core import numba as kernels

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


def test_every_folder_of_kernels_is_read() -> None:
    folders = {path.parent for path in PACKAGE.rglob("kernels/*.py")}
    assert len(folders) > 8
    for folder in folders:
        assert ".".join(folder.relative_to(PACKAGE).parts) in SOURCES
    assert {"core.math.rng", "core.records.codes", "core.numba.repeated"} <= SOURCES.keys()


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


@pytest.mark.parametrize("changed", ["core.numba", "core.numba.compiler"])
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
