"""`SumoProcess`: a process that runs the SUMO of one world."""

from __future__ import annotations

import json
import os
import socket
import subprocess
import tempfile
import weakref
from collections.abc import Mapping
from importlib.util import find_spec
from typing import IO, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.errors import ConfigError, SumoError, missing
from cavmarl.core.huge_pages import huge_heap
from cavmarl.core.processes import (
    end_process,
    is_fork,
    last_words,
    occupy_standard_descriptors,
    refuse_fork,
    start_python,
)
from cavmarl.roads.sumo_net.xml_source import limit
from cavmarl.traffic.sumo import sumo_child as child
from cavmarl.traffic.sumo.sumo_history import MOVED, SEEN

ANSWER_S = 120.0  # a process whose step takes longer counts as hung
MAX_SUMO_BYTES = 1 << 35
MEMORY_LIMIT = "CAVMARL_MAX_SUMO_BYTES"  # environment variable that overrides this limit
END_S = 2.0  # time for the process to end by itself
# Messages of SUMO, Python and the system when memory runs out.
OUT_OF_MEMORY = ("bad_alloc", "MemoryError", "Cannot allocate memory")


class SumoAnswer(NamedTuple):
    """SUMO's answer after a step."""

    seen: NDArray[np.void]  # SEEN (n,) by ascending number
    letters: bytes  # letters of all signals, one signal after the other
    # `time_ms`, and rare events: `departed`, `teleported`, `dropped`, `routes`, `ways`, `unseen`
    line: dict[str, Any]


def choose_interface(wanted: str) -> str:
    """Return the interface to use; for `auto`, `libsumo` or, if not installed, `traci`.

    Raises MissingExtraError: the interface is not installed.
    """
    choices = ("libsumo", "traci") if wanted == "auto" else (wanted,)
    for name in choices:
        if find_spec(name) is not None:
            return name
    raise missing(choices[0], "sumo")


class SumoProcess:
    """A process that runs SUMO and serves one request at a time.

    Args:
        setup: sent once, together with the layouts of records.

    Attributes:
        pid: process id.
    """

    def __init__(self, setup: Mapping[str, Any]) -> None:
        occupy_standard_descriptors()
        ours, theirs = socket.socketpair()
        output = tempfile.TemporaryFile()
        self._most_bytes = limit(MEMORY_LIMIT, MAX_SUMO_BYTES)
        with theirs:
            process = start_python(
                [child.__file__, str(theirs.fileno()), str(self._most_bytes)],
                # SUMO's memory access is scattered, so huge pages save up to a sixth of a step.
                {"OMP_NUM_THREADS": "1", **huge_heap()},
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=output,
                pass_fds=(theirs.fileno(),),
            )
        ours.settimeout(ANSWER_S)
        self.pid = process.pid
        self._wire, self._output, self._process = ours, output, process
        self._owner = os.getpid()
        self._finalizer = weakref.finalize(self, _end, self._owner, process, ours, output)
        self._send(child.START, {**setup, "seen": SEEN.descr, "moved": MOVED.descr})

    @property
    def is_alive(self) -> bool:
        return self._finalizer.alive

    def look_up(self, words: list[str]) -> dict[str, Any]:
        """Start SUMO with a command line, and return the content of the files.

        Raises ConfigError: SUMO refuses the files; SumoError: the process has ended.
        """
        self._send(child.LOOK_UP, {"words": words})
        return self._receive().line

    def start(self, words: list[str]) -> SumoAnswer:
        """Start a new simulation with a command line; errors as in `look_up`."""
        self._send(child.START, {"words": words})
        return self._receive()

    def begin_step(self, moved: NDArray[np.void]) -> None:
        """Start a step without waiting for its answer.

        Args:
            moved: MOVED (n,), what SUMO receives before the step.

        Raises:
            SumoError: the process has ended.
        """
        self._send(child.STEP, {}, moved.tobytes())

    def end_step(self) -> SumoAnswer:
        """Return the answer of the step; errors as in `look_up`."""
        return self._receive()

    def close(self) -> None:
        self._finalizer()

    def _send(self, kind: int, line: Mapping[str, Any], records: bytes = b"") -> None:
        refuse_fork(self._owner, "SUMO and its vehicles")
        text = json.dumps(line).encode() if line else b""
        head = np.array([(kind, len(records), 0, len(text))], dtype=child.HEAD)
        try:
            self._wire.sendall(head.tobytes() + records + text)
        except OSError as error:
            raise self._death() from error

    def _receive(self) -> SumoAnswer:
        head = np.frombuffer(self._read(child.HEAD.itemsize), child.HEAD)[0]
        records = self._read(int(head["records"]))
        letters = self._read(int(head["letters"]))
        line: dict[str, Any] = json.loads(self._read(int(head["line"])))
        if head["kind"] == child.REFUSED:
            error = f"{line['error']}{self._last_words()}"
            if _is_too_large(error):
                raise SumoError(self._too_large())
            raise ConfigError(f"SUMO reports an error: {error}")
        return SumoAnswer(np.frombuffer(records, SEEN), bytes(letters), line)

    def _read(self, size: int) -> bytearray:
        content = bytearray(size)
        view = memoryview(content)
        try:
            while view:
                got = self._wire.recv_into(view)
                if got == 0:
                    raise self._death()
                view = view[got:]
        except OSError as error:
            raise self._death() from error
        return content

    def _death(self) -> SumoError:
        try:
            status = self._process.wait(END_S)
            how = f"ended with {status}"
        except subprocess.TimeoutExpired:
            how = f"has not answered for {ANSWER_S:g} s"
        words = self._last_words()
        self.close()
        if _is_too_large(words):
            return SumoError(self._too_large())
        return SumoError(
            f"the process of SUMO {how}{words}\nThe world is as it was before the step; reset it "
            "to continue"
        )

    def _too_large(self) -> str:
        return (
            f"the process of SUMO needs more than {self._most_bytes / 2**30:g} GiB of memory: use "
            f"a smaller map or less traffic, or set {MEMORY_LIMIT} (in bytes)"
        )

    def _last_words(self) -> str:
        text = last_words(self._output)
        return f": {text}" if text else ""


def _is_too_large(words: str) -> bool:
    return any(sign in words for sign in OUT_OF_MEMORY)


def _end(
    owner: int, process: subprocess.Popen[bytes], wire: socket.socket, output: IO[bytes]
) -> None:
    if is_fork(owner):  # a forked process must not end SUMO
        return
    wire.close()
    end_process(process, END_S)
    output.close()
