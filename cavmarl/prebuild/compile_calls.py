"""Compiles kernels in several processes, and reports the progress."""

from __future__ import annotations

import importlib
import os
import sys
import time
from collections.abc import Iterable, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from multiprocessing import get_context
from typing import Any, TextIO

from cavmarl.core.compiled.arguments import accepts, type_of
from cavmarl.core.compiled.compiler import compile_kernel
from cavmarl.core.compiled.kernel_files import CompiledKernel, KernelFile
from cavmarl.core.compiled.signatures import example_arguments
from cavmarl.prebuild.call_list import KernelCall

_LINE_S = 5.0  # time between two lines if the output is not a terminal


def kernel_file(call: KernelCall) -> KernelFile:
    """Return the file for the code of a call on this machine."""
    types = ";".join(type_of(argument).text for argument in example_arguments(call.kinds))
    return KernelFile(_function_of(call), types)


def widest(calls: Iterable[KernelCall]) -> list[KernelCall]:
    """Return the calls, except calls for which the code of another call can be used.

    Code for an array of any layout, for example, also serves calls with a contiguous array.
    """
    kept: list[tuple[KernelCall, str]] = []
    for call in calls:
        types = kernel_file(call).types
        if any(call.name == other.name and accepts(wide, types) for other, wide in kept):
            continue
        kept = [
            (other, narrow)
            for other, narrow in kept
            if call.name != other.name or not accepts(types, narrow)
        ]
        kept.append((call, types))
    return [call for call, _ in kept]


def compile_into_cache(
    calls: Iterable[KernelCall], processes: int, output: TextIO = sys.stderr
) -> int:
    """Compile the kernels that are not in this machine's cache; return their number."""
    missing = [call for call in widest(calls) if kernel_file(call).load() is None]
    if not missing:
        return 0
    longest_first = sorted(missing, key=_weight, reverse=True)
    with (
        _Progress(longest_first, output) as progress,
        ProcessPoolExecutor(processes, mp_context=get_context("spawn")) as pool,
    ):
        running = {pool.submit(_compile_and_store, call): call for call in longest_first}
        for done in as_completed(running):
            done.result()
            progress.advance(running[done])
    return len(missing)


def compile_call(call: KernelCall) -> CompiledKernel:
    """Compile a kernel for the argument types of a call."""
    file = kernel_file(call)
    arguments = example_arguments(call.kinds)
    result, code = compile_kernel(_function_of(call), arguments, file.symbol)
    return CompiledKernel(file.name, file.types, result, file.symbol, code)


def _compile_and_store(call: KernelCall) -> None:
    file = kernel_file(call)
    with file.locked():
        if file.load() is None:
            file.save(compile_call(call))


def _function_of(call: KernelCall) -> Any:
    module, _, name = call.name.rpartition(".")
    return getattr(importlib.import_module(module), name).py_func


def _weight(call: KernelCall) -> int:
    """Return a number that grows with the compile time of a kernel: the size of its arguments."""
    return len(call.signature) ** 2


class _Progress:
    """Prints the number of compiled kernels, and an estimate of the remaining time."""

    def __init__(self, calls: Sequence[KernelCall], output: TextIO) -> None:
        self._count = len(calls)
        self._weight = sum(map(_weight, calls))
        self._output = output
        self._is_terminal = output.isatty()
        self._done = self._done_weight = 0
        self._started = self._last = time.monotonic()

    def __enter__(self) -> _Progress:
        return self

    def __exit__(self, *_: object) -> None:
        if self._is_terminal:
            print("\r\x1b[K", end="", file=self._output, flush=True)

    def advance(self, call: KernelCall) -> None:
        """Count a finished kernel."""
        self._done += 1
        self._done_weight += _weight(call)
        now = time.monotonic()
        if self._is_terminal or now - self._last >= _LINE_S or self._done == self._count:
            self._last = now
            self._write(now - self._started)

    def _write(self, elapsed_s: float) -> None:
        left_s = elapsed_s * (self._weight - self._done_weight) / self._done_weight
        text = (
            f"cavmarl: compiled {self._done} of {self._count} kernels in {elapsed_s:.0f} s, "
            f"about {left_s:.0f} s left"
        )
        start, end = ("\r\x1b[K", "") if self._is_terminal else ("", "\n")
        print(f"{start}{text}", end=end, file=self._output, flush=True)


def usable_processes() -> int:
    """Return the number of compiling processes: two, or one on a single core."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    return min(2, cores or 1)
