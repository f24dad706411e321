"""Starts the service: store, broker, application, and uvicorn on a socket."""

from __future__ import annotations

import asyncio
import signal
import socket
import time
from collections.abc import Callable, Generator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path

import uvicorn

from cavmarl.core.errors import ServiceError
from cavmarl.core.private_files import check_private
from cavmarl.core.request_heads import BoundedHeads
from cavmarl.core.server_address import BACKLOG, is_loopback, listen, shown_host
from cavmarl.service.access import Access
from cavmarl.service.app import make_app
from cavmarl.service.broker import Broker, BrokerRules
from cavmarl.service.event_log import SERVICE, EventLog
from cavmarl.service.event_store import EventStore
from cavmarl.service.rate_limit import RateLimit
from cavmarl.service.route_access import Service
from cavmarl.service.snapshots import SNAPSHOT_EVENTS

DEFAULT_STORE = Path("runs/service.sqlite")
DEFAULT_PORT = 8700
POLL_S = 0.25  # time between two attempts of a standby to take over
SERVER_HEADER: list[tuple[str, str]] = [("server", "cavmarl")]


@dataclass(frozen=True)
class ServerOptions:
    """Where a service listens, and what it stores."""

    host: str = "127.0.0.1"
    port: int = DEFAULT_PORT  # 0 picks a free port
    store: str = str(DEFAULT_STORE)
    certificate: Path | None = None
    key: Path | None = None
    rate_hz: float = 200.0  # rate limit of one identity
    rules: BrokerRules = field(default_factory=BrokerRules)
    is_standby: bool = False  # follow the store of another service until that service ends
    snapshot_events: int = SNAPSHOT_EVENTS  # events after which a snapshot is written; 0: none


def serve(options: ServerOptions, tell: Callable[[str], None]) -> None:
    """Run a service until it is interrupted; a standby first waits until it takes over.

    Args:
        options: address, store and rules.
        tell: called with lines to show on the terminal; one of them is the first
            admin's secret, which is shown nowhere else.

    Raises:
        ServiceError: the address can be reached by others without TLS, the port is in use, or the
            store cannot be opened or written or was modified.
    """
    check_transport(options.host, options.certificate, options.key)
    listener = listen(options.host, options.port, is_open=not options.is_standby)
    scheme = "https" if options.certificate else "http"
    address = f"{scheme}://{shown_host(options.host)}:{listener.getsockname()[1]}"
    try:
        store = EventStore(options.store, is_standby=options.is_standby)
    except BaseException:
        listener.close()
        raise
    try:
        if options.is_standby:
            tell(f"standby: {address}, follows store {store.where}")
            log = follow_store(store, tell, options.snapshot_events)
        else:
            log = EventLog(store, snapshot_events=options.snapshot_events)
        if not options.snapshot_events:
            store.drop_snapshot()
        known = log.sequence
        access = Access(log)
        admin = first_admin(log, access)
        rules = {**asdict(options.rules), "is_standby": options.is_standby}
        log.record("service.started", SERVICE, rules)
        log.flush()
        broker = Broker(log, options.rules)
        limits = RateLimit(options.rate_hz, 2.0 * options.rate_hz), RateLimit(20.0, 100.0)
        service = Service(broker, access, *limits)
        config = uvicorn_config(make_app(service), options)
        server = HttpServer(config)

        def end() -> None:
            server.should_exit = True

        service.on_broken = end
        if options.is_standby:
            listener.listen(BACKLOG)
        tell(f"service: {address}, store {store.where}")
        if known:
            tell(f"log: {known} events, {log.origin}")
        if admin is not None:
            tell(f"admin secret, shown this once: {admin}")
        asyncio.run(_run(server, listener))
        if log.failure is not None:
            raise log.failure
        log.end()
    finally:
        listener.close()
        store.close()


class HttpServer(uvicorn.Server):
    """uvicorn's server, which leaves signals to this program.

    uvicorn raises a signal again at its end, so that the program would die before its last write.
    """

    @contextmanager
    def capture_signals(self) -> Generator[None, None, None]:
        """Set no signal handlers."""
        yield


async def _run(server: HttpServer, listener: socket.socket) -> None:
    """Run the server until SIGINT or SIGTERM."""
    loop = asyncio.get_running_loop()
    for number in (signal.SIGINT, signal.SIGTERM):
        loop.add_signal_handler(number, server.handle_exit, number, None)
    await server.serve([listener])


def follow_store(
    store: EventStore, tell: Callable[[str], None], snapshot_events: int = SNAPSHOT_EVENTS
) -> EventLog:
    """Return the log of a store as soon as no other service has the store.

    Until then, the log is read as the other service writes it. So taking over takes the same time
    for a log of any length. `tell` is called once the existing events are read. The events before
    the newest snapshot are checked after that, between the reads.

    Raises:
        ServiceError: the server of the store does not answer, or the log was modified.
    """
    log: EventLog | None = None
    while not store.try_lock():
        if log is None and store.has_tables():
            log = EventLog(store, is_own=False, snapshot_events=snapshot_events)
            tell(f"standby: ready to take over, {log.sequence} events, {log.origin}")
        elif log is not None:
            log.catch_up()
        if log is None or log.check_older(POLL_S):
            time.sleep(POLL_S)
    if log is None:
        return EventLog(store, snapshot_events=snapshot_events)
    log.catch_up()
    log.check_head()
    return log


def first_admin(log: EventLog, access: Access) -> str | None:
    """Return the secret of the first admin, or None if there is an admin already."""
    if any(one.role == "admin" for one in log.state.identities.values()):
        return None
    return access.add_identity("admin", "admin")[1]


def check_transport(host: str, certificate: Path | None, key: Path | None) -> None:
    """Check that secrets are encrypted on the way to other machines.

    Raises:
        ServiceError: secrets would not be encrypted, or a file is missing.
        ConfigError: other users can read the private key.
    """
    if (certificate is None) != (key is None):
        raise ServiceError("give both --certificate and --key, or neither")
    for path in (certificate, key):
        if path is not None and not path.is_file():
            raise ServiceError(f"{path}: does not exist; give the path of a PEM file")
    if key is not None:
        check_private("--key", key)
    if certificate is None and not is_loopback(host):
        raise ServiceError(
            f"--host {host}: other machines can reach it, and without TLS its secrets can be read: "
            "give --certificate and --key, or use 127.0.0.1"
        )


def uvicorn_config(app: object, options: ServerOptions) -> uvicorn.Config:
    """Return the server configuration; there is no access log, as it would name callers."""
    return uvicorn.Config(
        app,  # type: ignore[arg-type]
        log_level="warning",
        access_log=False,
        server_header=False,
        headers=SERVER_HEADER,
        ssl_certfile=options.certificate,
        ssl_keyfile=options.key,
        timeout_keep_alive=30,
        timeout_graceful_shutdown=2,
        limit_concurrency=2048,
        loop="asyncio",
        http=BoundedHeads,
        ws="none",
        proxy_headers=False,
    )
