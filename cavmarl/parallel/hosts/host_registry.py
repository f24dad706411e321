"""`HostRegistry` keeps the hosts of a run, from their connection to their end."""

from __future__ import annotations

import selectors
import socket
from contextlib import suppress
from dataclasses import dataclass
from typing import Protocol

from cavmarl.core.errors import MessageError, WorkerError, WorkerFailureError
from cavmarl.parallel.hosts.framed_socket import FramedSocket, Kind
from cavmarl.parallel.hosts.listener import Listener

ENDED = (EOFError, ConnectionError)  # of a connection, as it does when the process at its end dies

SILENCE_S = 0.8  # of a host that is at work, and tells so every `host_process.BEAT_S`


class Launcher(Protocol):
    """Starts hosts, and starts those again that die."""

    address: str  # of this machine, under which they reach it

    def start(self, place: tuple[str, int], secret: bytes) -> None:
        """Start all hosts; each runs `host_process.serve`.

        Raises:
            WorkerError: they cannot be started.
        """
        ...

    def restart(self, number: int) -> None:
        """End one that may still run, and start it again."""
        ...

    def trouble(self) -> str | None:
        """Why a host does not come, in words."""
        ...

    def close(self) -> None: ...


@dataclass
class HostConnection:
    """One host."""

    wire: FramedSocket
    number: int  # of those that were started
    pid: int = 0  # of its process, on its machine
    machine: str = ""  # its name
    is_ready: bool = False  # it can be given commands
    is_gone: bool = False  # its connection has ended, and this is not noticed yet
    knows: bool = False  # its memory is what is committed
    part: int = -1  # that it has; -1: none
    given_s: float = 0.0  # when it was given its last command, by `time.monotonic`
    heard_s: float = 0.0  # when something was heard of it

    def __str__(self) -> str:
        return f"host {self.number} on {self.machine or 'its machine'}"


class HostRegistry:
    """Lets hosts in and watches all connections at once.

    Raises:
        WorkerError: the port cannot be listened on, or hosts cannot be started.
    """

    def __init__(self, launcher: Launcher, code: str) -> None:
        self.free: list[HostConnection] = []  # hosts that are ready and have no part
        self._launcher = launcher
        self._code = code
        self._hosts: dict[int, HostConnection] = {}
        self._door = Listener(launcher.address)
        self._selector = selectors.DefaultSelector()
        self._selector.register(self._door, selectors.EVENT_READ, self._door)
        try:
            launcher.start(self._door.place, self._door.secret)
        except BaseException:
            self.close()
            raise

    def look(self, wait_s: float) -> list[HostConnection]:
        """Wait until something has happened.

        Returns:
            hosts with a part that have something to say, or have ended.

        Raises:
            WorkerFailureError: an exception in one before it was ready.
            WorkerError: one is of another version.
        """
        speaking: list[HostConnection] = []
        for key, _ in self._selector.select(wait_s):
            match key.data:
                case HostConnection() as host if host.part >= 0:
                    speaking.append(host)
                case HostConnection() as host:
                    self._wake(host)
        for number, connection in self._door.admit():
            self._admit(connection, number)
        return speaking

    def drop(self, host: HostConnection, restart: bool) -> None:
        self.mute(host)
        host.wire.close()
        if self._hosts.get(host.number) is host:
            del self._hosts[host.number]
        if host in self.free:
            self.free.remove(host)
        if restart:
            self._launcher.restart(host.number)

    def mute(self, host: HostConnection) -> None:
        """Hear no more of a host whose connection has ended."""
        with suppress(KeyError):
            self._selector.unregister(host.wire)
        host.is_gone = True

    def close(self) -> None:
        """End all hosts, and accept no more."""
        for host in self._hosts.values():
            with suppress(OSError):  # it is gone, or stopped: the launcher kills it
                host.wire.send(Kind.END, 0)
        self._launcher.close()
        self._door.close()
        for host in self._hosts.values():
            host.wire.close()
        self._selector.close()

    def _admit(self, connection: socket.socket, number: int) -> None:
        if number in self._hosts and self._hosts[number].part < 0:
            self.drop(self._hosts[number], restart=False)
        connection.settimeout(SILENCE_S)
        host = self._hosts[number] = HostConnection(FramedSocket(connection), number)
        self._selector.register(host.wire, selectors.EVENT_READ, host)

    def _wake(self, host: HostConnection) -> None:
        """Hear of a host without a part whether it is ready, or has ended."""
        try:
            frame = host.wire.receive()
            host.wire.skip()
        except (EOFError, OSError, MessageError) as error:
            self.drop(host, restart=not isinstance(error, ENDED))
            return
        if frame.kind == Kind.FAILED:
            raise WorkerFailureError(host.number, str(host), **frame.payload)
        host.pid, host.machine = frame.payload["pid"], frame.payload["machine"]
        if frame.payload["code"] != self._code:
            raise WorkerError(
                f"{host} runs {frame.payload['code']}, this machine {self._code}: install the same "
                "versions on all machines, or results would differ"
            )
        host.is_ready = True
        self.free.append(host)
