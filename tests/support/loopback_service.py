"""A service and its nodes on loopback sockets, in a thread of this process.

The thread is cheaper than separate processes, and a test can read the store and the log.
"""

from __future__ import annotations

import asyncio
import logging
import socket
import threading
import time
from collections.abc import Coroutine, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

import httpx
import uvicorn

from cavmarl.client import Client
from cavmarl.core.errors import ServiceError
from cavmarl.core.server_address import listen
from cavmarl.service.access import Access
from cavmarl.service.app import make_app
from cavmarl.service.broker import Broker, BrokerRules
from cavmarl.service.event_log import EventLog
from cavmarl.service.event_store import EventStore
from cavmarl.service.node_app import make_node_app
from cavmarl.service.node_link import NodeLink, must_register
from cavmarl.service.rate_limit import RateLimit
from cavmarl.service.route_access import Service
from cavmarl.service.server import ServerOptions, uvicorn_config
from cavmarl.service.service_records import ROLES, Role
from cavmarl.service.session_worlds import SessionWorlds

T = TypeVar("T")
LOGGERS = ("cavmarl.service", "uvicorn.error", "asyncio")
BEAT_S = 0.2


class Lines(logging.Handler):
    """A handler that collects the log lines of the service and its nodes."""

    def __init__(self) -> None:
        super().__init__()
        self.lines: list[str] = []
        self.setFormatter(logging.Formatter("%(levelname)s %(message)s"))

    def emit(self, record: logging.LogRecord) -> None:
        self.lines.append(self.format(record))


@dataclass
class LoopbackService:
    """A service at `url` and its nodes.

    Attributes:
        log: log lines of the service and the nodes.
        nodes: name → link and URL of the node.
    """

    url: str
    events: EventLog
    access: Access
    broker: Broker
    log: Lines
    loop: asyncio.AbstractEventLoop
    http: httpx.Client
    secrets: dict[str, str] = field(default_factory=dict)  # name of the identity → secret
    nodes: dict[str, tuple[NodeLink, str]] = field(default_factory=dict)
    worlds: dict[str, SessionWorlds] = field(default_factory=dict)
    servers: list[uvicorn.Server] = field(default_factory=list)
    serving: list[asyncio.Task[None]] = field(default_factory=list)
    beating: list[asyncio.Task[None]] = field(default_factory=list)

    def run(self, what: Coroutine[Any, Any, T]) -> T:
        """Run a coroutine in the thread of the service."""
        return asyncio.run_coroutine_threadsafe(what, self.loop).result(60.0)

    def grant(self, name: str, role: Role) -> str:
        async def add() -> str:
            secret = self.access.add_identity(name, role)[1]
            await self.events.settle()
            return secret

        self.secrets[name] = self.run(add())
        return self.secrets[name]

    def token(self, name: str) -> str:
        return str(self.access.exchange(self.secrets[name])["access_token"])

    def client(self, name: str) -> Client:
        return Client(self.url, self.secrets[name])

    def ask(self, name: str, method: str, path: str, **given: Any) -> httpx.Response:
        """Send a request with the token of an identity, or without a token if the name is empty."""
        headers = {"Authorization": f"Bearer {self.token(name)}"} if name else {}
        headers |= given.pop("headers", {})
        return self.http.request(method, f"{self.url}/v1{path}", headers=headers, **given)

    def start_node(self, name: str, identity: str, slots: int = 4) -> NodeLink:
        """Start a node that sends heartbeats until the service ends."""
        found: NodeLink = self.run(self._start_node(name, identity, slots))
        self.wait_for_beat(name)
        return found

    def wait_for_beat(self, name: str) -> None:
        """Wait until the service knows the load of a node."""
        until_s = time.monotonic() + 30.0
        while self.broker.live[name].use is None:
            assert time.monotonic() < until_s
            time.sleep(0.02)

    def wait_until_ready(self, name: str) -> None:
        """Wait until the service has admitted a node, accepts its heartbeats, and can use it.

        Requests of the test may have drained the node, registered it again, or sent heartbeats in
        its name.
        """
        link = self.nodes[name][0]
        until_s = time.monotonic() + 60.0
        while True:
            node, live = self.events.state.nodes[name], self.broker.live[name]
            is_present = node.state == "up" and node.incarnation == link.incarnation
            if is_present and live.use and live.beat < link.beats and not link.is_draining:
                return
            assert time.monotonic() < until_s, (node, live, link.beats)
            time.sleep(0.02)

    async def _start_node(self, name: str, identity: str, slots: int) -> NodeLink:
        listener = listen("127.0.0.1", 0)
        port = listener.getsockname()[1]
        body = {"name": name, "address": "127.0.0.1", "client_port": port,
                "simulator_port": port, "slots": slots}  # fmt: skip
        link = NodeLink(self.url, self.secrets[identity], body, is_supposed_idle=True)
        worlds = self.worlds[name] = SessionWorlds(slots)
        self._serve(make_node_app(link, worlds), listener)
        await link.register()
        self.nodes[name] = link, f"http://127.0.0.1:{port}"
        self.beating.append(asyncio.create_task(_beat(link, worlds)))
        return link

    def _serve(self, app: Any, listener: socket.socket) -> None:
        server = uvicorn.Server(uvicorn_config(app, ServerOptions()))
        for name in LOGGERS:
            logger = logging.getLogger(name)
            if self.log not in logger.handlers:
                logger.addHandler(self.log)
        self.servers.append(server)
        self.serving.append(asyncio.create_task(server.serve([listener])))


async def _beat(link: NodeLink, worlds: SessionWorlds) -> None:
    while True:
        with suppress(ServiceError):
            try:
                told = await link.beat(worlds.counters(), {}, False)
                worlds.keep_only(link.own(told["sessions"]))
            except ServiceError as error:
                if must_register(error):
                    await link.register()
        await asyncio.sleep(BEAT_S)


@contextmanager
def loopback_service(
    store: str | Path, *, rate_hz: float = 1e9, address_hz: float = 1e9, **rules: Any
) -> Iterator[LoopbackService]:
    """Start a service with one identity per role, which has the name of the role."""
    loop = asyncio.new_event_loop()
    thread = threading.Thread(target=loop.run_forever, name="loopback service")
    thread.start()
    events = EventLog(EventStore(store))
    access, broker = Access(events), Broker(events, BrokerRules(**rules))
    service = Service(
        broker, access, RateLimit(rate_hz, 2.0 * rate_hz), RateLimit(address_hz, 5.0 * address_hz)
    )
    listener = listen("127.0.0.1", 0)
    url = f"http://127.0.0.1:{listener.getsockname()[1]}"
    http = httpx.Client(timeout=30.0)
    running = LoopbackService(url, events, access, broker, Lines(), loop, http)

    async def begin() -> None:
        running._serve(make_app(service), listener)

    async def end() -> None:
        for task in running.beating:
            task.cancel()
        for server in running.servers:
            server.should_exit = True
        await asyncio.gather(*running.beating, *running.serving, return_exceptions=True)
        for link, _ in running.nodes.values():
            await link.close()

    running.run(begin())
    try:
        for role in ROLES:
            running.grant(role, role)
        yield running
    finally:
        for worlds in running.worlds.values():
            worlds.keep_only(set())
        http.close()
        running.run(end())
        for name in LOGGERS:
            logging.getLogger(name).removeHandler(running.log)
        loop.call_soon_threadsafe(loop.stop)
        thread.join(30.0)
        loop.close()
        events.flush()
        events.store.close()
