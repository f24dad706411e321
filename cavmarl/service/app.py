"""The HTTP interface: a FastAPI application around a broker and its access control.

Each route must declare which roles may use it; otherwise the application does not start.
"""

from __future__ import annotations

import asyncio
import re
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, suppress

from fastapi import APIRouter, FastAPI
from fastapi.routing import APIRoute
from fastapi.telemetry import TelemetryConfig
from starlette.exceptions import HTTPException
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from cavmarl.core.errors import ServiceError
from cavmarl.service.problem_json import FAULT, answer, serve_routes
from cavmarl.service.route_access import Service, rule_of
from cavmarl.service.routes import ROUTERS
from cavmarl.service.service_metrics import ServiceMetrics

MAX_BODY_BYTES = 256 * 1024
MAX_CONTENT_BYTES = 64 * 1024 * 1024  # maximum size of a saved state, a result or an artefact
_CONTENT = re.compile(r"/v1/(sessions/[^/]+/state|jobs/[^/]+/results/[^/]+|artefacts/[^/]+)")
MAX_PATH_BYTES = 1024
MAX_SECRET_BYTES = 64 * 1024  # maximum body of POST /v1/token, which needs no token
NO_TELEMETRY: TelemetryConfig = {  # do not export telemetry, whatever the environment configures
    "tracing": False,
    "metrics": False,
    "logs": False,
    "auto_configure": False,
}
BODY_S = 10.0  # time limit for receiving a body
CHECK_S = 0.05  # a thread checks older events for this time, then pauses for the same time
HEADERS = {
    b"x-content-type-options": b"nosniff",
    b"cache-control": b"no-store",
    b"content-security-policy": b"default-src 'none'",
    b"referrer-policy": b"no-referrer",
}


def make_app(service: Service, sweep_s: float = 0.5) -> ASGIApp:
    """Return the application. It also calls the broker's `sweep` at a fixed interval."""

    @asynccontextmanager
    async def lifespan(_: FastAPI) -> AsyncIterator[None]:
        is_over = asyncio.Event()
        sweeper = asyncio.create_task(_sweep(service, sweep_s))
        checker = asyncio.create_task(_check_older(service, is_over))
        yield
        sweeper.cancel()
        with suppress(asyncio.CancelledError):
            await sweeper
        is_over.set()
        await checker

    app = FastAPI(
        title="cavmarl coordination service",
        version="1",
        openapi_url="/v1/openapi.json",
        docs_url=None,
        redoc_url=None,
        redirect_slashes=False,
        telemetry=NO_TELEMETRY,
        lifespan=lifespan,
    )
    app.state.service = service
    for router in ROUTERS:
        _check_rules(router)
    serve_routes(app, ROUTERS)
    app.state.metrics = ServiceMetrics(service.broker, app.state.rejected)
    app.state.on_misreport = service.broker.misreported
    return GuardedRequests(app)


def _check_rules(router: APIRouter) -> None:
    for route in router.routes:
        if isinstance(route, APIRoute) and rule_of(route) is None:
            raise ServiceError(f"route {route.path}: does not declare which roles may use it")


async def _sweep(service: Service, every_s: float) -> None:
    log = service.broker.log
    while True:
        await asyncio.sleep(every_s)
        service.broker.sweep()
        try:
            await log.settle()
            await asyncio.to_thread(log.store.check_lock)
        except ServiceError as error:
            log.failure = log.failure or error
            service.on_broken()
            return


async def _check_older(service: Service, is_over: asyncio.Event) -> None:
    """Check events before the snapshot, at most half of the time; end the service on an error."""
    log = service.broker.log
    try:
        while not is_over.is_set() and not await asyncio.to_thread(log.check_older, CHECK_S):
            with suppress(TimeoutError):
                await asyncio.wait_for(is_over.wait(), CHECK_S)
    except ServiceError as error:
        log.failure = error
        service.on_broken()


class GuardedRequests:
    """Middleware that refuses long paths and large or slow bodies, and adds security headers.

    Args:
        app: the application to protect.
        content_bytes: maximum size of a state, result or artefact, read after authentication.
        body_bytes: maximum size of any other body.
    """

    def __init__(
        self,
        app: ASGIApp,
        content_bytes: int = MAX_CONTENT_BYTES,
        body_bytes: int = MAX_BODY_BYTES,
    ) -> None:
        self._app = app
        self._content_bytes, self._body_bytes = content_bytes, body_bytes

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        until_s = asyncio.get_running_loop().time() + BODY_S
        is_content = scope["method"] == "PUT" and _CONTENT.fullmatch(scope["path"])
        is_secret = scope["path"] == "/v1/token"
        usual = MAX_SECRET_BYTES if is_secret else self._body_bytes
        left = self._content_bytes if is_content else usual
        is_read = False

        async def receive_in_time() -> Message:
            nonlocal is_read, left
            if is_read:  # the next message says that the client has disconnected
                return await receive()
            try:
                async with asyncio.timeout_at(until_s):
                    message = await receive()
            except TimeoutError:
                raise HTTPException(408, f"the body was not received within {BODY_S:g} s") from None
            left -= len(message.get("body", b""))
            if left < 0:
                raise HTTPException(413, "the body is too large for this route")
            is_read = not message.get("more_body", False)
            return message

        async def send_with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                message = {**message, "headers": [*message["headers"], *HEADERS.items()]}
            await send(message)

        if len(scope["raw_path"]) + len(scope["query_string"]) > MAX_PATH_BYTES:
            refusal = answer("bad-body", f"the path is longer than {MAX_PATH_BYTES} bytes")
            await refusal(scope, receive, send_with_headers)
            return
        try:
            await self._app(scope, receive_in_time, send_with_headers)
        except Exception as error:
            # An error kept as FAULT was logged, and the client has its answer.
            if scope.get(FAULT) is not error:
                raise
