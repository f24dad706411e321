"""Base parts of routes: roles, rate limits, strict parameters and durable answers."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Coroutine, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Annotated, Any

from fastapi import Depends, Request, Response
from fastapi.openapi.models import HTTPBearer
from fastapi.routing import APIRoute
from fastapi.security.base import SecurityBase

from cavmarl.core.errors import ServiceError
from cavmarl.service.access import Access
from cavmarl.service.broker import Broker
from cavmarl.service.error_names import problem
from cavmarl.service.rate_limit import RateLimit
from cavmarl.service.service_records import ROLES, IdentityRecord

MOST_HELD = 64


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
    by_address: RateLimit  # before the identity is known
    on_broken: Callable[[], None] = lambda: None
    held: Counter[str] = field(default_factory=Counter)

    @contextmanager
    def holding(self, identity: IdentityRecord) -> Iterator[None]:
        """Count a stream or a waiting request while it is open; raise `too-many` at the limit."""
        if self.held[identity.id] >= MOST_HELD:
            detail = f"{MOST_HELD} requests of yours wait or follow events: end some"
            raise problem("too-many", detail, 5.0)
        self.held[identity.id] += 1
        try:
            yield
        finally:
            self.held[identity.id] -= 1


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
        raise NotImplementedError


class may(Rule, SecurityBase):
    """Return the dependency of a route for some roles, whose identities send a token."""

    model = HTTPBearer(bearerFormat="JWT", description="An access token of POST /v1/token")
    scheme_name = "token"

    def __init__(self, *roles: str) -> None:
        assert set(roles) <= set(ROLES)
        self.roles = frozenset(roles)

    async def __call__(self, request: Request) -> IdentityRecord:
        service = service_of(request)
        kind, _, token = request.headers.get("authorization", "").partition(" ")
        if kind.lower() != "bearer" or not token:
            service.by_address.take(_address(request))
            raise problem("bad-token", "send Authorization: Bearer TOKEN; /v1/token gives one")
        try:
            identity = service.access.authenticate(token.strip())
        except ServiceError:
            service.by_address.take(_address(request))
            raise
        service.by_identity.take(identity.id)
        request.state.identity = identity
        if identity.role not in self.roles:
            raise problem(
                "forbidden",
                f"role {identity.role} may not do this; {', '.join(sorted(self.roles))} may",
            )
        return identity


class open_to_all(Rule):
    """Admit requests without a token; their rate is limited by client address."""

    roles = frozenset(ROLES)

    async def __call__(self, request: Request) -> IdentityRecord:
        service_of(request).by_address.take(_address(request))
        return IdentityRecord("unknown", "unknown", "viewer", "")


class StrictRoute(APIRoute):
    """A route that refuses unknown parameters, so that a typo is not ignored."""

    def get_route_handler(self) -> Callable[[Request], Coroutine[Any, Any, Response]]:
        handle = super().get_route_handler()
        known = {one.alias for one in self.dependant.query_params}

        async def check_and_handle(request: Request) -> Response:
            for name in request.query_params if request.scope["query_string"] else ():
                if name not in known:
                    there = ", ".join(sorted(known)) or "none"
                    raise problem(
                        "bad-body", f"query.{name[:64]}: is unknown; known parameters: {there}"
                    )
            return await handle(request)

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
