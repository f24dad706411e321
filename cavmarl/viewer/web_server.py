"""The viewer's server: the files of the page, and a WebSocket for a running world."""

from __future__ import annotations

import asyncio
import hmac
import json
import threading
from collections.abc import Callable, Sequence
from importlib.resources import files

import uvicorn
from starlette.applications import Starlette
from starlette.datastructures import Headers
from starlette.requests import Request
from starlette.responses import PlainTextResponse, Response
from starlette.routing import Route, WebSocketRoute
from starlette.types import ASGIApp, Message, Receive, Scope, Send
from starlette.websockets import WebSocket, WebSocketDisconnect
from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol

from cavmarl.core.errors import MessageError, ServiceError
from cavmarl.core.request_heads import BoundedHeads
from cavmarl.core.server_address import is_loopback, listen, shown_host
from cavmarl.viewer.page_requests import CONTROLS, MAX_TEXT, read_object, read_request
from cavmarl.viewer.subscribers import PageWatcher
from cavmarl.viewer.viewed_world import Stage, welcome_of
from cavmarl.viewer.web_options import WebOptions

PAGE = files("cavmarl.viewer") / "page"
TYPES = {
    "html": "text/html; charset=utf-8",
    "css": "text/css; charset=utf-8",
    "js": "text/javascript; charset=utf-8",
    "svg": "image/svg+xml",
}
POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self'; connect-src 'self'; "
    "frame-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'self'"
)
# Origins of Jupyter on this machine, and of notebooks in VS Code.
NOTEBOOKS = "http://127.0.0.1:* http://localhost:* vscode-webview:"
FRAMED_POLICY = POLICY.replace("frame-ancestors 'self'", f"frame-ancestors 'self' {NOTEBOOKS}")
HEADERS = {
    "content-security-policy": POLICY,
    "x-content-type-options": "nosniff",
    "referrer-policy": "no-referrer",
    "cross-origin-opener-policy": "same-origin",
    "cross-origin-resource-policy": "same-origin",
    "cache-control": "no-store",
}
MOST_WATCHERS = 250
FIRST_MESSAGE_S = 5.0
WRONG_TOKEN_S = 0.5
MAX_REASON_BYTES = 123  # limit of a close message, RFC 6455
TRY_LATER, REFUSED, NOT_UNDERSTOOD = 1013, 4401, 1003  # codes of close messages


class WebServer:
    """Serves pages from a separate thread.

    Args:
        options: address and permissions.
        stages: worlds that a page can choose, at least one.

    Raises:
        ServiceError: the port is taken, or the address is reachable from outside without a token.
    """

    def __init__(self, options: WebOptions, stages: Sequence[Stage]) -> None:
        if not is_loopback(options.host) and not options.token:
            raise ServiceError(f"--host {options.host}: reachable from outside; give a --token")
        self._listener = listen(options.host, options.port)
        self.port: int = self._listener.getsockname()[1]
        self.address = f"http://{shown_host(options.host)}:{self.port}/"
        self._stages = stages
        app = viewer_app(options, self.port, stages)
        config = uvicorn.Config(
            app,
            log_level="critical",
            access_log=False,
            server_header=False,
            lifespan="off",
            loop="asyncio",
            http=BoundedHeads,
            ws=DroppedWhenDone,
            ws_max_size=4 * MAX_TEXT,
            ws_per_message_deflate=False,
            timeout_graceful_shutdown=1,
            limit_concurrency=2 * MOST_WATCHERS,
            proxy_headers=False,
        )
        self._server = uvicorn.Server(config)
        self._thread = threading.Thread(target=self._run, name="viewer", daemon=True)

    def __enter__(self) -> WebServer:
        begun = threading.Event()
        self._begun: Callable[[], None] = begun.set
        self._thread.start()
        begun.wait(10.0)
        return self

    def __exit__(self, *_: object) -> None:
        self._server.should_exit = True
        self._thread.join(10.0)
        self._listener.close()

    def _run(self) -> None:
        asyncio.run(self._serve())

    async def _serve(self) -> None:
        for stage in self._stages:
            stage.audience.begin(asyncio.get_running_loop())
        self._begun()
        await self._server.serve(sockets=[self._listener])


class DroppedWhenDone(WebSocketsSansIOProtocol):
    """Cuts the connection if the application ends without closing it.

    A peer that does not read would never process a close message.
    """

    async def run_asgi(self) -> None:
        await super().run_asgi()
        if not self.close_sent and self.transport is not None:
            self.transport.abort()


def viewer_app(options: WebOptions, port: int, stages: Sequence[Stage]) -> ASGIApp:
    """Create the application of a server; see `WebServer`."""
    pages = {file.name: file.read_bytes() for file in PAGE.iterdir() if file.is_file()}

    async def page(request: Request) -> Response:
        name = request.path_params.get("name") or "index.html"
        content = pages.get(name)
        if content is None:
            return PlainTextResponse("file not found", 404)
        return Response(content, media_type=TYPES[name.rpartition(".")[2]])

    async def live(socket: WebSocket) -> None:
        await _LiveSocket(socket, options, stages).serve()

    routes = [Route("/", page), Route("/{name}", page), WebSocketRoute("/live", live)]
    policy = FRAMED_POLICY if options.framed else POLICY
    return OwnPagesOnly(Starlette(routes=routes), options.host, port, policy)


class OwnPagesOnly:
    """Refuses requests for another host name or from a page of another origin; adds headers.

    On the loopback address, the host name is checked as well: otherwise a foreign name that
    resolves to this machine would make a foreign page look like one of the same origin.
    """

    def __init__(self, app: ASGIApp, host: str, port: int, policy: str = POLICY) -> None:
        self._app = app
        headers = {**HEADERS, "content-security-policy": policy}
        self._headers = [(name.encode(), value.encode()) for name, value in headers.items()]
        names = {"127.0.0.1", "localhost", "[::1]", shown_host(host)}
        self._hosts = {f"{name}:{port}" for name in names} if is_loopback(host) else None

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] not in ("http", "websocket"):
            return
        headers = Headers(scope=scope)
        host, origin = headers.get("host", ""), headers.get("origin")
        foreign = self._hosts is not None and host not in self._hosts
        foreign |= origin is not None and origin != f"http://{host}"
        if foreign and scope["type"] == "websocket":
            await send({"type": "websocket.close", "code": 1008})
            return

        async def with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                message["headers"] = [*message.get("headers", []), *self._headers]
            await send(message)

        if foreign:
            refusal = PlainTextResponse("the request has a foreign host name or origin", 403)
            await refusal(scope, receive, with_headers)
        else:
            await self._app(scope, receive, with_headers)


class _LiveSocket:
    """One page's WebSocket: a hello with token and world, then requests and updates."""

    def __init__(self, socket: WebSocket, options: WebOptions, stages: Sequence[Stage]) -> None:
        self._socket = socket
        self._options = options
        self._stages = stages
        self._audience = stages[0].audience
        self._may_control = options.control

    async def serve(self) -> None:
        await self._socket.accept()
        try:
            number = await self._chosen()
            if number is None:
                return
            stage = self._stages[number]
            self._audience = stage.audience
            watcher = self._audience.join()
            try:
                welcome = welcome_of(self._stages, number, self._may_control)
                await self._send(json.dumps(welcome))
                await self._send(stage.map_bytes)
                await self._watch(watcher)
            finally:
                self._audience.leave(watcher)
        except (WebSocketDisconnect, TimeoutError, RuntimeError):
            return

    async def _chosen(self) -> int | None:
        """Return the index of the world that the page asks for; None if the page is refused."""
        if sum(stage.audience.wishes.watchers for stage in self._stages) >= MOST_WATCHERS:
            await self._socket.close(TRY_LATER, f"{MOST_WATCHERS} pages watch already; try later")
            return None
        try:
            async with asyncio.timeout(FIRST_MESSAGE_S):
                first = read_object(await self._socket.receive_text())
        except (MessageError, KeyError):
            await self._socket.close(NOT_UNDERSTOOD, "the first message must be a hello")
            return None
        token = first.get("token")
        given = token.encode(errors="surrogatepass") if isinstance(token, str) else b""
        watch = self._options.watch_token.encode()
        if watch and hmac.compare_digest(given, watch):
            self._may_control = False
        elif not hmac.compare_digest(given, self._options.token.encode()):
            if self._options.token or given:
                await asyncio.sleep(WRONG_TOKEN_S)
                await self._socket.close(
                    REFUSED, "a token is needed" if not given else "wrong token"
                )
                return None
        number, last = first.get("world", 0), len(self._stages) - 1
        if isinstance(number, bool) or not isinstance(number, int) or not 0 <= number <= last:
            await self._socket.close(NOT_UNDERSTOOD, f"no such world: must be from 0 to {last}")
            return None
        return number

    async def _watch(self, watcher: PageWatcher) -> None:
        """Send and receive until either ends."""
        tasks = {
            asyncio.create_task(self._send_news(watcher)),
            asyncio.create_task(self._listen(watcher)),
        }
        try:
            done, _ = await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
            for task in done:
                task.result()
        finally:
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)

    async def _send_news(self, watcher: PageWatcher) -> None:
        while not watcher.is_lost:
            await watcher.news.wait()
            try:
                for message in watcher.take():
                    await self._send(message)
            except TimeoutError:
                break
        self._audience.dropped += 1

    async def _send(self, message: str | bytes) -> None:
        async with asyncio.timeout(self._options.send_s):
            if isinstance(message, str):
                await self._socket.send_text(message)
            else:
                await self._socket.send_bytes(message)

    async def _listen(self, watcher: PageWatcher) -> None:
        while True:
            try:
                request = read_request(await self._socket.receive_text())
            except (MessageError, KeyError) as error:
                await self._socket.close(NOT_UNDERSTOOD, _close_reason(error))
                return
            if self._may_control or request.kind not in CONTROLS:
                self._audience.ask(watcher, request)


def _close_reason(error: Exception) -> str:
    """Return the start of an error's message that fits into a close message of WebSocket."""
    return str(error).encode(errors="replace")[:MAX_REASON_BYTES].decode(errors="ignore")
