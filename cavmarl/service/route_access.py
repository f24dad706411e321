"""Base parts of routes: roles, rate limits, strict parameters and durable answers."""

from __future__ import annotations

import json
import math
import re
from collections import Counter
from collections.abc import Callable, Coroutine, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Annotated, Any, NoReturn

from fastapi import Depends, HTTPException, Request, Response
from fastapi.openapi.models import HTTPBearer
from fastapi.routing import APIRoute
from fastapi.security.base import SecurityBase

from cavmarl.core.errors import ServiceError
from cavmarl.service.access import Access
from cavmarl.service.broker import Broker
from cavmarl.service.error_names import problem
from cavmarl.service.rate_limit import RateLimit
from cavmarl.service.service_records import ROLES, IdentityRecord

MOST_HELD = 64  # open streams and waiting requests of one identity
MOST_NESTED = 32  # arrays and objects of JSON inside each other
_TEXT = re.compile(rb'"(?:[^"\\]|\\.)*"?', re.DOTALL)
_NO_BRACKETS = bytes(byte for byte in range(256) if byte not in b"[]{}")
_SURROGATE = re.compile(rb"\\u[dD][89a-fA-F]")


@dataclass
class Service:
    """The objects that routes work on.

    Attributes:
        on_broken: called when the store cannot be written, after which the process must end.
        held: number of open streams and waiting requests of each identity.
    """

    broker: Broker
    access: Access
    by_identity: RateLimit
    by_address: RateLimit  # before the identity is known; each purpose has its own limit
    on_broken: Callable[[], None] = lambda: None
    held: Counter[str] = field(default_factory=Counter)

    @contextmanager
    def holding(self, identity: IdentityRecord) -> Iterator[None]:
        """Count a stream or a waiting request while it is open; raise `too-many` at the limit."""
        if self.held[identity.id] >= MOST_HELD:
            detail = f"you have {MOST_HELD} event streams and waiting requests, the limit: end some"
            raise problem("too-many", detail, 5.0)
        self.held[identity.id] += 1
        try:
            yield
        finally:
            self.held[identity.id] -= 1

    def admit_exchange(self, identity: str) -> None:
        """Count an exchange of a valid secret; the limit is not shared with other requests."""
        self.by_identity.take(f"exchange {identity}")

    @contextmanager
    def counting_wrong_secrets(self, request: Request) -> Iterator[None]:
        """Count wrong secrets by address; valid ones pass at any count, so nobody blocks others."""
        try:
            yield
        except ServiceError as error:
            if error.problem == "bad-token":
                self.by_address.take(f"exchange {_address(request)}")
            raise


def service_of(request: Request) -> Service:
    found: Service = request.app.state.service
    return found


async def _given(request: Request) -> Service:
    return service_of(request)


TheService = Annotated[
    Service, Depends(_given)
]  # FastAPI would run a function that is not async in a thread


class Rule:
    """A dependency that admits identities of some roles and passes the identity to the route."""

    roles: frozenset[str]

    async def __call__(self, request: Request) -> IdentityRecord:
        """Return the identity of a request, which is determined once."""
        if not hasattr(request.state, "identity"):
            request.state.identity = self.identify(request)
        identity: IdentityRecord = request.state.identity
        return self.check(identity)

    def identify(self, request: Request) -> IdentityRecord:
        raise NotImplementedError

    def check(self, identity: IdentityRecord) -> IdentityRecord:
        return identity


class may(Rule, SecurityBase):
    """Return the dependency of a route for some roles, whose identities send a token."""

    model = HTTPBearer(bearerFormat="JWT", description="An access token of POST /v1/token")
    scheme_name = "token"

    def __init__(self, *roles: str) -> None:
        assert set(roles) <= set(ROLES)
        self.roles = frozenset(roles)

    def identify(self, request: Request) -> IdentityRecord:
        """Return the identity of a token. Invalid tokens have no rate limit.

        With a limit per address, a client could be told to wait instead of to get a new token.
        """
        service = service_of(request)
        kind, _, token = request.headers.get("authorization", "").partition(" ")
        if kind.lower() != "bearer" or not token:
            raise problem("bad-token", "send Authorization: Bearer TOKEN; /v1/token gives one")
        identity = service.access.authenticate(token.strip())
        service.by_identity.take(identity.id)
        return identity

    def check(self, identity: IdentityRecord) -> IdentityRecord:
        if identity.role not in self.roles:
            raise problem(
                "forbidden",
                f"role {identity.role} may not do this; {', '.join(sorted(self.roles))} may",
            )
        return identity


class open_to_all(Rule):
    """Admit requests without a token; their rate is limited by route and client address."""

    roles = frozenset(ROLES)

    def __init__(self, is_limited: bool = True) -> None:
        self._is_limited = is_limited

    def identify(self, request: Request) -> IdentityRecord:
        if self._is_limited:
            purpose = request.scope["route"].path
            service_of(request).by_address.take(f"{purpose} {_address(request)}")
        return IdentityRecord("unknown", "unknown", "viewer", "")


class StrictRequest(Request):
    """A request whose JSON is bounded and valid, so that it can be checked, kept and sent again."""

    async def json(self) -> Any:
        """Return the body as JSON; refuse deep nesting, NaN and halves of surrogate pairs."""
        if not hasattr(self, "_document"):
            self._document = _read_json(await self.body())
        return self._document


def _read_json(content: bytes) -> Any:
    depth = deepest = 0
    for bracket in _TEXT.sub(b"", content).translate(None, _NO_BRACKETS):
        depth += 1 if bracket in b"[{" else -1
        deepest = max(deepest, depth)
    if deepest > MOST_NESTED:
        raise HTTPException(422, f"body: is nested {deepest} deep: at most {MOST_NESTED}")
    try:
        found = json.loads(
            content.decode(), parse_constant=_refuse_constant, parse_float=_finite_number
        )
        if _SURROGATE.search(content):
            json.dumps(found, ensure_ascii=False).encode()
    except json.JSONDecodeError:
        raise
    except ValueError as error:  # UnicodeError, a constant or a number with too many digits
        raise HTTPException(422, f"body: is not valid JSON in UTF-8 ({error!s:.100})") from None
    return found


def _finite_number(text: str) -> float:
    number = float(text)
    if math.isinf(number):
        raise ValueError(f"{text:.20} is too large")
    return number


def _refuse_constant(name: str) -> NoReturn:
    raise ValueError(f"{name} is not a number")


class StrictRoute(APIRoute):
    """A route that authenticates before it reads the body, and refuses unknown parameters."""

    def get_route_handler(self) -> Callable[[Request], Coroutine[Any, Any, Response]]:
        handle = super().get_route_handler()
        known = {one.alias for one in self.dependant.query_params}
        rule = rule_of(self)

        async def check_and_handle(request: Request) -> Response:
            if rule is not None:
                await rule(request)
            for name in request.query_params if request.scope["query_string"] else ():
                if name not in known:
                    there = ", ".join(sorted(known)) or "none"
                    raise problem(
                        "bad-body", f"query.{name[:64]}: is unknown; known parameters: {there}"
                    )
            return await handle(StrictRequest(request.scope, request.receive))

        return check_and_handle


class DurableRoute(StrictRoute):
    """A route that answers only after all events that its answer refers to are on disk."""

    def get_route_handler(self) -> Callable[[Request], Coroutine[Any, Any, Response]]:
        handle = super().get_route_handler()

        async def handle_and_settle(request: Request) -> Response:
            service = service_of(request)
            try:
                return await handle(request)
            finally:
                try:
                    await service.broker.log.settle()
                except ServiceError:
                    service.on_broken()
                    raise

        return handle_and_settle


def rule_of(route: APIRoute) -> Rule | None:
    """Return the dependency that declares which roles may use a route."""
    for one in route.dependant.dependencies:
        if isinstance(one.call, Rule):
            return one.call
    return None


def _address(request: Request) -> str:
    return request.client.host if request.client else "local"
