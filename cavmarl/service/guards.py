"""What each route stands on: which roles may use it, and that its answer is on disk."""

from __future__ import annotations

from collections.abc import Callable, Coroutine
from dataclasses import dataclass
from typing import Annotated, Any

from fastapi import Depends, Request, Response
from fastapi.routing import APIRoute

from cavmarl.core.errors import ServiceError
from cavmarl.service.access import Access, RateLimit
from cavmarl.service.broker import Broker
from cavmarl.service.infrastructure import ROLES, IdentityRecord
from cavmarl.service.refusals import problem


@dataclass
class Service:
    """What routes work on.

    Attributes:
        on_broken: called when the store cannot be written: the process has to end.
    """

    broker: Broker
    access: Access
    by_identity: RateLimit
    by_address: RateLimit  # where there is no identity yet
    on_broken: Callable[[], None] = lambda: None


def service_of(request: Request) -> Service:
    found: Service = request.app.state.service
    return found


async def _given(request: Request) -> Service:
    return service_of(request)


TheService = Annotated[Service, Depends(_given)]  # what is not async would go through a thread


class may:
    """Lets the identities of some roles use a route; it gives the route the identity."""

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
        if identity.role not in self.roles:
            raise problem(
                "forbidden",
                f"role {identity.role} may not do this; {', '.join(sorted(self.roles))} may",
            )
        return identity


class open_to_all(may):
    """A route without a token: counted by address."""

    def __init__(self) -> None:
        super().__init__(*ROLES)

    async def __call__(self, request: Request) -> IdentityRecord:
        service_of(request).by_address.take(_address(request))
        return IdentityRecord("nobody", "nobody", "viewer", "")


class DurableRoute(APIRoute):
    """A route that answers when what it tells of is on disk."""

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


def rule_of(route: APIRoute) -> may | None:
    """The dependency that says which roles may use a route."""
    for one in route.dependant.dependencies:
        if isinstance(one.call, may):
            return one.call
    return None


def _address(request: Request) -> str:
    return request.client.host if request.client else "local"
