"""A barrier of two processes: a waiting process polls for a moment, then it sleeps.

Each of the two sides writes its own cache line of 64-bit words. Word `NUMBER` counts the steps of
its work; word `ASLEEP` says whether the side has to be woken. A waiting side first polls the number
of the other side in a compiled loop, which reacts within a fraction of a microsecond. Then the
waiting side sleeps on a socket, which takes no processor time.

No wake-up is lost, because all accesses are sequentially consistent. Before it sleeps, a side
writes `ASLEEP`, then reads the number of the other side. The other side writes its number, then
reads `ASLEEP`. At least one of the two reads returns the new value: either the first side does not
sleep, or the other side wakes it. A side that sees a number also sees all memory written before.
"""

from __future__ import annotations

import os
import platform
import socket
import time
from contextlib import suppress
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.compiled import IS_PLAIN, kernel, unchecked
from cavmarl.core.compiled.intrinsic import intrinsic

Words = NDArray[np.int64]

WORDS = 8  # words of a line, which is one cache line
NUMBER, ASLEEP = 0, 1  # words that this module uses; callers define the other words

SHORT_S = 20e-6  # a side polls for this time before it sleeps
LONG_S = 200e-6  # a side polls for this time if its previous wait was not longer
LONG_WORK_S = 500e-6  # after longer work, it polls for `SHORT_S`; after a longer wait, not at all
PAUSES = 4  # polls before a side yields the core
ROUNDS = 16  # yields before a side reads the clock
ALONE_S = 300e-6  # a side with a core of its own polls without yielding for this time
AWAKE_S = 10e-3  # within a command, a side polls and yields for this time
NAP_S = 100e-6  # after `AWAKE_S`, a side sleeps for this time between polls
WAKE = b"!"

_PAUSE = {"x86_64": "llvm.x86.sse2.pause", "AMD64": "llvm.x86.sse2.pause"}.get(platform.machine())


def usable_cores() -> set[int]:
    """Return the cores on which this process may run."""
    if hasattr(os, "sched_getaffinity"):
        return os.sched_getaffinity(0)
    return set(range(os.cpu_count() or 1))


def _generate_load(typing: Any, words: Any, at: Any) -> Any:
    from numba.core import types

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        array = context.make_array(signature.args[0])(context, builder, arguments[0])
        place = builder.gep(array.data, [arguments[1]])
        return builder.load_atomic(place, "seq_cst", 8)

    return types.int64(words, types.intp), generate


def _generate_store(typing: Any, words: Any, at: Any, value: Any) -> Any:
    from numba.core import types

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        array = context.make_array(signature.args[0])(context, builder, arguments[0])
        place = builder.gep(array.data, [arguments[1]])
        builder.store_atomic(arguments[2], place, "seq_cst", 8)
        return context.get_dummy_value()

    return types.void(words, types.intp, types.int64), generate


def _generate_pause(typing: Any) -> Any:
    from llvmlite import ir
    from numba.core import cgutils, types

    get_function: Any = cgutils.get_or_insert_function

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        if _PAUSE is not None:
            nothing = ir.FunctionType(ir.VoidType(), [])
            builder.call(get_function(builder.module, nothing, _PAUSE), [])
        return context.get_dummy_value()

    return types.void(), generate


def _generate_system_call(name: str) -> Any:
    """Return a code generator for calls to a C library function that returns an int32."""

    def generator(typing: Any) -> Any:
        from llvmlite import ir
        from numba.core import cgutils, types

        get_function: Any = cgutils.get_or_insert_function

        def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
            kind = ir.FunctionType(ir.IntType(32), [])
            return builder.call(get_function(builder.module, kind, name), [])

        return types.int32(), generate

    return generator


@intrinsic(_generate_load)
def _load(words: Words, at: int) -> int:
    """Read `words[at]` from memory, after all writes of this thread."""
    return int(words[at])


@intrinsic(_generate_store)
def _store(words: Words, at: int, value: int) -> None:
    """Set `words[at] = value`, which other threads see after all earlier writes."""
    words[at] = value


@intrinsic(_generate_pause)
def _pause() -> None:
    """Hint to the processor that this is a spin loop."""


@intrinsic(_generate_system_call("sched_yield"))
def _let_others_run() -> int:
    return 0


@intrinsic(_generate_system_call("sched_getcpu"))
def _core() -> int:
    return -1


@kernel
def _compiled_has(theirs: Words, number: int) -> bool:
    return _load(theirs, NUMBER) >= number


@kernel
def _compiled_set(mine: Words, at: int, value: int, theirs: Words) -> int:
    """Write a word, then return whether the other side sleeps."""
    _store(mine, at, value)
    return _load(theirs, ASLEEP)


@kernel
def _compiled_look(theirs: Words, number: int, yields: bool) -> bool:
    """Return whether the other side reaches a number within some rounds."""
    for _ in range(ROUNDS):
        for _ in range(PAUSES):
            if _load(theirs, NUMBER) >= number:
                return True
            _pause()
        if yields:
            _let_others_run()
    return False


@kernel
def _compiled_pass() -> None:
    _let_others_run()


@kernel
def _compiled_core() -> int:
    return _core()


def _plain_core() -> int:
    return -1


def _plain_pass() -> None:
    pass


def _plain_has(theirs: Words, number: int) -> bool:
    return bool(theirs[NUMBER] >= number)


def _plain_set(mine: Words, at: int, value: int, theirs: Words) -> int:
    mine[at] = value
    return int(theirs[ASLEEP])


def _plain_look(theirs: Words, number: int, yields: bool) -> bool:
    return bool(theirs[NUMBER] >= number)


_has, _set, look, _pass, present_core = (
    (_plain_has, _plain_set, _plain_look, _plain_pass, _plain_core)
    if IS_PLAIN
    else (
        unchecked(_compiled_has),
        unchecked(_compiled_set),
        unchecked(_compiled_look),
        unchecked(_compiled_pass),
        unchecked(_compiled_core),
    )
)


def load_kernels() -> None:
    """Load the compiled loops, for this process and the processes that it forks."""
    words = np.zeros(WORDS, dtype=np.int64)
    _set(words, NUMBER, 1, words)
    _has(words, 1)
    look(words, 1, True)
    _pass()
    present_core()


def post(mine: Words, number: int) -> None:
    """Set the number of this side; the other side must not sleep while it waits for the number."""
    _set(mine, NUMBER, number, mine)


def wait_for(
    theirs: Words,  # (WORDS,) line of the other side
    number: int,  # the awaited number
    # whether the other side was last seen on another core; if so, this side does not yield at
    # first, since another program could keep the core for milliseconds
    is_apart: bool = False,
) -> None:
    """Wait until the other side reaches a number; the wait is short unless that side is dead."""
    if look(theirs, number, False):
        return
    now = time.perf_counter()
    alone, end = now + is_apart * ALONE_S, now + AWAKE_S
    while not look(theirs, number, now >= alone):
        now = time.perf_counter()
        if now > end:
            time.sleep(NAP_S)


class WakeSignal:
    """One side of a pair of processes that wait for, and wake, each other."""

    def __init__(
        self,
        mine: Words,  # (WORDS,) line of this side
        theirs: Words,  # (WORDS,) line of the other side
        wire: socket.socket,  # connection to the other side, over which a sleeping side is woken
        crowded: bool,  # whether there are more processes than cores, so that polling sides yield
    ) -> None:
        self.mine = mine
        self.theirs = theirs
        self.wire = wire
        self._crowded = crowded

    def post(self, number: int) -> None:
        """Set the number of this side, and wake the other side if it sleeps."""
        if self.announce(number):
            self.wake_peer()
        if self._crowded:
            _pass()  # the other side may poll or wake up on this core

    def announce(self, number: int) -> int:
        """Set the number of this side; return 0 unless the other side has to be woken."""
        return _set(self.mine, NUMBER, number, self.theirs)

    def wake_peer(self) -> None:
        with suppress(BrokenPipeError, ConnectionResetError):  # the other process has ended
            self.wire.send(WAKE)

    def has(self, number: int) -> bool:
        return _has(self.theirs, number)

    def watch(
        self,
        number: int,  # the awaited number
        last_s: float,  # duration of the previous wait
        work_s: float = 0.0,  # duration of the work since then
        is_soon: bool = False,  # whether the caller expects a short wait
    ) -> bool:
        """Poll for a moment whether the other side reaches a number.

        After a long wait or long work, a side polls only briefly. The operating system puts waking
        processes on free cores, but leaves polling processes where they are, even two on one core.
        """
        if look(self.theirs, number, self._crowded):
            return True
        if last_s > LONG_WORK_S and not is_soon:
            return False
        is_soon |= last_s < LONG_S and work_s < LONG_WORK_S
        end = time.perf_counter() + (LONG_S if is_soon else SHORT_S)
        while time.perf_counter() < end:
            if look(self.theirs, number, self._crowded):
                return True
        return False

    def announce_sleep(self) -> None:
        """Mark this side as asleep before it sets its next number: the next wait will be long."""
        self.mine[ASLEEP] = 1  # the other side sees this word before or with that number

    def sleep(self, number: int) -> bool:
        """Mark this side as asleep; return False if the other side has reached the number."""
        _set(self.mine, ASLEEP, 1, self.theirs)
        if self.has(number):
            self.wake()
            return False
        return True

    def wake(self) -> None:
        _set(self.mine, ASLEEP, 0, self.theirs)
