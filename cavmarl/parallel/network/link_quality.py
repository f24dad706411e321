"""What the system has measured about a connection: round trips, and the rate of delivery."""

from __future__ import annotations

import os
import socket
import struct
from typing import NamedTuple

from cavmarl.parallel.network.transport import Connection

# Fields of `struct tcp_info` in `linux/tcp.h`; newer kernels only append fields.
_RTT = struct.Struct("<68x I I")  # smoothed round trip and its mean deviation, in µs
_LEAST_RTT = struct.Struct("<148x I")  # in µs
_DELIVERY = struct.Struct("<160x Q")  # bytes per second
_SIZE = _DELIVERY.size


class LinkQuality(NamedTuple):
    """Quality of a connection, measured at the end in this process; None: not measured."""

    is_encrypted: bool
    rtt_ms: float | None = None  # smoothed round trip
    rtt_deviation_ms: float | None = None  # mean deviation
    least_rtt_ms: float | None = None  # since the connection was made
    delivered_mbit_s: float | None = None  # last delivery rate, limited by the sending rate


def measure_link(connection: Connection) -> LinkQuality:
    """Return what the system has measured about a connection; TCP is measured on Linux only."""
    is_encrypted = bool(connection.keeps_bytes)
    if not hasattr(socket, "TCP_INFO"):
        return LinkQuality(is_encrypted)
    try:
        with socket.socket(fileno=os.dup(connection.fileno())) as same:
            found = same.getsockopt(socket.IPPROTO_TCP, socket.TCP_INFO, 256)
    except OSError:  # not a connection over TCP
        return LinkQuality(is_encrypted)
    if len(found) < _SIZE:
        return LinkQuality(is_encrypted)
    rtt_us, deviation_us = _RTT.unpack_from(found)
    (least_us,), (rate,) = _LEAST_RTT.unpack_from(found), _DELIVERY.unpack_from(found)
    return LinkQuality(is_encrypted, rtt_us / 1e3, deviation_us / 1e3, least_us / 1e3, 8e-6 * rate)
