"""`CarlaServer`: the ports to which CARLA's clients connect, and the loop that runs the world.

One thread answers all calls and advances the world, so only one thread uses the time master. In
synchronous mode, the call `tick` of a client advances the world; otherwise the wall clock does. The
protocol has no login: by default, only programs of this machine can connect.
"""

from __future__ import annotations

import asyncio
import logging
import socket
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Self

from cavmarl.config.world_spec import WorldSpec
from cavmarl.core.errors import ConfigError, MessageError
from cavmarl.core.server_address import is_loopback, listen
from cavmarl.cosim.carla import (
    actor_calls,
    batch_calls,
    episode_calls,
    light_calls,
    recorder_calls,
)
from cavmarl.cosim.carla.call_table import Caller, answer
from cavmarl.cosim.carla.carla_session import (
    DEFAULT_LIMITS,
    CarlaSession,
    OtherTicks,
    SessionLimits,
)
from cavmarl.cosim.carla.carla_streams import StreamConnection, StreamHub, without_delay
from cavmarl.cosim.carla.carla_versions import DEFAULT_VERSION, client_version
from cavmarl.cosim.carla.hosted_world import STEP_S, GivenWorld, LoadedWorlds, WorldSource
from cavmarl.cosim.carla.rpc_messages import Request, RequestReader, pack_answer
from cavmarl.engine.world_setup import find_map
from cavmarl.env.parallel import CavEnv

log = logging.getLogger("cavmarl.carla")

PORT = 2000
LOOPBACK = "127.0.0.1"
CALL_MODULES = (
    actor_calls,
    batch_calls,
    episode_calls,
    light_calls,
    recorder_calls,
)  # importing these modules fills the table of calls
_LATE_S = 0.5  # a free-running world does not catch up on longer delays
_PATIENCE_S = 0.05  # how long a tick waits for listeners of new sensors
_LOOK_S = 0.0005
_MAX_PORT = 65534  # the streams have the next port


class ClientConnection(asyncio.Protocol):
    """The RPC connection of one client.

    A tick waits a moment for clients that are about to listen to new sensors. A client that calls
    `listen` and then `tick` expects the frame of this tick, but its `listen` does not wait until
    the client is connected to the stream port.
    """

    def __init__(self, session: CarlaSession, connections: set[ClientConnection]) -> None:
        self._session, self._connections = session, connections
        self._reader = RequestReader(session.limits.max_message)
        self._caller = Caller("a client")
        self._transport: asyncio.Transport | None = None
        self._requests: deque[Request] = deque()
        self._patience_s: float | None = None  # time until which the first request waits
        self._next_look: asyncio.TimerHandle | None = None

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        assert isinstance(transport, asyncio.Transport)
        self._transport = transport
        without_delay(transport)
        host, port = transport.get_extra_info("peername")[:2]
        self._caller.name = f"{host}:{port}"
        if len(self._connections) >= self._session.limits.max_clients:
            log.warning("%s is refused: %d clients", self._caller.name, len(self._connections))
            transport.abort()
            return
        self._connections.add(self)

    def data_received(self, data: bytes) -> None:
        transport = self._transport
        assert transport is not None
        if transport.get_write_buffer_size() > self._session.limits.max_unsent:
            log.warning("%s does not read its answers and is dropped", self._caller.name)
            transport.abort()
            return
        try:
            self._requests.extend(self._reader.read(data))
        except MessageError as problem:
            log.warning("%s is dropped: %s", self._caller.name, problem)
            transport.abort()
            return
        if self._next_look is None:
            self._answer_requests()

    def _answer_requests(self) -> None:
        self._next_look = None
        transport = self._transport
        assert transport is not None
        while self._requests:
            if self._must_wait(self._requests[0]):
                loop = asyncio.get_running_loop()
                self._next_look = loop.call_later(_LOOK_S, self._answer_requests)
                return
            self._patience_s = None
            request = self._requests.popleft()
            error, result = answer(self._caller, self._session, request.name, request.arguments)
            transport.write(pack_answer(request.number, error, result))

    def _must_wait(self, request: Request) -> bool:
        """Return whether a request is a tick that must wait for listeners of new sensors."""
        is_tick = request.name == "tick_cue" or (
            request.name == "apply_batch" and request.arguments[-1:] == [True]
        )
        session = self._session
        if not (is_tick and session.settings.synchronous and session.sensors.are_listeners_due()):
            return False
        now_s = asyncio.get_running_loop().time()
        if self._patience_s is None:
            self._patience_s = now_s + _PATIENCE_S
        return now_s < self._patience_s

    def connection_lost(self, exc: Exception | None) -> None:
        self._connections.discard(self)
        if self._next_look is not None:
            self._next_look.cancel()
        self._session.release(self._caller)

    def close(self) -> None:
        if self._transport is not None:
            self._transport.close()


class CarlaServer:
    """A server for CARLA's clients. Use `serve`, or this class to step the world yourself.

    Args:
        source: loads the world.
        port: port of the calls; the streams have the next one. 0 picks two free ports.
        host: address to listen at.
        client: version of the clients.
        limits: limits of what clients may demand.
        step_s: length of a step until a client sets it.
        other_ticks, recordings: see `CarlaSession`.

    Attributes:
        session: the state that clients share.
        port: port of the calls.

    Raises:
        ServiceError: a port is in use.
        ConfigError: the world cannot be served.
    """

    def __init__(
        self,
        source: WorldSource,
        *,
        port: int = PORT,
        host: str = LOOPBACK,
        client: str = DEFAULT_VERSION,
        limits: SessionLimits = DEFAULT_LIMITS,
        step_s: float = STEP_S,
        other_ticks: OtherTicks = "obey",
        recordings: Path | None = None,
    ) -> None:
        if not 0 <= port <= _MAX_PORT:
            raise ConfigError(f"port = {port}: must be from 0 to {_MAX_PORT}")
        version = client_version(client)
        self._sockets = _two_sockets(host, port)
        self.port, stream_port = (one.getsockname()[1] for one in self._sockets)
        self._streams = StreamHub(stream_port, limits.max_unsent)
        self._connections: set[ClientConnection] = set()
        try:
            self.session = CarlaSession(
                source, version, self._streams, limits, step_s, other_ticks, recordings
            )
        except BaseException:
            self._close_sockets()
            source.close()
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def run(self, is_over: Callable[[], bool] = lambda: False) -> None:
        """Answer clients and run the world, until `is_over` returns True or an interrupt."""
        asyncio.run(self._run(is_over))

    def close(self) -> None:
        """Close the ports, and release or close the world."""
        self._close_sockets()
        self.session.close()

    def _close_sockets(self) -> None:
        for one in self._sockets:
            one.close()

    async def _run(self, is_over: Callable[[], bool]) -> None:
        loop = asyncio.get_running_loop()
        calls, streams = self._sockets
        servers = [
            await loop.create_server(
                lambda: ClientConnection(self.session, self._connections), sock=calls
            ),
            await loop.create_server(lambda: StreamConnection(self._streams), sock=streams),
        ]
        try:
            await self._keep_time(loop, is_over)
        finally:
            for server in servers:
                server.close()
            for connection in list(self._connections):
                connection.close()
            self._streams.close()
            with suppress(asyncio.CancelledError):
                await asyncio.sleep(0)

    async def _keep_time(
        self, loop: asyncio.AbstractEventLoop, is_over: Callable[[], bool]
    ) -> None:
        """Tick by the wall clock, except in synchronous mode, in which clients tick."""
        session = self.session
        due_s = loop.time()
        while not is_over():
            if not session.settings.synchronous:
                session.tick()
            now_s = loop.time()
            due_s = max(due_s + session.delta_s, now_s - _LATE_S)
            await asyncio.sleep(max(0.0, due_s - now_s))


def _two_sockets(host: str, port: int) -> tuple[socket.socket, socket.socket]:
    """Listen at a port and at the next one, or at two free ports."""
    first = listen(host, port)
    try:
        return first, listen(host, port and port + 1)
    except BaseException:
        first.close()
        raise


def warn_of_host(host: str) -> None:
    """Log a warning if other machines can connect."""
    if not is_loopback(host):
        log.warning(
            "%s: every program that reaches this address controls the world, because CARLA's "
            "protocol has no login",
            host,
        )


def serve(
    env: str | Path | CavEnv | WorldSpec,
    *,
    port: int = PORT,
    host: str = LOOPBACK,
    any_host: bool = False,
    client: str = DEFAULT_VERSION,
    limits: SessionLimits = DEFAULT_LIMITS,
    map_file: Path | None = None,
    other_ticks: OtherTicks = "obey",
    recordings: Path | None = None,
    told: Callable[[CarlaServer], None] = lambda server: None,
) -> None:
    """Let CARLA's clients use a world, until an interrupt.

    Args:
        env: name, folder or map file of an environment; or an environment, whose agents have
            continuous actions, and which is released at the end.
        port: port of the calls; the streams have the next one. 0 picks two free ports.
        host: address to listen at.
        any_host: must be set for an address that other machines can reach.
        client: version of the clients: `0.9.15`, `0.9.16` or `0.10.0`.
        limits: limits of what clients may demand.
        other_ticks: what happens if two clients call `tick`; see `CarlaSession`.
        recordings: folder of the recordings that clients make; None: they can make none.
        map_file: the map of `env`, if `env` is a `CavEnv` whose name is in neither `./envs` nor the
            package.
        told: called with the server when it listens.

    Raises:
        ConfigError: a value is invalid, or the world cannot be served.
        ServiceError: a port is in use.
        MissingExtraError: the extra `carla` or `sumo` is not installed.
    """
    if not is_loopback(host) and not any_host:
        raise ConfigError(
            f"host = {host}: other machines can reach this address, and CARLA's protocol has no "
            "login; set any_host = True (--any-host) to allow it"
        )
    warn_of_host(host)
    source: WorldSource
    step_s = STEP_S
    if isinstance(env, CavEnv):
        source = GivenWorld(env, find_map(env.config.name) if map_file is None else map_file)
        step_s = env.step_s
    else:
        source = LoadedWorlds(WorldSpec.of(env))
    server = CarlaServer(
        source,
        port=port,
        host=host,
        client=client,
        limits=limits,
        step_s=step_s,
        other_ticks=other_ticks,
        recordings=recordings,
    )
    with server:
        told(server)
        server.run()
