"""Encryption of connections that leave this machine: TLS 1.3 between two ends with one secret.

Both ends derive the same key and certificate from the secret, present the certificate and accept no
other. No third party signs anything, and each connection has session keys of its own.
"""

from __future__ import annotations

import hashlib
import ipaddress
import socket
import ssl
import tempfile
from collections.abc import Iterable
from datetime import UTC, datetime
from functools import lru_cache
from typing import Any

from cavmarl.core.errors import require

MAX_CALL_BYTES = 1 << 16  # limit of bytes that one call encrypts
_VALID = datetime(2000, 1, 1, tzinfo=UTC), datetime(2100, 1, 1, tzinfo=UTC)
_WAITS = (ssl.SSLWantReadError, ssl.SSLWantWriteError)


class EncryptedSocket(ssl.SSLSocket):
    """A TLS socket that raises `BlockingIOError` like a plain non-blocking socket."""

    def sendmsg(self, buffers: Iterable[Any], *_: Any) -> int:  # type: ignore[override]
        """Send some of the bytes; return their number. The next call must begin with the rest."""
        pieces, size = [], 0
        for piece in buffers:
            pieces.append(piece)
            size += len(piece)
            if size >= MAX_CALL_BYTES:
                break
        try:
            return self.send(pieces[0] if len(pieces) == 1 else b"".join(pieces))
        except _WAITS as error:
            raise BlockingIOError from error

    def recv(self, buflen: int = 1024, flags: int = 0) -> bytes:
        try:
            return super().recv(buflen, flags)
        except _WAITS as error:
            raise BlockingIOError from error

    def recv_into(self, buffer: Any, nbytes: int | None = None, flags: int = 0) -> int:
        try:
            return super().recv_into(buffer, nbytes, flags)
        except _WAITS as error:
            raise BlockingIOError from error


def leaves_this_machine(connection: socket.socket) -> bool:
    """Return whether the address of the other end is not this machine."""
    if connection.family not in (socket.AF_INET, socket.AF_INET6):
        return False
    return not _is_loopback(connection.getpeername()[0])


def prepare(address: str, secret: bytes) -> None:
    """Prepare to encrypt calls to a listener, if other machines can reach its address.

    Raises:
        MissingExtraError: cryptography is not installed.
    """
    if not _is_loopback(address):
        _context(secret, calls=False)


def _is_loopback(address: str) -> bool:
    return ipaddress.ip_address(address.partition("%")[0]).is_loopback


def encrypted(connection: socket.socket, secret: bytes, calls: bool) -> EncryptedSocket:
    """Return an encrypted connection, which owns the socket.

    The calling end does its handshake here; the listening end has to do its handshake later.

    Raises:
        ssl.SSLError: the other end does not know the secret.
        MissingExtraError: cryptography is not installed.
    """
    found = _context(secret, calls).wrap_socket(
        connection, server_side=not calls, do_handshake_on_connect=calls
    )
    assert isinstance(found, EncryptedSocket)
    return found


@lru_cache(4)
def _context(secret: bytes, calls: bool) -> ssl.SSLContext:
    certificate, key = _identity(secret)
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT if calls else ssl.PROTOCOL_TLS_SERVER)
    context.sslsocket_class = EncryptedSocket
    context.minimum_version = ssl.TLSVersion.TLSv1_3
    context.check_hostname = False  # the certificate is valid on any machine
    context.verify_mode = ssl.CERT_REQUIRED
    context.load_verify_locations(cadata=certificate.decode())
    if not calls:
        context.num_tickets = 0  # no connection resumes an earlier session
    with (
        tempfile.NamedTemporaryFile() as file
    ):  # readable by this user alone; OpenSSL reads files only
        file.write(certificate + key)
        file.flush()
        context.load_cert_chain(file.name)
    return context


def _identity(secret: bytes) -> tuple[bytes, bytes]:
    """Return the certificate and the private key of a secret, as PEM."""
    require("cryptography", "nodes")
    from cryptography import x509
    from cryptography.hazmat.primitives import serialization
    from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
    from cryptography.x509.oid import NameOID

    seed = hashlib.sha256(b"cavmarl TLS" + secret).digest()
    key = Ed25519PrivateKey.from_private_bytes(seed)
    name = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, "cavmarl")])
    unsigned = x509.CertificateBuilder(
        issuer_name=name, subject_name=name, public_key=key.public_key(), serial_number=1,
        not_valid_before=_VALID[0], not_valid_after=_VALID[1],
    )  # fmt: skip
    return (
        unsigned.sign(key, None).public_bytes(serialization.Encoding.PEM),
        key.private_bytes(
            serialization.Encoding.PEM,
            serialization.PrivateFormat.PKCS8,
            serialization.NoEncryption(),
        ),
    )
