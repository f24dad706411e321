"""A proxy between two processes that reads and changes their bytes."""

from __future__ import annotations

import socket
import threading
from contextlib import suppress

import psutil

__all__ = ["Proxy", "free_port", "own_address"]


def own_address() -> str | None:
    """Return an address of this machine that other machines can reach, or None."""
    for addresses in psutil.net_if_addrs().values():
        for each in addresses:
            if each.family == socket.AF_INET and not each.address.startswith("127."):
                return str(each.address)
    return None


def free_port(address: str) -> int:
    with socket.create_server((address, 0)) as server:
        port: int = server.getsockname()[1]
    return port


class Proxy:
    """A proxy that forwards and stores the bytes of connections."""

    def __init__(self, target: tuple[str, int]) -> None:
        self.heard: list[bytearray] = []  # bytes that each caller has sent
        self.said = bytearray()  # bytes that the target has sent, over all connections
        self.spoiler = b""  # bytes that replace the next bytes from a caller
        self._target = target
        self._server = socket.create_server((target[0], 0))
        self.place: tuple[str, int] = self._server.getsockname()[:2]
        self._sockets: list[socket.socket] = []
        threading.Thread(target=self._serve, daemon=True).start()

    def _serve(self) -> None:
        with suppress(OSError):
            while True:
                near, _ = self._server.accept()
                try:
                    far = socket.create_connection(self._target)
                except OSError:
                    near.close()
                    continue
                self._sockets += (near, far)
                self.heard.append(bytearray())
                for pair in ((near, far, self.heard[-1]), (far, near, self.said)):
                    threading.Thread(target=self._pass, args=pair, daemon=True).start()

    def _pass(self, source: socket.socket, target: socket.socket, record: bytearray) -> None:
        with suppress(OSError):
            while data := source.recv(1 << 16):
                record += data
                if record is not self.said and self.spoiler:
                    data, self.spoiler = self.spoiler, b""
                target.sendall(data)
        for each in (source, target):
            with suppress(OSError):
                each.shutdown(socket.SHUT_RDWR)

    def cut(self) -> None:
        """Close all connections."""
        for each in self._sockets:
            with suppress(OSError):
                each.shutdown(socket.SHUT_RDWR)

    def close(self) -> None:
        self._server.close()
        self.cut()
        for each in self._sockets:
            each.close()
