"""The synchronous and the asynchronous client; their protocol is in `service_protocol`."""

from __future__ import annotations

import asyncio
import json
import time
from collections.abc import AsyncIterator, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Self, TypeVar

import httpx

from cavmarl.client.recording_parts import unpack_recordings
from cavmarl.client.service_protocol import Ask, Flow, Rest, ServiceFlows, Told, check
from cavmarl.client.world_protocol import RECOVERY_S, WorldFlows
from cavmarl.core.errors import ServiceError
from cavmarl.core.server_address import is_loopback
from cavmarl.sensors.mounted.frames import SensorFrames

T = TypeVar("T")
TIMEOUT = httpx.Timeout(300.0, connect=5.0)  # the first world may compile kernels


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
        (path / name).write_bytes(content)
    return path


def _request(
    http: httpx.Client | httpx.AsyncClient, ask: Ask, allow_plain_http: bool
) -> httpx.Request:
    """Return a request.

    Raises:
        ServiceError: its secret or token could be read on the way to another machine.
    """
    url = httpx.URL(ask.url)
    if url.scheme != "https" and not is_loopback(url.host) and not allow_plain_http:
        raise ServiceError(
            f"{url.scheme}://{url.netloc.decode()}: is another machine, and without TLS the secret "
            "can be read on the way: use https://, or allow_plain_http=True (--plain-http) in a "
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
        url: of the service; after a comma, those of its standbys.
        secret: of an identity, as printed by `cavmarl serve` or `cavmarl grant`.
        verify: certificate file of the authority that signed the service's certificate; True
            accepts the authorities that the system trusts.
        allow_plain_http: send the secret and tokens to other machines without TLS, too.
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
            keys: `zones`, `nodes`, `agents`, `background`, `max_cycles`, `num_envs`, `seed` and
                `overrides` as in `make_vec`; `nodes` is a number of nodes of the service; `name`:
                name under which the service numbers the versions of the configuration; `drivers`:
                folders of trained drivers of yours, by the names with which `traffic.model` and
                `policies` name them; `licence`: that of your files, as text.

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

    def submit(
        self,
        environment: str | Path,
        *,
        policies: Sequence[str] = ("idm",),
        episodes: int = 32,
        repeats: int = 1,
        node: str | None = None,
        wait_s: float | None = None,
        **keys: Any,
    ) -> str:
        """Submit an evaluation as by `cavmarl.evaluate.evaluate`, and return the id of the job.

        If no node is free, the job waits at most `wait_s` and then fails.
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
        """Wait for a job, and write its files to `folder`.

        Meanwhile `told` is called with the state of the job.
        """
        found = self.run(self.flows.wait(job, timeout_s, told))
        if folder is not None:
            _write(self.run(self.flows.results(job)), folder)
        return found

    def events(self, subject: str) -> list[dict[str, Any]]:
        """Return the events of a session, a job or a node."""
        return self.run(self.flows.events(subject))

    def get(self, path: str, **params: Any) -> Any:
        """Return a document of the service: `/nodes`, `/sessions` or `/events`."""
        return self.run(self.flows.get(path, **params))

    def post(self, path: str, document: Any = None) -> Any:
        """Send a document to the service and return the answer."""
        return self.run(self.flows.post(path, document))

    def delete(self, path: str) -> None:
        """Delete a resource of the service."""
        self.run(self.flows.delete(path))

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
    """Worlds on a node, with arrays like those of `make_vec`."""

    def __init__(self, client: Client, flows: WorldFlows) -> None:
        self._client = client
        self.flows = flows

    def reset(self, seed: int | None = None) -> tuple[Any, dict[str, Any]]:
        """Start an episode in every world."""
        return self._client.run(self.flows.reset(seed))

    def step(self, actions: Any) -> tuple[Any, ...]:
        """Step all worlds; return observations, rewards, terminations, truncations and infos."""
        return self._client.run(self.flows.step(actions))

    def suggest_actions(self) -> Any:
        """Return the built-in driver's actions."""
        return self._client.run(self.flows.look("suggestion"))["actions"]

    def state_hash(self, world: int = 0) -> str:
        """Return the state hash of one world."""
        return str(self._client.run(self.flows.look("hash"))["hashes"][world])

    def page(self) -> dict[str, str]:
        """Open a page of the worlds on the node's machine; return its `address` and tokens.

        `token` allows control, `watch_token` only watching.
        """
        found: dict[str, str] = self._client.run(self.flows.look("page"))
        return found

    def transfers(self) -> list[dict[str, Any]]:
        """Return the most recent ownership transfers of a divided world."""
        found: list[dict[str, Any]] = self._client.run(self.flows.look("transfers"))["transfers"]
        return found

    def frames(self, final: bool = False) -> dict[str, SensorFrames]:
        """Return the samples of the mounted sensors, as `frames` of `make_vec` does.

        With `final`, return those before the reset, as `final_frames` does.
        """
        return self._client.run(self.flows.frames(final))

    def insert_vehicle(self, lane: str, position_m: float, world: int = 0) -> None:
        """Let a car enter a world, as `insert_vehicle` of `make_vec` does."""
        asked = self.flows.change("insert_vehicle", lane=lane, position_m=position_m, world=world)
        self._client.run(asked)

    def close_road(
        self,
        edge: str,
        lanes: Sequence[int] | None = None,
        world: int = 0,
        shuts_in: bool = False,
    ) -> None:
        """Close lanes of a road, as `close_road` of `make_vec` does."""
        given = {"edge": edge, "lanes": lanes, "world": world, "shuts_in": shuts_in}
        self._client.run(self.flows.change("close_road", **given))

    def open_road(self, edge: str, lanes: Sequence[int] | None = None, world: int = 0) -> None:
        """Open lanes of a road, as `open_road` of `make_vec` does."""
        self._client.run(self.flows.change("open_road", edge=edge, lanes=lanes, world=world))

    def damage_road(
        self, edge: str, speed_mps: float, lanes: Sequence[int] | None = None, world: int = 0
    ) -> None:
        """Lower the speed limit of lanes of a road, as `damage_road` of `make_vec` does."""
        given = {"edge": edge, "speed_mps": speed_mps, "lanes": lanes, "world": world}
        self._client.run(self.flows.change("damage_road", **given))

    def declare_event(self, world: int, agent: int | str, cause: str) -> None:
        """Let the vehicle of an agent, given by index or id, announce an event."""
        self._client.run(self.flows.declare_event(agent, cause, world))

    def scenario(
        self,
        name: str,
        place: str = "",
        seed: int = 0,
        params: Mapping[str, bool | float] | None = None,
    ) -> None:
        """Make the worlds again with a scenario; an empty name: without one. Reset them next.

        The arguments are the keys of `scenario` in an env.yaml. An open page of the worlds closes.
        """
        given = {"name": name, "place": place, "seed": seed, "params": params or {}}
        self._client.run(self.flows.change("scenario", **given))

    def save_state(self) -> bytes:
        """Store the state with the service now, and return it.

        `load_state` of the same environment from `make_vec` takes it.
        """
        return self._client.run(self.flows.save())

    def record(self, include: Sequence[str] = ()) -> None:
        """Record the worlds on the node from the next command on; see `RecordOptions.include`."""
        self._client.run(self.flows.change("record", include=include))

    def recording(self, folder: str | Path) -> list[Path]:
        """Write what has been recorded so far to a new folder, and return its recordings.

        A recording ends and the next one begins whenever the state is saved, so there are several.
        Call this before `close`.
        """
        return unpack_recordings(self._client.run(self.flows.recording()), folder)

    def close(self) -> None:
        """End the session."""
        self._client.run(self.flows.close())

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

    async def submit(
        self,
        environment: str | Path,
        *,
        policies: Sequence[str] = ("idm",),
        episodes: int = 32,
        repeats: int = 1,
        node: str | None = None,
        wait_s: float | None = None,
        **keys: Any,
    ) -> str:
        """Like `Client.submit`."""
        job = _job(policies, episodes, repeats, node, wait_s)
        return await self.run(self.flows.submit(environment, keys, job))

    async def wait(
        self,
        job: str,
        folder: str | Path | None = None,
        timeout_s: float = 3600.0,
        told: Told = lambda _: None,
    ) -> dict[str, Any]:
        """Like `Client.wait`."""
        found = await self.run(self.flows.wait(job, timeout_s, told))
        if folder is not None:
            _write(await self.run(self.flows.results(job)), folder)
        return found

    async def events(self, subject: str) -> list[dict[str, Any]]:
        """Like `Client.events`."""
        return await self.run(self.flows.events(subject))

    async def get(self, path: str, **params: Any) -> Any:
        """Like `Client.get`."""
        return await self.run(self.flows.get(path, **params))

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

    async def reset(self, seed: int | None = None) -> tuple[Any, dict[str, Any]]:
        """Start an episode in every world."""
        return await self._client.run(self.flows.reset(seed))

    async def step(self, actions: Any) -> tuple[Any, ...]:
        """Step all worlds."""
        return await self._client.run(self.flows.step(actions))

    async def suggest_actions(self) -> Any:
        """Return the built-in driver's actions."""
        return (await self._client.run(self.flows.look("suggestion")))["actions"]

    async def state_hash(self, world: int = 0) -> str:
        """Return the state hash of one world."""
        return str((await self._client.run(self.flows.look("hash")))["hashes"][world])

    async def page(self) -> dict[str, str]:
        """Like `RemoteWorld.page`."""
        found: dict[str, str] = await self._client.run(self.flows.look("page"))
        return found

    async def transfers(self) -> list[dict[str, Any]]:
        """Like `RemoteWorld.transfers`."""
        told = await self._client.run(self.flows.look("transfers"))
        found: list[dict[str, Any]] = told["transfers"]
        return found

    async def frames(self, final: bool = False) -> dict[str, SensorFrames]:
        """Like `RemoteWorld.frames`."""
        return await self._client.run(self.flows.frames(final))

    async def insert_vehicle(self, lane: str, position_m: float, world: int = 0) -> None:
        """Like `RemoteWorld.insert_vehicle`."""
        asked = self.flows.change("insert_vehicle", lane=lane, position_m=position_m, world=world)
        await self._client.run(asked)

    async def close_road(
        self,
        edge: str,
        lanes: Sequence[int] | None = None,
        world: int = 0,
        shuts_in: bool = False,
    ) -> None:
        """Like `RemoteWorld.close_road`."""
        given = {"edge": edge, "lanes": lanes, "world": world, "shuts_in": shuts_in}
        await self._client.run(self.flows.change("close_road", **given))

    async def open_road(
        self, edge: str, lanes: Sequence[int] | None = None, world: int = 0
    ) -> None:
        """Like `RemoteWorld.open_road`."""
        await self._client.run(self.flows.change("open_road", edge=edge, lanes=lanes, world=world))

    async def damage_road(
        self, edge: str, speed_mps: float, lanes: Sequence[int] | None = None, world: int = 0
    ) -> None:
        """Like `RemoteWorld.damage_road`."""
        given = {"edge": edge, "speed_mps": speed_mps, "lanes": lanes, "world": world}
        await self._client.run(self.flows.change("damage_road", **given))

    async def declare_event(self, world: int, agent: int | str, cause: str) -> None:
        """Like `RemoteWorld.declare_event`."""
        await self._client.run(self.flows.declare_event(agent, cause, world))

    async def scenario(
        self,
        name: str,
        place: str = "",
        seed: int = 0,
        params: Mapping[str, bool | float] | None = None,
    ) -> None:
        """Like `RemoteWorld.scenario`."""
        given = {"name": name, "place": place, "seed": seed, "params": params or {}}
        await self._client.run(self.flows.change("scenario", **given))

    async def save_state(self) -> bytes:
        """Like `RemoteWorld.save_state`."""
        return await self._client.run(self.flows.save())

    async def record(self, include: Sequence[str] = ()) -> None:
        """Like `RemoteWorld.record`."""
        await self._client.run(self.flows.change("record", include=include))

    async def recording(self, folder: str | Path) -> list[Path]:
        """Like `RemoteWorld.recording`."""
        return unpack_recordings(await self._client.run(self.flows.recording()), folder)

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
    return ServiceError(f"{url}: cannot be reached ({error}); check that the service runs there")
