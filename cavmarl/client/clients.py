"""The two clients: one waits, the other awaits; what they say is in the flows."""

from __future__ import annotations

import asyncio
import json
import time
from collections.abc import AsyncIterator, Iterator, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, Self, TypeVar

import httpx

from cavmarl.client.service_protocol import Ask, Flow, Rest, ServiceFlows, Told, check
from cavmarl.client.world_protocol import RECOVERY_S, WorldFlows
from cavmarl.core.errors import ServiceError

T = TypeVar("T")
TIMEOUT = httpx.Timeout(300.0, connect=5.0)  # a first world may compile its kernels


def _wanted(node: str | None, needs: Sequence[str], wait_s: float) -> dict[str, Any]:
    return {"node": node, "needs": list(needs), "wait_s": wait_s}


def _job(
    policies: Sequence[str], episodes: int, repeats: int, node: str | None, wait_s: float | None
) -> dict[str, Any]:
    return {
        "policies": list(policies),
        "episodes": episodes,
        "repeats": repeats,
        "node": node,
        "wait_s": wait_s,
    }


def _write(files: dict[str, bytes], folder: str | Path) -> Path:
    path = Path(folder)
    path.mkdir(parents=True, exist_ok=True)
    for name, content in files.items():
        if Path(name).name != name:
            raise ServiceError(f"result {name!r}: is no name of a file; the service is not ours")
        (path / name).write_bytes(content)
    return path


def _request(http: httpx.Client | httpx.AsyncClient, ask: Ask) -> httpx.Request:
    headers = {"Authorization": f"Bearer {ask.token}"} if ask.token else {}
    if ask.key:
        headers["Idempotency-Key"] = ask.key
    return http.build_request(
        ask.method, ask.url, json=ask.json, content=ask.content, params=ask.params, headers=headers
    )


def _event_of(line: str) -> dict[str, Any] | None:
    """The event of a line of a stream of server-sent events, if it has one."""
    if not line.startswith("data: "):
        return None
    found: dict[str, Any] = json.loads(line[len("data: ") :])
    return found


class Client:
    """A client that waits for each answer.

    Args:
        url: of the service.
        secret: of an identity, as `cavmarl serve` or `cavmarl grant` has shown it.
        verify: the file of the authority that has signed the service's certificate; True: any that
            the system trusts.
    """

    def __init__(self, url: str, secret: str, *, verify: str | bool = True) -> None:
        self._http = httpx.Client(timeout=TIMEOUT, verify=_trust(verify))
        self.flows = ServiceFlows(url, secret)

    def open(
        self,
        environment: str,
        *,
        node: str | None = None,
        needs: Sequence[str] = (),
        wait_s: float = 0.0,
        recovery_s: float = RECOVERY_S,
        **keys: Any,
    ) -> RemoteWorld:
        """A world on a node that the service chooses.

        Args:
            environment: name of an entry.
            node: the preferred one.
            needs: capabilities that a node must have.
            wait_s: how long to wait for a node.
            recovery_s: how long to look for another node when one is lost.
            keys: zones, nodes, agents, background, max_cycles, num_envs, seed, overrides, as in
                `make_vec`; nodes are those of the service. And name, under which the service
                counts versions.

        Raises:
            ServiceError: it was refused; `problem` says why.
        """
        flows = WorldFlows(self.flows, recovery_s)
        self.run(flows.open(environment, keys, _wanted(node, needs, wait_s)))
        return RemoteWorld(self, flows)

    def take_up(self, session: str) -> RemoteWorld:
        """A world that another client of the same identity has opened."""
        flows = WorldFlows(self.flows)
        self.run(flows.take_up(session))
        return RemoteWorld(self, flows)

    def submit(
        self,
        environment: str,
        *,
        policies: Sequence[str] = ("idm",),
        episodes: int = 32,
        repeats: int = 1,
        node: str | None = None,
        wait_s: float | None = None,
        **keys: Any,
    ) -> str:
        """The id of a new job: an evaluation, as `cavmarl.evaluate.evaluate` makes it.

        Where no node can take it now it waits, at most `wait_s`; then it has failed.
        """
        job = _job(policies, episodes, repeats, node, wait_s)
        return self.run(self.flows.submit(environment, keys, job))

    def wait(
        self,
        job: str,
        folder: str | Path | None = None,
        timeout_s: float = 3600.0,
        told: Told = lambda _: None,
    ) -> dict[str, Any]:
        """A job that is done; its files go to `folder`. Until then `told` what it is like."""
        found = self.run(self.flows.wait(job, timeout_s, told))
        if folder is not None:
            _write(self.run(self.flows.results(job)), folder)
        return found

    def events(self, subject: str) -> list[dict[str, Any]]:
        """What the log has of a session, a job or a node."""
        return self.run(self.flows.events(subject))

    def get(self, path: str, **params: Any) -> Any:
        """A document of the service: `/nodes`, `/sessions`, `/events`."""
        return self.run(self.flows.get(path, **params))

    def post(self, path: str, document: Any = None) -> Any:
        """What the service answers to a document."""
        return self.run(self.flows.post(path, document))

    def delete(self, path: str) -> None:
        """Take something away."""
        self.run(self.flows.delete(path))

    def follow(self, after: int = 0) -> Iterator[dict[str, Any]]:
        """Events as they come; ends when the service does."""
        url, token = f"{self.flows.url}/v1/events/stream", self.run(self.flows.token())
        ask = Ask("GET", url, params={"after": after}, token=token)
        answer = self._http.send(_request(self._http, ask), stream=True)
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
        """Carry a flow out."""
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
        return self._http.send(_request(self._http, step))

    def close(self) -> None:
        """Close the connections."""
        self._http.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class RemoteWorld:
    """Worlds on a node: arrays in and out, as those of `make_vec`."""

    def __init__(self, client: Client, flows: WorldFlows) -> None:
        self._client = client
        self.flows = flows

    def reset(self, seed: int | None = None) -> tuple[Any, dict[str, Any]]:
        """Begin an episode in every world."""
        return self._client.run(self.flows.reset(seed))

    def step(self, actions: Any) -> tuple[Any, ...]:
        """Let every agent act: observations, rewards, terminations, truncations, infos."""
        return self._client.run(self.flows.step(actions))

    def suggest_actions(self) -> Any:
        """What the built-in driver would do in each agent's place."""
        return self._client.run(self.flows.look("suggestion"))["actions"]

    def state_hash(self, world: int = 0) -> str:
        """Hex digest of one world."""
        return str(self._client.run(self.flows.look("hash"))["hashes"][world])

    def page(self) -> dict[str, str]:
        """A page that shows the worlds, on the machine of their node: its `address`, and tokens.

        `token` is to control them, `watch_token` only to watch.
        """
        found: dict[str, str] = self._client.run(self.flows.look("page"))
        return found

    def transfers(self) -> list[dict[str, Any]]:
        """Changes of owner of a divided world, the newest ones."""
        found: list[dict[str, Any]] = self._client.run(self.flows.look("transfers"))["transfers"]
        return found

    def close(self) -> None:
        """End the session."""
        self._client.run(self.flows.close())

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class AsyncClient:
    """`Client`, with `await`; of a client that is shared by tasks each world is one task's."""

    def __init__(self, url: str, secret: str, *, verify: str | bool = True) -> None:
        self._http = httpx.AsyncClient(timeout=TIMEOUT, verify=_trust(verify))
        self.flows = ServiceFlows(url, secret)

    async def open(
        self,
        environment: str,
        *,
        node: str | None = None,
        needs: Sequence[str] = (),
        wait_s: float = 0.0,
        recovery_s: float = RECOVERY_S,
        **keys: Any,
    ) -> AsyncWorld:
        """As `Client.open`."""
        flows = WorldFlows(self.flows, recovery_s)
        await self.run(flows.open(environment, keys, _wanted(node, needs, wait_s)))
        return AsyncWorld(self, flows)

    async def submit(
        self,
        environment: str,
        *,
        policies: Sequence[str] = ("idm",),
        episodes: int = 32,
        repeats: int = 1,
        node: str | None = None,
        wait_s: float | None = None,
        **keys: Any,
    ) -> str:
        """As `Client.submit`."""
        job = _job(policies, episodes, repeats, node, wait_s)
        return await self.run(self.flows.submit(environment, keys, job))

    async def wait(
        self,
        job: str,
        folder: str | Path | None = None,
        timeout_s: float = 3600.0,
        told: Told = lambda _: None,
    ) -> dict[str, Any]:
        """As `Client.wait`."""
        found = await self.run(self.flows.wait(job, timeout_s, told))
        if folder is not None:
            _write(await self.run(self.flows.results(job)), folder)
        return found

    async def events(self, subject: str) -> list[dict[str, Any]]:
        """As `Client.events`."""
        return await self.run(self.flows.events(subject))

    async def get(self, path: str, **params: Any) -> Any:
        """As `Client.get`."""
        return await self.run(self.flows.get(path, **params))

    async def follow(self, after: int = 0) -> AsyncIterator[dict[str, Any]]:
        """As `Client.follow`."""
        url, token = f"{self.flows.url}/v1/events/stream", await self.run(self.flows.token())
        ask = Ask("GET", url, params={"after": after}, token=token)
        answer = await self._http.send(_request(self._http, ask), stream=True)
        try:
            if not answer.is_success:
                await answer.aread()
                check(answer)
            async for line in answer.aiter_lines():
                if (event := _event_of(line)) is not None:
                    yield event
        finally:
            await answer.aclose()

    async def run(self, flow: Flow[T]) -> T:
        """Carry a flow out."""
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
        return await self._http.send(_request(self._http, step))

    async def close(self) -> None:
        """Close the connections."""
        await self._http.aclose()

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None
    ) -> None:
        await self.close()


class AsyncWorld:
    """`RemoteWorld`, with `await`."""

    def __init__(self, client: AsyncClient, flows: WorldFlows) -> None:
        self._client = client
        self.flows = flows

    async def reset(self, seed: int | None = None) -> tuple[Any, dict[str, Any]]:
        """Begin an episode in every world."""
        return await self._client.run(self.flows.reset(seed))

    async def step(self, actions: Any) -> tuple[Any, ...]:
        """Let every agent act."""
        return await self._client.run(self.flows.step(actions))

    async def suggest_actions(self) -> Any:
        """What the built-in driver would do in each agent's place."""
        return (await self._client.run(self.flows.look("suggestion")))["actions"]

    async def state_hash(self, world: int = 0) -> str:
        """Hex digest of one world."""
        return str((await self._client.run(self.flows.look("hash")))["hashes"][world])

    async def close(self) -> None:
        """End the session."""
        await self._client.run(self.flows.close())

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
    return ServiceError(f"{url}: cannot be reached ({error}); see that the service runs there")
