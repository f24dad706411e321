"""Addresses at which a server listens."""

from __future__ import annotations

import ipaddress
import socket

from cavmarl.core.errors import ServiceError

BACKLOG = 2048  # connections that wait to be accepted


def is_loopback(host: str) -> bool:
    """Return whether an address can only be reached from this machine."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def listen(host: str, port: int, *, is_open: bool = True) -> socket.socket:
    """Return a socket that listens at an address.

    If `is_open` is false, the socket only has the address: connections are refused until a server
    listens on it.

    Raises ServiceError: the address does not belong to this machine, or its port is in use.
    """
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    # Nagle's algorithm delays answers by 40 ms; asyncio disables it only if TCP is named here.
    listener = socket.socket(family, socket.SOCK_STREAM, socket.IPPROTO_TCP)
    listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        listener.bind((host, port))
        if is_open:
            listener.listen(BACKLOG)
    except OSError as error:
        listener.close()
        raise ServiceError(f"{host}:{port}: {error.strerror}; give another --port") from error
    return listener


def shown_host(host: str) -> str:
    """Return an address as it is written in a URL."""
    return f"[{host}]" if ":" in host else host
