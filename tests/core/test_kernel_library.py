"""The library of compiled kernels in a wheel: used if it suits the machine, else refused."""

from __future__ import annotations

import ctypes
import json
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cavmarl.core.compiled import IS_PLAIN, kernel, library, machine_code
from cavmarl.core.compiled.arguments import Words, accepts, result_reader
from cavmarl.core.compiled.library import INDEX_FILE, LIBRARY_FILE, Library, UnusableLibraryError
from cavmarl.core.compiled.signatures import signature_of
from cavmarl.core.compiled.sources import module_digest
from cavmarl.core.errors import KernelError
from cavmarl.core.math.bearings import rough_atan2
from cavmarl.driving.driver_models import REGISTERED_MODELS, register_driver_model
from cavmarl.prebuild.call_list import (
    KernelCall,
    can_be_made,
    marked,
    merged,
    read_manifest,
    recorded_calls,
    write_manifest,
)
from cavmarl.prebuild.compile_calls import compile_call, widest
from cavmarl.prebuild.kernel_list import called_kernels
from cavmarl.prebuild.linking import link

compiled_only = pytest.mark.skipif(IS_PLAIN, reason="nothing is compiled")
pytestmark = pytest.mark.integration  # the linker is a process

NAME = "cavmarl.core.math.bearings.rough_atan2"
TYPES = "float64;float64"


@pytest.fixture(scope="module")
def built_library(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Build a library of one kernel."""
    folder = tmp_path_factory.mktemp("built")
    link([compile_call(KernelCall(NAME, json.dumps(signature_of((1.0, 2.0)))))], folder)
    return folder


@pytest.fixture
def copied_library(built_library: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(built_library, tmp_path / "prebuilt"))


@pytest.fixture
def uncached(monkeypatch: pytest.MonkeyPatch) -> Iterator[pytest.MonkeyPatch]:
    """Clear the data about kernels that this process has cached, before and after the test."""
    for cached in (machine_code.kernel_source, machine_code.explain):
        cached.cache_clear()
    yield monkeypatch
    monkeypatch.undo()
    for cached in (machine_code.kernel_source, machine_code.explain):
        cached.cache_clear()


def _digest() -> str:
    return module_digest(NAME.rpartition(".")[0])


@compiled_only
def test_a_kernel_of_the_library_returns_the_same_as_a_compiled_kernel(built_library: Path) -> None:
    found = Library(built_library).find(NAME, TYPES, _digest())
    assert found is not None
    words = Words(3)
    words.floats[0], words.floats[1] = 1.0, -2.5
    enter: Any = ctypes.CFUNCTYPE(ctypes.c_int32, ctypes.c_void_p)(found.address)
    assert enter(words.address) == 0
    assert result_reader(found.result, 2)[1](words) == rough_atan2(1.0, -2.5)


@compiled_only
def test_a_kernel_with_other_types_or_sources_is_not_found(built_library: Path) -> None:
    opened = Library(built_library)
    assert opened.find(NAME, "float64;int64", _digest()) is None
    assert opened.find(NAME, TYPES, "0" * 16) is None
    assert opened.find("cavmarl.core.math.rng.below", TYPES, _digest()) is None


@compiled_only
def test_calls_are_not_compiled_if_more_general_code_serves_them() -> None:
    rows = np.zeros((4, 2))
    wide, narrow, other = (
        KernelCall(
            f"cavmarl.core.math.elementary_arrays.{name}", json.dumps(signature_of((array,)))
        )
        for name, array in (
            ("apply_sin", rows[:, 0]),
            ("apply_sin", rows[0]),
            ("apply_cos", rows[0]),
        )
    )
    assert widest([wide, narrow, other]) == [wide, other]
    assert widest([narrow, other, wide]) == [other, wide]


def _flip(path: Path, place: int) -> None:
    content = bytearray(path.read_bytes())
    content[place] ^= 1
    path.write_bytes(content)


@compiled_only
@pytest.mark.parametrize("name", [LIBRARY_FILE, INDEX_FILE])
@pytest.mark.parametrize("harm", ["flipped", "truncated", "empty"])
def test_a_damaged_file_is_refused(copied_library: Path, name: str, harm: str) -> None:
    path = copied_library / name
    size = path.stat().st_size
    if harm == "flipped":
        _flip(path, size // 2)
    else:
        path.write_bytes(path.read_bytes()[: size // 2 if harm == "truncated" else 0])
    with pytest.raises(UnusableLibraryError, match="is damaged: install cavmarl again"):
        Library(copied_library)


@compiled_only
def test_a_missing_library_is_refused(copied_library: Path) -> None:
    (copied_library / LIBRARY_FILE).unlink()
    with pytest.raises(UnusableLibraryError, match="cannot be read"):
        Library(copied_library)
    (copied_library / INDEX_FILE).unlink()
    with pytest.raises(UnusableLibraryError, match="this installation contains no library"):
        Library(copied_library)


def _change_index(folder: Path, **changes: Any) -> None:
    index = json.loads((folder / INDEX_FILE).read_text())
    del index["index_sha256"]
    index |= changes
    index["index_sha256"] = library.index_digest(index)
    (folder / INDEX_FILE).write_text(json.dumps(index))


@compiled_only
def test_a_library_for_another_interpreter_or_of_another_format_is_refused(
    copied_library: Path,
) -> None:
    _change_index(copied_library, python="cpython-399-x86_64-linux-gnu")
    with pytest.raises(UnusableLibraryError, match="is for cpython-399"):
        Library(copied_library)
    _change_index(copied_library, format=0)
    with pytest.raises(UnusableLibraryError, match="has format 0, must be 1"):
        Library(copied_library)


@compiled_only
def test_the_error_for_a_processor_without_avx2_names_the_feature(
    built_library: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    opened = ctypes.CDLL(str(built_library / LIBRARY_FILE))
    flags = Path("/proc/cpuinfo").read_text()
    assert (library.missing_features(opened, "x86-64-v3") == []) == (" avx2 " in flags)
    monkeypatch.setattr(library, "LEVEL_WORDS", ({}, {"AVX2": 5, "no such feature": 60}, {}, {}))
    with pytest.raises(UnusableLibraryError, match="this processor lacks no such feature"):
        Library(built_library)


@compiled_only
def test_if_the_library_is_damaged_kernels_are_compiled_or_refused(
    copied_library: Path,
    uncached: pytest.MonkeyPatch,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    uncached.setenv("CAVMARL_CACHE_DIR", str(tmp_path / "cache"))
    uncached.setattr(library, "FOLDER", copied_library)
    uncached.setattr(Library.__init__, "__defaults__", (copied_library,))
    function: Any = rough_atan2
    expected = rough_atan2(1.0, 2.0)
    again: Any = kernel(function.py_func)
    assert again(1.0, 2.0) == expected
    assert not (tmp_path / "cache").exists(), "a kernel of the library was compiled"
    # A second copy, because the first file is loaded and must not change.
    damaged = Path(shutil.copytree(copied_library, tmp_path / "damaged"))
    _flip(damaged / LIBRARY_FILE, 1000)
    uncached.setattr(Library.__init__, "__defaults__", (damaged,))
    uncached.setattr(library, "FOLDER", damaged)
    machine_code.kernel_source.cache_clear()
    again = kernel(function.py_func)
    assert again(1.0, 2.0) == expected
    assert len(list((tmp_path / "cache").rglob("*.kernel"))) == 1
    said = capsys.readouterr().err
    assert said.count("a kernel is compiled on this machine, as ") == 1
    assert "is damaged: install cavmarl again" in said
    uncached.setenv("CAVMARL_KERNELS", "prebuilt")
    machine_code.kernel_source.cache_clear()
    with pytest.raises(KernelError, match=r"no compiled kernels to use, as .* is damaged"):
        kernel(function.py_func)(1.0, 2.0)


@compiled_only
def test_a_missing_kernel_is_refused_if_only_prebuilt_kernels_are_allowed(
    copied_library: Path, uncached: pytest.MonkeyPatch
) -> None:
    uncached.setattr(Library.__init__, "__defaults__", (copied_library,))
    uncached.setenv("CAVMARL_KERNELS", "prebuilt")
    function: Any = rough_atan2
    with pytest.raises(KernelError, match=r"types int64;float64; set CAVMARL_KERNELS=auto"):
        kernel(function.py_func)(1, 2.0)


@compiled_only
def test_wrong_settings_and_a_missing_compiler_are_errors(
    uncached: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    function: Any = rough_atan2
    uncached.setenv("CAVMARL_KERNELS", "fastest")
    with pytest.raises(KernelError, match="fastest: must be one of auto, prebuilt, native"):
        kernel(function.py_func)(1.0, 2.0)
    uncached.setenv("CAVMARL_KERNELS", "native")
    machine_code.kernel_source.cache_clear()
    uncached.setattr(machine_code, "numba_version", lambda: "")
    with pytest.raises(KernelError, match=r"rough_atan2 has to be compiled, as .*\[compile\]"):
        kernel(function.py_func)(1.0, 2.0)


@compiled_only
def test_a_registered_driver_model_is_entered_in_the_table_of_the_library(
    built_library: Path,
) -> None:
    def hold(
        speed: float, allowed: float, gap: float, front_speed: float, min_gap: float,
        tau: float, accel: float, decel: float,
    ) -> float:  # fmt: skip
        return 0.0

    Library(built_library)
    register_driver_model("hold_of_the_library_test", hold)
    try:
        row = REGISTERED_MODELS["hold_of_the_library_test"] - 16
        opened = ctypes.CDLL(str(built_library / LIBRARY_FILE))
        copy = (ctypes.c_int64 * 64).in_dll(opened, "cavmarl_driver_models")
        assert copy[row] != 0
    finally:
        REGISTERED_MODELS.remove("hold_of_the_library_test")


def test_the_list_contains_exactly_the_kernels_that_python_calls() -> None:
    assert called_kernels() == {call.name for call in read_manifest()}


@compiled_only
def test_the_types_of_each_call_of_the_list_suit_the_present_kernel() -> None:
    calls = read_manifest()
    assert [call.name for call in calls if not can_be_made(call)] == []
    by_name = {call.name.rpartition(".")[2]: call for call in calls}
    departures, ticks = by_name["call_orders"].kinds
    keys, worlds = by_name["assign_lanes"].kinds[3], by_name["populate"].kinds[4]
    name = by_name["call_orders"].name
    assert can_be_made(KernelCall(name, json.dumps([departures, ticks])))
    assert not can_be_made(KernelCall(name, json.dumps([departures, ticks, keys]))), (
        "a call with an added parameter was accepted"
    )
    assert not can_be_made(KernelCall(name, json.dumps([departures, worlds]))), (
        "a call with the wrong bundle was accepted"
    )


def test_kernels_that_a_plain_world_calls_are_marked_in_the_list() -> None:
    names = {call.name.rpartition(".")[2] for call in read_manifest() if call.is_plain}
    assert {"advance_each", "sense_each", "populate"} <= names
    assert "mirror" not in names


def test_a_written_list_is_read_unchanged(tmp_path: Path) -> None:
    calls = read_manifest()
    write_manifest(reversed(calls), tmp_path / "list.json")
    assert read_manifest(tmp_path / "list.json") == calls
    few = {call for call in calls if call.is_plain}
    assert {call for call in marked(calls, marked(few, set())) if call.is_plain} == few


@compiled_only
def test_calls_from_the_package_are_recorded_and_calls_from_tests_are_not(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from cavmarl.core.math import rng
    from cavmarl.traffic.demand.drawing import chances

    monkeypatch.setenv("CAVMARL_KERNEL_CALLS", str(tmp_path))
    plain: Any = rng.fill_uniform
    monkeypatch.setattr("cavmarl.traffic.demand.drawing.fill_uniform", kernel(plain.py_func))
    chances(np.uint64(1), np.zeros(2, np.int64), np.zeros(2, np.int64), 1)
    function: Any = rough_atan2
    kernel(function.py_func)(1.0, 2.0)
    assert {call.name for call in recorded_calls(tmp_path)} == {
        "cavmarl.core.math.rng.fill_uniform"
    }


@pytest.mark.parametrize(
    ("compiled", "called", "fits"),
    [
        ("<f8[1C readonly];int64", "<f8[1C];int64", True),
        ("<f8[1C];int64", "<f8[1C readonly];int64", False),
        ("<f8[2A]", "<f8[2C]", True),
        ("<f8[2C]", "<f8[2A]", False),
        ("<f8[2A]", "<f8[1C]", False),
        ("<f8[2A]", "<f4[2C]", False),
        ("<f8[1C readonly];<f8[1C]", "<f8[1C];<f8[1C]", True),
        ("<f8[1C readonly];<f8[1C]", "<f8[1C];<f8[1C readonly]", False),
        ("<f8[1C]", "<f8[1C unaligned]", False),
    ],
)
def test_code_accepts_arrays_with_at_least_the_properties_it_relies_on(
    compiled: str, called: str, fits: bool
) -> None:
    assert accepts(compiled, called) == fits


def test_calls_that_differ_only_in_write_protection_are_compiled_once() -> None:
    def call(*layouts: str) -> KernelCall:
        return KernelCall("k", json.dumps([{"array": "<f8", "layout": text} for text in layouts]))

    found = merged({call("1C", "1C readonly"), call("1C readonly", "1C"), call("1C", "1A")})
    assert found == {call("1C readonly", "1C readonly"), call("1C", "1A")}


@compiled_only
def test_code_that_does_not_write_accepts_a_read_only_array() -> None:
    @kernel
    def total(values: Any) -> float:
        found = 0.0
        for k in range(values.shape[0]):
            found += values[k]
        return found

    constant = np.ones(3)
    constant.flags.writeable = False
    assert total(constant) == total(np.ones(3)) == 3.0
