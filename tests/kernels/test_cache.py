"""Where compiled kernels are kept: nobody is handed out code of a file that has changed."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

from cavmarl import kernels

SOURCES = {path.stem: path.read_bytes() for path in Path(kernels.__file__).parent.glob("*.py")}


def _folders(monkeypatch: pytest.MonkeyPatch, changed: str = "") -> dict[str, Path]:
    """The folder of each file of kernels, if one of them has another line."""
    sources = {**SOURCES, **({changed: SOURCES[changed] + b"\n"} if changed else {})}
    monkeypatch.setattr(kernels, "_sources", lambda: sources)
    kernels._cache_dir_of.cache_clear()
    try:
        return {name: kernels._cache_dir_of(f"cavmarl.kernels.{name}") for name in SOURCES}
    finally:
        kernels._cache_dir_of.cache_clear()


def test_a_change_moves_the_kernels_that_call_what_has_changed_and_no_others(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    before = _folders(monkeypatch)
    after = _folders(monkeypatch, "geometry")
    moved = {name for name in SOURCES if before[name] != after[name]}
    # `phases` calls `tick`, which calls `contacts`.
    assert {"geometry", "contacts", "tick", "phases"} <= moved
    assert moved.isdisjoint({"rng", "krauss", "buckets"})


@pytest.mark.parametrize("changed", ["__init__", "compiler"])
def test_flags_and_the_compiler_concern_all(monkeypatch: pytest.MonkeyPatch, changed: str) -> None:
    before, after = _folders(monkeypatch), _folders(monkeypatch, changed)
    assert all(before[name] != after[name] for name in SOURCES)


@pytest.mark.parametrize("name", sorted(SOURCES))
def test_every_import_of_another_file_is_seen(name: str) -> None:
    found = {other.decode() for other in kernels._IMPORT.findall(SOURCES[name])}
    imported = set()
    for node in ast.walk(ast.parse(SOURCES[name])):
        if isinstance(node, ast.ImportFrom):
            assert node.level == 0, (
                f"{name}: imports by the full name are those that are looked for"
            )
            module = node.module or ""
            if module.startswith("cavmarl.kernels."):
                imported.add(module.removeprefix("cavmarl.kernels."))
            elif module == "cavmarl.kernels":
                assert not {alias.name for alias in node.names} & set(SOURCES)
        elif isinstance(node, ast.Import):
            assert not any(alias.name.startswith("cavmarl") for alias in node.names)
    assert found == imported
