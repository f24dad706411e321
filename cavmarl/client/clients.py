"""The synchronous and the asynchronous client; their protocol is in `service_protocol`."""

from __future__ import annotations

import asyncio
import json
import time
from collections.abc import AsyncIterator, Callable, Coroutine, Iterator, Sequence
from functools import wraps
from pathlib import Path
from typing import Any, Concatenate, ParamSpec, Protocol, Self, TypeVar

import httpx

from cavmarl.client.service_protocol import Ask, Flow, Rest, ServiceFlows, check
from cavmarl.client.world_protocol import RECOVERY_S, WorldFlows
from cavmarl.core.errors import ServiceError
from cavmarl.core.server_address import is_loopback

P = ParamSpec("P")
T = TypeVar("T")
Flows = TypeVar("Flows")
TIMEOUT = httpx.Timeout(300.0, connect=5.0)  # the first world may compile kernels


class _Blocking(Protocol[Flows]):
    flows: Flows

    def run(self, flow: Flow[T]) -> T: ...


class _Awaitable(Protocol[Flows]):
    flows: Flows

    async def run(self, flow: Flow[T]) -> T: ...


def _method(flow: Callable[..., Flow[Any]]) -> Any:
    """Return a method that calls `flow` with the object's `flows`, and runs the returned flow."""

    @wraps(flow)
    def method(self: Any, *arguments: Any, **named: Any) -> Any:
        return self.run(flow(self.flows, *arguments, **named))

    return method


def blocking(
    flow: Callable[Concatenate[Flows, P], Flow[T]],
) -> Callable[Concatenate[_Blocking[Flows], P], T]:
    """Return a method that runs a flow and returns the result."""
    return _method(flow)  # type: ignore[no-any-return]


def awaitable(
    flow: Callable[Concatenate[Flows, P], Flow[T]],
) -> Callable[Concatenate[_Awaitable[Flows], P], Coroutine[Any, Any, T]]:
    """Return a method that returns a coroutine, which runs a flow."""
    return _method(flow)  # type: ignore[no-any-return]


def _wanted(node: str | None, needs: Sequence[str], wait_s: float) -> dict[str, Any]:
    return {"node": node, "needs": list(needs), "wait_s": wait_s}


def _request(
    http: httpx.Client | httpx.AsyncClient, ask: Ask, allow_plain_http: bool
) -> httpx.Request:
    """Return a request.

    Raises:
        ServiceError: others could read its secret or token on the network.
    """
    url = httpx.URL(ask.url)
    if url.scheme != "https" and not is_loopback(url.host) and not allow_plain_http:
        raise ServiceError(
            f"{url.scheme}://{url.netloc.decode()}: is another machine, and without TLS others "
            "can read the secret: use https://, or allow_plain_http=True (--plain-http) in a "
            "network that you trust"
        )
    headers = {"Authorization": f"Bearer {ask.token}"} if ask.token else {}
    if ask.key:
        headers["Idempotency-Key"] = ask.key
    return http.build_request(
        ask.method, ask.url, json=ask.json, content=ask.content, params=ask.params, headers=headers
    )


def _event_of(line: str) -> dict[str, Any] | None:
    """Return the event in a line of a stream of server-sent events, or None."""
    if not line.startswith("data: "):
        return None
    found: dict[str, Any] = json.loads(line[len("data: ") :])
    return found


class Client:
    """A synchronous client.

    Args:
        url: URL of the service; URLs of its standbys may follow, comma-separated.
        secret: secret of an identity, as printed by `cavmarl serve` or `cavmarl grant`.
        verify: certificate file of the authority that signed the service's certificate; True
            accepts the authorities that the system trusts.
        allow_plain_http: send the secret and tokens to other machines even without TLS.
    """

    def __init__(
        self, url: str, secret: str, *, verify: str | bool = True, allow_plain_http: bool = False
    ) -> None:
        self._http = httpx.Client(timeout=TIMEOUT, verify=_trust(verify))
        self._allow_plain_http = allow_plain_http
        self.flows = ServiceFlows(url, secret)

    def open(
        self,
        environment: str | Path,
        *,
        node: str | None = None,
        needs: Sequence[str] = (),
        wait_s: float = 0.0,
        recovery_s: float = RECOVERY_S,
        **keys: Any,
    ) -> RemoteWorld:
        """Open a world on a node that the service selects.

        Args:
            environment: name of an environment of the service, or the `Path` of your own: a folder
                with an env.yaml, or a map. Its files are uploaded once.
            node: preferred node.
            needs: capabilities that the node must have.
            wait_s: longest wait for a node in s.
            recovery_s: longest search in s for another node after a loss.
            keys: `zones`, `agents`, `background`, `max_cycles`, `num_envs`, `seed` and `overrides`,
                as in `make_vec`. `nodes`: number of nodes of the service that host the zones.
                `name`: name under which the service numbers the versions of the configuration.
                `drivers`: folders of your trained drivers, by the names that `traffic.model` and
                `policies` use. `licence`: licence of your files, as text.

        Raises:
            ServiceError: the request was refused; `problem` names the reason.
        """
        flows = WorldFlows(self.flows, recovery_s)
        self.run(flows.open(environment, keys, _wanted(node, needs, wait_s)))
        return RemoteWorld(self, flows)

    def take_up(self, session: str) -> RemoteWorld:
        """Return a world that another client of the same identity has opened."""
        flows = WorldFlows(self.flows)
        self.run(flows.take_up(session))
        return RemoteWorld(self, flows)

    submit = blocking(ServiceFlows.submit)
    train = blocking(ServiceFlows.train)
    wait = blocking(ServiceFlows.wait)
    events = blocking(ServiceFlows.events)
    get = blocking(ServiceFlows.get)
    post = blocking(ServiceFlows.post)
    delete = blocking(ServiceFlows.delete)

    def follow(self, after: int = 0) -> Iterator[dict[str, Any]]:
        """Yield events as they happen, until the service ends."""
        url, token = f"{self.flows.url}/v1/events/stream", self.run(self.flows.token())
        ask = Ask("GET", url, params={"after": after}, token=token)
        answer = self._http.send(self._request(ask), stream=True)
        try:
            if not answer.is_success:
                answer.read()
                check(answer)
            for line in answer.iter_lines():
                if (event := _event_of(line)) is not None:
                    yield event
        except httpx.TransportError:
            return
        finally:
            answer.close()

    def run(self, flow: Flow[T]) -> T:
        """Execute a flow."""
        try:
            step = next(flow)
            while True:
                try:
                    answer = self._perform(step)
                except httpx.TransportError as error:
                    step = flow.throw(error)
                else:
                    step = flow.send(answer)
        except StopIteration as end:
            found: T = end.value
            return found
        except httpx.TransportError as error:
            raise _unreachable(self.flows.url, error) from error

    def _perform(self, step: Ask | Rest) -> httpx.Response | None:
        if isinstance(step, Rest):
            time.sleep(step.time_s)
            return None
        return self._http.send(self._request(step))

    def _request(self, ask: Ask) -> httpx.Request:
        return _request(self._http, ask, self._allow_plain_http)

    def close(self) -> None:
        """Close the connections."""
        self._http.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class RemoteWorld:
    """Worlds on a node, with arrays in the same form as from `make_vec`."""

    def __init__(self, client: Client, flows: WorldFlows) -> None:
        self._client = client
        self.flows = flows

    def run(self, flow: Flow[T]) -> T:
        """Execute a flow."""
        return self._client.run(flow)

    reset = blocking(WorldFlows.reset)
    step = blocking(WorldFlows.step)
    suggest_actions = blocking(WorldFlows.suggest_actions)
    state_hash = blocking(WorldFlows.state_hash)
    page = blocking(WorldFlows.page)
    transfers = blocking(WorldFlows.transfers)
    frames = blocking(WorldFlows.frames)
    insert_vehicle = blocking(WorldFlows.insert_vehicle)
    close_road = blocking(WorldFlows.close_road)
    open_road = blocking(WorldFlows.open_road)
    damage_road = blocking(WorldFlows.damage_road)
    declare_event = blocking(WorldFlows.declare_event)
    scenario = blocking(WorldFlows.scenario)
    save_state = blocking(WorldFlows.save_state)
    record = blocking(WorldFlows.record)
    recording = blocking(WorldFlows.recording)
    close = blocking(WorldFlows.close)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class AsyncClient:
    """A client with coroutines. Tasks may share it, but each world belongs to one task."""

    def __init__(
        self, url: str, secret: str, *, verify: str | bool = True, allow_plain_http: bool = False
    ) -> None:
        self._http = httpx.AsyncClient(timeout=TIMEOUT, verify=_trust(verify))
        self._allow_plain_http = allow_plain_http
        self.flows = ServiceFlows(url, secret)

    async def open(
        self,
        environment: str | Path,
        *,
        node: str | None = None,
        needs: Sequence[str] = (),
        wait_s: float = 0.0,
        recovery_s: float = RECOVERY_S,
        **keys: Any,
    ) -> AsyncWorld:
        """Like `Client.open`."""
        flows = WorldFlows(self.flows, recovery_s)
        await self.run(flows.open(environment, keys, _wanted(node, needs, wait_s)))
        return AsyncWorld(self, flows)

    submit = awaitable(ServiceFlows.submit)
    train = awaitable(ServiceFlows.train)
    wait = awaitable(ServiceFlows.wait)
    events = awaitable(ServiceFlows.events)
    get = awaitable(ServiceFlows.get)

    async def follow(self, after: int = 0) -> AsyncIterator[dict[str, Any]]:
        """Like `Client.follow`."""
        url, token = f"{self.flows.url}/v1/events/stream", await self.run(self.flows.token())
        ask = Ask("GET", url, params={"after": after}, token=token)
        answer = await self._http.send(self._request(ask), stream=True)
        try:
            if not answer.is_success:
                await answer.aread()
                check(answer)
            async for line in answer.aiter_lines():
                if (event := _event_of(line)) is not None:
                    yield event
        except httpx.TransportError:
            return
        finally:
            await answer.aclose()

    async def run(self, flow: Flow[T]) -> T:
        """Execute a flow."""
        try:
            step = next(flow)
            while True:
                try:
                    answer = await self._perform(step)
                except httpx.TransportError as error:
                    step = flow.throw(error)
                else:
                    step = flow.send(answer)
        except StopIteration as end:
            found: T = end.value
            return found
        except httpx.TransportError as error:
            raise _unreachable(self.flows.url, error) from error

    async def _perform(self, step: Ask | Rest) -> httpx.Response | None:
        if isinstance(step, Rest):
            await asyncio.sleep(step.time_s)
            return None
        return await self._http.send(self._request(step))

    def _request(self, ask: Ask) -> httpx.Request:
        return _request(self._http, ask, self._allow_plain_http)

    async def close(self) -> None:
        """Close the connections."""
        await self._http.aclose()

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *_: object) -> None:
        await self.close()


class AsyncWorld:
    """`RemoteWorld` with coroutines."""

    def __init__(self, client: AsyncClient, flows: WorldFlows) -> None:
        self._client = client
        self.flows = flows

    async def run(self, flow: Flow[T]) -> T:
        """Execute a flow."""
        return await self._client.run(flow)

    reset = awaitable(WorldFlows.reset)
    step = awaitable(WorldFlows.step)
    suggest_actions = awaitable(WorldFlows.suggest_actions)
    state_hash = awaitable(WorldFlows.state_hash)
    page = awaitable(WorldFlows.page)
    transfers = awaitable(WorldFlows.transfers)
    frames = awaitable(WorldFlows.frames)
    insert_vehicle = awaitable(WorldFlows.insert_vehicle)
    close_road = awaitable(WorldFlows.close_road)
    open_road = awaitable(WorldFlows.open_road)
    damage_road = awaitable(WorldFlows.damage_road)
    declare_event = awaitable(WorldFlows.declare_event)
    scenario = awaitable(WorldFlows.scenario)
    save_state = awaitable(WorldFlows.save_state)
    record = awaitable(WorldFlows.record)
    recording = awaitable(WorldFlows.recording)
    close = awaitable(WorldFlows.close)

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *_: object) -> None:
        await self.close()


def _trust(verify: str | bool) -> Any:
    if isinstance(verify, bool):
        return verify
    import ssl

    return ssl.create_default_context(cafile=verify)


def _unreachable(url: str, error: Exception) -> ServiceError:
    return ServiceError(f"{url}: cannot be reached ({error}); check that the service runs there")
