"""`FaultyNetwork`: carries connections, and does to them what bad networks do."""

from __future__ import annotations

import random
import socket
import threading
import time
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import suppress
from enum import StrEnum
from typing import TypeAlias

LOCAL = "127.0.0.1"
CHUNK = 1 << 16
LONGEST_DELAY_S = 0.05

Place: TypeAlias = tuple[str, int]


class NetworkFault(StrEnum):
    """What becomes of the bytes of one direction of a connection."""

    DELAY = "delay"  # the next ones come later
    DAMAGE = "damage"  # one bit of the next ones is another
    CUT = "cut"  # the connection ends, maybe in the middle of a frame
    SILENCE = "silence"  # nothing comes any more, and nobody is told


class _Connection:
    """The two sockets of one connection, by direction: 0 from the caller, 1 to it."""

    def __init__(self, ends: tuple[socket.socket, socket.socket]) -> None:
        self.ends = ends
        self.due: list[NetworkFault | None] = [None, None]
        self.open = 2  # directions

    def cut(self) -> None:
        for end in self.ends:
            with suppress(OSError):
                end.shutdown(socket.SHUT_RDWR)


class FaultyNetwork:
    """Carries connections to places, and does something to one of them now and then.

    Attributes:
        done: how often each fault has been done.
    """

    def __init__(
        self,
        seed: int,
        kinds: Sequence[NetworkFault],  # that are drawn from
        every_s: float,  # mean time between two of them
        most: int,  # of those that end a connection
    ) -> None:
        self.done: Counter[NetworkFault] = Counter()
        self._random = random.Random(seed)
        self._kinds, self._every_s, self._most = tuple(kinds), every_s, most
        self._listeners: list[socket.socket] = []
        self._connections: list[_Connection] = []
        self._lock = threading.Lock()
        self._ended = threading.Event()
        self._is_on = threading.Event()
        self._start(self._draw)

    def route(self, place: Place) -> Place:
        """Where to call in order to reach a place through this network."""
        listener = socket.create_server((LOCAL, 0))
        self._listeners.append(listener)
        self._start(lambda: self._accept(listener, place))
        found: Place = listener.getsockname()
        return found

    def begin(self) -> None:
        """From now on there are faults."""
        self._is_on.set()

    def close(self) -> None:
        """End all connections."""
        self._ended.set()
        self._is_on.set()
        for listener in self._listeners:
            with suppress(OSError):
                listener.shutdown(socket.SHUT_RDWR)
            listener.close()
        with self._lock:
            for connection in self._connections:
                connection.cut()

    @staticmethod
    def _start(run: Callable[[], None]) -> None:
        threading.Thread(target=run, daemon=True).start()

    def _accept(self, listener: socket.socket, place: Place) -> None:
        with suppress(OSError):
            while not self._ended.is_set():
                caller, _ = listener.accept()
                try:
                    called = socket.create_connection(place)
                except OSError:
                    caller.close()
                    continue
                for end in (caller, called):
                    end.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                connection = _Connection((caller, called))
                with self._lock:
                    self._connections.append(connection)
                for direction in (0, 1):
                    self._start(lambda c=connection, d=direction: self._carry(c, d))  # type: ignore[misc]

    def _carry(self, connection: _Connection, direction: int) -> None:
        """Carry the bytes of one direction until one end closes."""
        source, target = connection.ends[direction], connection.ends[1 - direction]
        is_mute = False
        with suppress(OSError):
            while data := source.recv(CHUNK):
                fault, connection.due[direction] = connection.due[direction], None
                if fault is NetworkFault.DELAY:
                    time.sleep(self._random.uniform(0.001, LONGEST_DELAY_S))
                elif fault is NetworkFault.DAMAGE:
                    changed = bytearray(data)
                    changed[self._random.randrange(len(data))] ^= 1 << self._random.randrange(8)
                    data = bytes(changed)
                elif fault is NetworkFault.SILENCE:
                    is_mute = True
                if not is_mute:
                    target.sendall(data)
        connection.cut()
        with self._lock:
            connection.open -= 1
            if connection.open:
                return
            self._connections.remove(connection)
        for end in connection.ends:
            end.close()

    def _draw(self) -> None:
        """Do faults at random times."""
        self._is_on.wait()
        while not self._ended.wait(self._random.expovariate(1.0 / self._every_s)):
            harmless = [kind for kind in self._kinds if kind is NetworkFault.DELAY]
            ended = sum(n for kind, n in self.done.items() if kind is not NetworkFault.DELAY)
            kinds = self._kinds if ended < self._most else harmless
            with self._lock:
                if not (kinds and self._connections):
                    continue
                connection = self._random.choice(self._connections)
            kind = self._random.choice(kinds)
            self.done[kind] += 1
            if kind is NetworkFault.CUT:
                connection.cut()
            else:
                connection.due[self._random.randrange(2)] = kind
