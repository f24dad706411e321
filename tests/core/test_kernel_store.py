"""The cache of compiled kernels: code of changed or damaged files is never used."""

from __future__ import annotations

import ast
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from cavmarl.core.cache_folder import cache_dir
from cavmarl.core.compiled import IS_PLAIN, kernel, sources
from cavmarl.core.compiled.kernel_files import CompiledKernel, KernelFile, pack, unpack
from cavmarl.core.compiled.machine_code import CompileListener, listeners
from cavmarl.core.math.bearings import rough_atan2

SOURCES = sources.kernel_sources()
PACKAGE = Path(sources.__file__).parents[2]
compiled_only = pytest.mark.skipif(IS_PLAIN, reason="nothing is compiled")


def _digests(monkeypatch: pytest.MonkeyPatch, changed: str = "") -> dict[str, str]:
    """Return the digest of each source file, after the file `changed` gets another line."""
    content = {**SOURCES, **({changed: SOURCES[changed] + b"\n"} if changed else {})}
    monkeypatch.setattr(sources, "kernel_sources", lambda: content)
    return {name: sources.module_digest.__wrapped__(f"cavmarl.{name}") for name in SOURCES}


class Compiled(CompileListener):
    """A context that lists the kernels that are compiled within it."""

    def __init__(self) -> None:
        self.names: list[str] = []

    def __enter__(self) -> list[str]:
        listeners.append(self)
        return self.names

    def __exit__(self, *_: object) -> None:
        listeners.remove(self)

    def on_compile(self, name: str) -> None:
        self.names.append(name.rpartition(".")[2])


def test_the_sources_include_every_folder_of_kernels() -> None:
    folders = {path.parent for path in PACKAGE.rglob("kernels/**/*.py")}
    assert len(folders) > 8
    for folder in folders:
        assert ".".join(folder.relative_to(PACKAGE).parts) in SOURCES
    assert {"core.math.rng", "core.records.codes", "core.compiled.compiler"} <= SOURCES.keys()


def test_a_change_affects_only_kernels_that_call_the_changed_code(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    before = _digests(monkeypatch)
    after = _digests(monkeypatch, "core.math.geometry")
    moved = {name for name in SOURCES if before[name] != after[name]}
    # `group_phases` calls `world_phases`, which calls `contacts`.
    called = {"driving.kernels.motion.contacts", "shards.kernels.world_phases"}
    assert {"core.math.geometry", "shards.kernels.group_phases", *called} <= moved
    assert moved.isdisjoint({"core.math.rng", "driving.kernels.models.krauss", "core.math.buckets"})


@pytest.mark.parametrize("changed", sources.COMPILER_FILES)
def test_a_change_of_the_compiler_affects_all_kernels(
    monkeypatch: pytest.MonkeyPatch, changed: str
) -> None:
    before, after = _digests(monkeypatch), _digests(monkeypatch, changed)
    assert all(before[name] != after[name] for name in SOURCES)


@pytest.mark.parametrize("name", sorted(set(SOURCES) - set(sources.COMPILER_FILES)))
def test_every_import_of_another_source_file_is_found(name: str) -> None:
    found = {other.decode() for other in sources.IMPORT_LINE.findall(SOURCES[name])}
    imported = set()
    for node in ast.walk(ast.parse(SOURCES[name])):
        if isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{name}: a relative import is not found"
            module = node.module or ""
            # Files of `core.compiled` belong to the compiler, whose changes affect all kernels.
            if module.startswith("cavmarl.") and not module.startswith("cavmarl.core.compiled"):
                imported.add(module.removeprefix("cavmarl."))
                # `from folder import module` would not be found.
                assert not {f"{module[8:]}.{alias.name}" for alias in node.names} & set(SOURCES)
        elif isinstance(node, ast.Import):
            assert not any(alias.name.startswith("cavmarl") for alias in node.names)
    found = {other for other in found if not other.startswith("core.compiled")}
    assert found == imported
    assert found <= SOURCES.keys()


@compiled_only
@pytest.mark.parametrize("harm", [None, b"", b"cut", b"flipped"])
def test_a_damaged_file_is_compiled_again(
    tmp_path: Path, harm: bytes | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("CAVMARL_CACHE_DIR", str(tmp_path))
    function: Any = rough_atan2
    function = function.py_func
    with Compiled() as names:
        first = kernel(function)(1.0, 2.0)
    assert names == ["rough_atan2"]
    (file,) = tmp_path.rglob("*.kernel")
    content = file.read_bytes()
    middle = len(content) // 2
    flipped = content[:middle] + bytes([content[middle] ^ 255]) + content[middle + 1 :]
    if harm is not None:
        file.write_bytes({b"": b"", b"cut": content[:middle], b"flipped": flipped}[harm])
    with Compiled() as names:
        assert kernel(function)(1.0, 2.0) == first
    assert names == ([] if harm is None else ["rough_atan2"])
    assert unpack(file.read_bytes()) is not None
    assert sorted(tmp_path.rglob("*.*")) == [file], "temporary files remain"


def test_a_file_with_a_changed_or_missing_byte_is_not_read() -> None:
    content = pack(CompiledKernel("module.name", "float64", "float", "symbol", b"machine code"))
    assert unpack(content) is not None
    for place, byte in enumerate(content):
        for other in {byte ^ 1, byte ^ 128, 0, 255} - {byte}:
            assert unpack(content[:place] + bytes([other]) + content[place + 1 :]) is None
        assert unpack(content[:place]) is None


def _adder(step: Any) -> Any:
    def add(number: int) -> int:
        return number + step

    return add


@compiled_only
def test_the_cache_distinguishes_functions_with_other_captured_values(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("CAVMARL_CACHE_DIR", str(tmp_path))
    assert [kernel(_adder(step))(1) for step in (1, 2, 1)] == [2, 3, 2]
    assert len(list(tmp_path.rglob("*.kernel"))) == 2


def test_a_function_that_captures_an_object_is_not_cached() -> None:
    file = KernelFile(_adder(object()), "int64")
    assert file.load() is None
    with file.locked():
        file.save(CompiledKernel("", "", "", "", b""))
    assert file.load() is None


COMPILE_AND_PRINT = """
import sys
from cavmarl.core.compiled.machine_code import CompileListener, listeners
from cavmarl.core.math.bearings import rough_atan2

class Told(CompileListener):
    def on_compile(self, name):
        print(name.rpartition(".")[2])

listeners.append(Told())
print(rough_atan2(1.0, 2.0))
"""


@compiled_only
def test_if_several_processes_need_a_kernel_only_one_compiles_it(tmp_path: Path) -> None:
    environment = {
        **os.environ,
        "CAVMARL_CACHE_DIR": str(tmp_path),
        "CAVMARL_KERNELS": "native",
        "PYTHONPATH": str(PACKAGE.parent),
    }
    command = [sys.executable, "-c", COMPILE_AND_PRINT]
    running = [
        subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, text=True)
        for _ in range(3)
    ]
    told = [process.communicate()[0].split() for process in running]
    assert sorted(len(words) for words in told) == [1, 1, 2], told
    assert len({words[-1] for words in told}) == 1


WORLD = """
from cavmarl import parallel_env
parallel_env("ring", agents=1, background=0)
"""
KERNELS = """
from cavmarl.core.math.bearings import rough_atan2
from cavmarl.core.math.geometry import wrap_angle
print(rough_atan2(1.0, 2.0), wrap_angle(7.0))
"""


@compiled_only
@pytest.mark.parametrize("how", ["no folder", "a file"])
def test_a_cache_folder_that_cannot_be_written_is_reported_once(tmp_path: Path, how: str) -> None:
    place = tmp_path / "cache" if how == "a file" else Path("/proc/cavmarl")
    if how == "a file":
        place.touch()
    told = subprocess.run(
        [sys.executable, "-c", KERNELS if how == "a file" else WORLD + KERNELS],
        env={
            **os.environ,
            "CAVMARL_CACHE_DIR": str(place),
            "CAVMARL_KERNELS": "native",
            "PYTHONPATH": str(PACKAGE.parent),
        },
        check=True,
        capture_output=True,
        text=True,
    )
    assert [float(number) for number in told.stdout.split()] == pytest.approx(
        [0.46, 0.72], abs=0.01
    )
    assert told.stderr.count(f"{place} cannot be written") == 1
    assert "CAVMARL_CACHE_DIR" in told.stderr
    assert not list(PACKAGE.rglob("*.kernel")), "a file was written beside the sources"


def test_environment_variables_select_the_cache_folder(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    for name in ("CAVMARL_CACHE_DIR", "XDG_CACHE_HOME"):
        monkeypatch.delenv(name, raising=False)
    assert cache_dir() == Path.home() / ".cache" / "cavmarl"
    monkeypatch.setenv("XDG_CACHE_HOME", "relative")
    assert cache_dir() == Path.home() / ".cache" / "cavmarl"
    monkeypatch.setenv("XDG_CACHE_HOME", "/var/shared")
    assert cache_dir() == Path("/var/shared/cavmarl")
    monkeypatch.setenv("CAVMARL_CACHE_DIR", "/own")
    assert cache_dir() == Path("/own")
