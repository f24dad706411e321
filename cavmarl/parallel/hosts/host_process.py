"""Runs in a host: does a job, command by command, for a caller on another machine."""

from __future__ import annotations

import hashlib
import os
import socket
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple, NoReturn

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.errors import MessageError
from cavmarl.parallel.hosts.framed_socket import Frame, FramedSocket, Kind
from cavmarl.parallel.hosts.listener import knock
from cavmarl.parallel.processes.shared_memory import Segment
from cavmarl.parallel.processes.state_image import Image
from cavmarl.parallel.processes.worker_loop import NOTHING, OUT_OF_MEMORY, describe

Array = NDArray[Any]

BEAT_S = 0.1
_FIRST_IMAGE_BYTES = 1 << 12


class Order(NamedTuple):
    """The payload of a command; its data are an image, what was done since, and what to do now."""

    task: int  # what to do
    payload: Any  # what is said to it
    size: int  # of the part that it is about, before it
    image: int  # bytes of the image to begin from; 0: go on from where you are
    repeats: int  # how often what was done since has to be done again; each has data of its own
    repeated: int  # the task that is
    saves: bool  # an image is to be sent of what comes out


class TaskOutcome(NamedTuple):
    """What comes out of a task."""

    answer: Any  # what the caller is to know, as JSON knows it; mostly nothing
    arrays: Sequence[Array]  # that it is sent; of what shapes follows from the task and the answer


@cache
def code_stamp() -> str:
    """What this machine runs: digest of all sources, and the libraries that compute."""
    package = Path(__file__).resolve().parents[2]
    digest = hashlib.sha256()
    for source in sorted(package.rglob("*.py")):
        name = source.relative_to(package).as_posix()
        if not name.startswith("data/"):  # which only a wheel has
            digest.update(name.encode() + b"\0" + source.read_bytes())
    sources = digest.hexdigest()[:12]
    return f"cavmarl of sources {sources}, numpy {np.__version__}"


class RemoteJob:
    """What a host does; every host can take up every part of it."""

    @property
    def code(self) -> str:
        """What has to be the same on all machines for the same to come out."""
        return code_stamp()

    def fit(self, size: int) -> None:
        """Be ready for a part of that size."""

    def inputs(self, task: int, payload: Any) -> Sequence[Array]:
        """Arrays that a command of this task fills, as many as its payload says."""
        raise NotImplementedError

    def perform(self, task: int, payload: Any) -> TaskOutcome:
        raise NotImplementedError

    def save(self) -> Sequence[Array]:
        """All that another host needs to go on from here; nothing where the caller keeps it."""
        return []

    def load(self, saved: Sequence[Array]) -> None:
        """Go on from what `save` gave."""


def serve(
    make_job: Callable[[], RemoteJob], place: tuple[str, int], secret: bytes, number: int
) -> None:
    """The whole life of a host: until it is needed no more.

    If the connection ends before that, the process does, too.

    Raises:
        OSError: the caller cannot be reached.
        EOFError: the listener refuses this host.
        MessageError: it is not the caller.
    """
    line = _Line(knock(place, secret, number))
    with suppress(EOFError, OSError, MessageError):  # the caller is gone, or wants us no more
        try:
            job = make_job()
        except Exception as error:
            line.reply(Kind.FAILED, describe(error))
        else:
            told = {"pid": os.getpid(), "machine": socket.gethostname(), "code": job.code}
            line.reply(Kind.READY, told)
        taken, given = (Image(Segment.make(_FIRST_IMAGE_BYTES)) for _ in range(2))
        while True:
            frame, data = line.hear()
            if frame.kind == Kind.END:
                return
            try:
                payload, arrays = _carry_out(job, Order(*frame.payload), data, taken, given)
            except MemoryError:
                os._exit(OUT_OF_MEMORY)
            except Exception as error:
                line.reply(Kind.FAILED, describe(error))
            else:
                line.reply(Kind.DONE, payload, arrays)
    os._exit(0)


def _carry_out(
    job: RemoteJob, order: Order, data: Array, taken: Image, given: Image
) -> tuple[dict[str, Any], Sequence[Array]]:
    """Do what a command asks for, from where it says that one should begin."""
    if order.task == NOTHING:
        return {"answer": None, "image": 0}, []
    job.fit(order.size)
    if order.image:
        taken.put(data[: order.image])
        job.load(list(taken.read([array.dtype for array in job.save()])))
    at = order.image
    for _ in range(order.repeats):
        at = _fill(job.inputs(order.repeated, None), data, at)
        job.perform(order.repeated, None)
    _fill(job.inputs(order.task, order.payload), data, at)
    answer, arrays = job.perform(order.task, order.payload)
    if not order.saves:
        return {"answer": answer, "image": 0}, arrays
    given.write(job.save())
    saved = given.content()
    return {"answer": answer, "image": saved.nbytes}, [*arrays, saved]


def _fill(arrays: Sequence[Array], data: Array, at: int) -> int:
    """Fill arrays with bytes that lie one behind the other; where the rest begins."""
    for array in arrays:
        flat = array.reshape(-1).view(np.uint8)
        flat[:] = data[at : at + flat.size]
        at += flat.size
    return at


class _Line:
    """The connection, over which the caller also hears that this process is at work.

    A thread says so as long as the other one uses the processor. A process that is stopped says
    nothing, and neither does one that sleeps where it should work.
    """

    def __init__(self, wire: FramedSocket) -> None:
        self._wire = wire
        self._lock = threading.Lock()
        self._order = -1  # that is being carried out
        self._clock = time.pthread_getcpuclockid(threading.get_ident())
        threading.Thread(target=self._beat, daemon=True).start()

    def hear(self) -> tuple[Frame, Array]:
        frame = self._wire.receive()
        self._order = frame.order
        data = np.empty(frame.size, dtype=np.uint8)
        self._wire.take([data])
        return frame, data

    def reply(self, kind: Kind, payload: Any, arrays: Sequence[Array] = ()) -> None:
        with self._lock:
            order, self._order = max(self._order, 0), -1
            self._wire.send(kind, order, payload, arrays)

    def _beat(self) -> NoReturn:
        spent = 0
        while True:
            time.sleep(BEAT_S)
            before, spent = spent, time.clock_gettime_ns(self._clock)
            with self._lock, suppress(OSError):  # the other thread hears of it, too
                if self._order >= 0 and spent > before:
                    self._wire.send(Kind.BEAT, self._order)
