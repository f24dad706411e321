"""How a process waits for another: it polls for a moment, then it sleeps.

Each side has a line of 64-bit words that only itself writes. Word `NUMBER` counts what it has done;
word `ASLEEP` says whether it has to be woken. To wait is to look at the other's number for a while
in a compiled loop, which costs a fraction of a microsecond, and then to sleep on a socket, which
costs no processor at all.

All words are read and written sequentially consistent, so of two that write one word and read the
other's, at least one sees what the other wrote: the side about to sleep sees the number, or the
side that has written the number sees that the other sleeps. And a side that sees a number sees all
written before it.
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

WORDS = 8  # of a line; of a cache line, too
NUMBER, ASLEEP = 0, 1  # words of either side; the others are the pool's

SHORT_S = 20e-6  # that a side polls before it sleeps
LONG_S = 200e-6  # that it polls where the last time has not been longer
LONG_WORK_S = 500e-6  # after which no side polls for so long
PAUSES = 4  # polls before it lets others run
ROUNDS = 16  # of those before it reads the clock
ALONE_S = 300e-6  # of polling without a break by a side with a core for itself
AWAKE_S = 10e-3  # of polling for a part of a command that lets others run in between
NAP_S = 100e-6  # that it sleeps between them from then on
WAKE = b"!"

_PAUSE = {"x86_64": "llvm.x86.sse2.pause", "AMD64": "llvm.x86.sse2.pause"}.get(platform.machine())


def usable_cores() -> set[int]:
    """The cores that this process may run on."""
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
    """Return a generator of calls to a function of the C library that gives an int32."""

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
    """Read `words[at]` anew, after all that this thread has written."""
    return int(words[at])


@intrinsic(_generate_store)
def _store(words: Words, at: int, value: int) -> None:
    """Set `words[at] = value`, seen by others after all that was written before."""
    words[at] = value


@intrinsic(_generate_pause)
def _pause() -> None:
    """Tell the processor that this is a loop of waiting."""


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
    """Write a word, then read whether the other side sleeps."""
    _store(mine, at, value)
    return _load(theirs, ASLEEP)


@kernel
def _compiled_look(theirs: Words, number: int, yields: bool) -> bool:
    """Whether the other side comes to a number within some rounds."""
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


_has, _set, _look, _pass, present_core = (
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
    """Have the loops ready, for this process and those that it forks."""
    words = np.zeros(WORDS, dtype=np.int64)
    _set(words, NUMBER, 1, words)
    _has(words, 1)
    _look(words, 1, True)
    _pass()
    present_core()


def post(mine: Words, number: int) -> None:
    """Come to a number, for sides that never sleep until it is there."""
    _set(mine, NUMBER, number, mine)


def wait_for(
    theirs: Words,  # (WORDS,) that the other side writes
    number: int,  # to wait for
    # the other side was on another core when it was seen last. Then the core is not yielded for a
    # while: of other programs that have the same core, one that is may keep it for milliseconds
    is_apart: bool = False,
) -> None:
    """Return when the other side comes to a number, which it does soon unless it is dead."""
    if _look(theirs, number, False):
        return
    now = time.perf_counter()
    alone, end = now + is_apart * ALONE_S, now + AWAKE_S
    while not _look(theirs, number, now >= alone):
        now = time.perf_counter()
        if now > end:
            time.sleep(NAP_S)


class WakeSignal:
    """One side of a place where two processes wait for each other."""

    def __init__(
        self,
        mine: Words,  # (WORDS,) that this side writes
        theirs: Words,  # (WORDS,) that the other one writes
        wire: socket.socket,  # socket to the other side; a sleeping side is woken through it
        # more processes take part than there are cores, so a polling side lets others run
        crowded: bool,
    ) -> None:
        self.mine = mine
        self.theirs = theirs
        self.wire = wire
        self._crowded = crowded

    def post(self, number: int) -> None:
        if self.announce(number):
            self.wake_peer()
        if self._crowded:
            _pass()  # the other side may look from this core, or wake up on it

    def announce(self, number: int) -> int:
        """Come to a number; not 0: the other side sleeps, and has to be woken."""
        return _set(self.mine, NUMBER, number, self.theirs)

    def wake_peer(self) -> None:
        with suppress(BrokenPipeError, ConnectionResetError):  # its process has ended
            self.wire.send(WAKE)

    def has(self, number: int) -> bool:
        return _has(self.theirs, number)

    def watch(
        self,
        number: int,  # to wait for
        last_s: float,  # how long it has had to wait the last time
        work_s: float = 0.0,  # since this side waited last
        is_soon: bool = False,  # it is known that it does not take long
    ) -> bool:
        """Look for a moment whether the other side comes to a number.

        A side that waited for long the last time does not poll for long, nor one that worked for
        long: the system puts waking processes on free cores, and leaves polling ones where they
        are, two on one core if it comes to that.
        """
        if _look(self.theirs, number, self._crowded):
            return True
        if last_s > LONG_WORK_S and not is_soon:
            return False
        is_soon |= last_s < LONG_S and work_s < LONG_WORK_S
        end = time.perf_counter() + (LONG_S if is_soon else SHORT_S)
        while time.perf_counter() < end:
            if _look(self.theirs, number, self._crowded):
                return True
        return False

    def announce_sleep(self) -> None:
        """Say that this side sleeps when it comes to its next number: it will have to wait long."""
        self.mine[ASLEEP] = 1  # seen with that number, or before

    def sleep(self, number: int) -> bool:
        """Say that this side sleeps from here on; False: there is no need any more."""
        _set(self.mine, ASLEEP, 1, self.theirs)
        if self.has(number):
            self.wake()
            return False
        return True

    def wake(self) -> None:
        _set(self.mine, ASLEEP, 0, self.theirs)
