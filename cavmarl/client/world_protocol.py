"""The client's protocol with a world on a node, including recovery from the loss of the node.

Commands are numbered: resets, steps, and changes between steps. A node answers a repeated command
from memory, and from time to time stores the state of its worlds with the service. The client keeps
the commands since the last stored state. If the node is lost, the service selects another node,
which loads that state, and the client repeats the later commands. Equal commands give equal bytes.
After 60 % of a lease, the client asks for a new one before its next request to the node. A node
refuses the token of a lease that has ended.
"""

from __future__ import annotations

import io
import math
import time
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import httpx
import numpy as np
from numpy.typing import NDArray

from cavmarl.client.recording_parts import unpack_recordings
from cavmarl.client.service_protocol import AGAIN_S, RETRIED_S, Ask, Flow, Rest, ServiceFlows, check
from cavmarl.core.errors import ActionError, ServiceError
from cavmarl.sensors.mounted.frames import SensorFrames

RECOVERY_S = 60.0
RETRY_S = 1.0
_FOUND_ELSEWHERE = ("lost", "bad-token", "superseded", "unreachable")
SAVED_HEADER = "cavmarl-saved"

Arrays = dict[str, NDArray[Any]]


class SentCommand(NamedTuple):
    """A command as sent."""

    word: str  # reset, step or change
    params: dict[str, Any]
    content: bytes | None = None
    json: dict[str, Any] | None = None  # body of a change


class WorldFlows:
    """A session and its commands.

    Attributes:
        description: shapes and names reported by the node.
        assignment: the last answer of the service.
        moves: number of moves of the session to another node.
    """

    def __init__(self, service: ServiceFlows, recovery_s: float = RECOVERY_S) -> None:
        self.description: dict[str, Any] = {}
        self.assignment: dict[str, Any] = {}
        self.moves = 0
        self._service = service
        self._recovery_s = recovery_s
        self._sent: list[SentCommand] = []  # commands after the stored state
        self._saved = 0  # number of commands that the stored state includes
        self._is_pending = False  # True while the answer to the last command is missing
        self._url = ""
        self._renew_s = 0.0

    @property
    def number(self) -> int:
        """The number of commands so far."""
        return self._saved + len(self._sent)

    @property
    def session(self) -> str:
        """The id of the session, with which another client can continue it."""
        return str(self.assignment["session"])

    def open(
        self,
        environment: str | Path,
        keys: Mapping[str, Any],
        wanted: Mapping[str, Any],
    ) -> Flow[None]:
        """Open a session."""
        found = yield from self._service.add_configuration(environment, keys)
        body = {"configuration": found, **wanted}
        answer = yield from self._service.post_once("/sessions", body, self._recovery_s)
        self._take(answer)
        yield from self._recover(is_known=True)

    def take_up(self, session: str) -> Flow[None]:
        """Continue a session of another client on its node."""
        self.assignment = {"session": session, "assigned": ""}
        yield from self._recover(is_known=False, is_foreign=True)

    def reset(self, seed: int | None = None) -> Flow[tuple[Any, Arrays]]:
        """Start an episode in every world."""
        params = {} if seed is None else {"seed": seed}
        arrays = yield from self._command(SentCommand("reset", params))
        return _join(arrays, "observations"), _infos(arrays)

    def step(self, actions: Any) -> Flow[tuple[Any, ...]]:
        """Step all worlds; return observations, rewards, terminations, truncations and infos."""
        form = self.description["action"]
        given = np.asarray(actions)
        if list(given.shape) != form["shape"]:
            raise ActionError(f"actions have shape {given.shape}: must be {tuple(form['shape'])}")
        content = np.ascontiguousarray(given, dtype=form["dtype"]).tobytes()
        arrays = yield from self._command(SentCommand("step", {}, content))
        parts = [arrays[name] for name in ("rewards", "terminations", "truncations")]
        return _join(arrays, "observations"), *parts, _infos(arrays)

    def insert_vehicle(self, lane: str, position_m: float, world: int = 0) -> Flow[None]:
        """Let a car enter a world, as `insert_vehicle` of `make_vec` does."""
        return self._change("insert_vehicle", lane=lane, position_m=position_m, world=world)

    def close_road(
        self,
        edge: str,
        lanes: Sequence[int] | None = None,
        world: int = 0,
        shuts_in: bool = False,
    ) -> Flow[None]:
        """Close lanes of a road, as `close_road` of `make_vec` does."""
        return self._change("close_road", edge=edge, lanes=lanes, world=world, shuts_in=shuts_in)

    def open_road(
        self, edge: str, lanes: Sequence[int] | None = None, world: int = 0
    ) -> Flow[None]:
        """Open lanes of a road, as `open_road` of `make_vec` does."""
        return self._change("open_road", edge=edge, lanes=lanes, world=world)

    def damage_road(
        self, edge: str, speed_mps: float, lanes: Sequence[int] | None = None, world: int = 0
    ) -> Flow[None]:
        """Lower the speed limit of lanes of a road, as `damage_road` of `make_vec` does."""
        given = {"edge": edge, "speed_mps": speed_mps, "lanes": lanes, "world": world}
        return self._change("damage_road", **given)

    def scenario(
        self,
        name: str,
        place: str = "",
        seed: int = 0,
        params: Mapping[str, bool | float] | None = None,
    ) -> Flow[None]:
        """Recreate the worlds with a scenario (empty name: without one), and reset them.

        The arguments are the keys of `scenario` in an env.yaml. An open page of the worlds closes.
        """
        return self._change("scenario", name=name, place=place, seed=seed, params=params or {})

    def record(self, include: Sequence[str] = ()) -> Flow[None]:
        """Record the worlds on the node from the next command on; see `RecordOptions.include`."""
        return self._change("record", include=include)

    def _change(self, kind: str, **given: Any) -> Flow[None]:
        """Change the worlds between two steps; see `cavmarl.service.change_bodies`."""
        json = {"kind": kind, **{name: _plain(value) for name, value in given.items()}}
        for name, value in json.items():
            if isinstance(value, float) and not math.isfinite(value):
                raise ActionError(f"{name} = {value}: must be a finite number")
        yield from self._command(SentCommand("change", {}, json=json))

    def declare_event(self, world: int, agent: int | str, cause: str) -> Flow[None]:
        """Let the vehicle of an agent, given by its index or id, announce an event."""
        names = self.description["agents"]
        if isinstance(agent, str):
            if agent not in names:
                raise ActionError(f"no agent {agent!r}: choose one of {', '.join(names)}")
            agent = names.index(agent)
        yield from self._change("declare_event", agent=agent, cause=cause, world=world)

    def save_state(self) -> Flow[bytes]:
        """Store state and recording with the service now, and return the state.

        `make_vec(...).load_state` of the same environment can load it.
        """
        answer = yield from self._asked("POST", SentCommand("save", {}))
        self._trim(answer)
        return answer.content

    def frames(self, final: bool = False) -> Flow[dict[str, SensorFrames]]:
        """Return the samples of the mounted sensors, as `frames` of `make_vec` does.

        With `final`, return the samples at the end of trips and episodes, as `final_frames` does.
        """
        params = {"final": 1} if final else {}
        answer = yield from self._asked("GET", SentCommand("frames", params))
        parts: dict[str, dict[str, Any]] = {}
        for name, array in unpack(answer.content).items():
            sensor, _, field = name.rpartition("/")
            parts.setdefault(sensor, {})[field] = array
        return {name: SensorFrames(**fields) for name, fields in parts.items()}

    def recording(self, folder: str | Path) -> Flow[list[Path]]:
        """Write what has been recorded so far to a new folder, and return its recordings.

        A recording ends and the next one begins whenever the state is saved, so there are several.
        Call this before `close`.
        """
        yield from self.save_state()
        files = yield from self._service.results(self.session)
        parts = {name: content for name, content in files.items() if name.startswith("recording-")}
        return unpack_recordings(parts, folder)

    def suggest_actions(self) -> Flow[Any]:
        """Return the built-in driver's actions."""
        return (yield from self._look("suggestion"))["actions"]

    def state_hash(self, world: int = 0) -> Flow[str]:
        """Return the state hash of one world."""
        return str((yield from self._look("hash"))["hashes"][world])

    def page(self) -> Flow[dict[str, str]]:
        """Open a page of the worlds on the node's machine; return its `address` and tokens.

        `token` allows control, `watch_token` only watching.
        """
        return self._look("page")

    def transfers(self) -> Flow[list[dict[str, Any]]]:
        """Return the most recent ownership transfers of a divided world."""
        found: list[dict[str, Any]] = (yield from self._look("transfers"))["transfers"]
        return found

    def _look(self, word: str) -> Flow[Any]:
        """Send a query that changes nothing."""
        answer = yield from self._asked("GET", SentCommand(word, {}))
        if answer.headers["content-type"] == "application/json":
            return answer.json()
        return unpack(answer.content)

    def close(self) -> Flow[None]:
        """End the session; repeat the request while the service is unreachable."""
        until_s = time.monotonic() + RETRIED_S
        while True:
            try:
                yield from self._service.delete(f"/sessions/{self.session}")
                break
            except httpx.TransportError:
                if time.monotonic() > until_s:
                    raise
                yield Rest(AGAIN_S)
        try:
            yield Ask("DELETE", self._url, token=self.assignment["token"])
        except httpx.TransportError:
            return  # the answer to the node's next heartbeat will end the session there

    def _command(self, sent: SentCommand) -> Flow[Arrays]:
        self._sent.append(sent)
        self._is_pending = True
        try:
            params = {**sent.params, "number": self.number}
            answer = yield from self._asked("POST", sent._replace(params=params))
        except ServiceError as error:
            if error.status in (400, 409, 422):  # refused before any change
                self._sent.pop()
            raise
        finally:
            self._is_pending = False
        self._trim(answer)
        return unpack(answer.content)

    def _asked(self, method: str, sent: SentCommand) -> Flow[httpx.Response]:
        """Return the answer of the node that has the session."""
        until_s = time.monotonic() + self._recovery_s
        while True:
            if time.monotonic() > self._renew_s:
                yield from self._renew()
            url = f"{self._url}/{sent.word}"
            try:
                answer: httpx.Response = yield Ask(
                    method, url, sent.json, sent.content, sent.params, self.assignment["token"]
                )
                check(answer)
            except (httpx.TransportError, ServiceError) as error:
                if isinstance(error, ServiceError) and error.problem == "paused":
                    yield Rest(error.retry_s or AGAIN_S)
                    until_s = time.monotonic() + self._recovery_s
                    continue
                if isinstance(error, ServiceError) and error.problem not in _FOUND_ELSEWHERE:
                    raise
                if time.monotonic() > until_s:
                    raise
                is_gone = isinstance(error, httpx.TransportError)
                yield from self._recover(is_known=False, is_gone=is_gone)
            else:
                return answer

    def _recover(
        self, *, is_known: bool, is_gone: bool = False, is_foreign: bool = False
    ) -> Flow[None]:
        """Open the session on a node and repeat the commands that it has not executed."""
        until_s = time.monotonic() + self._recovery_s
        while True:
            try:
                if not is_known:
                    yield from self._resolve(is_gone)
            except (httpx.TransportError, ServiceError) as error:
                if not _may_pass(error, ("no-node", "too-many"), until_s):
                    raise
                # Without another node, ask for the lost one again: it may have restarted.
                is_gone = is_gone and not isinstance(error, ServiceError)
                yield Rest(0.1)
                continue
            try:
                params, token = {"save": 1} if is_foreign else None, self.assignment["token"]
                answer = yield Ask("POST", self._url, None, None, params, token)
                check(answer)
                self.description = answer.json()
                yield from self._send_again(self.description["number"], is_foreign)
                return
            except (httpx.TransportError, ServiceError) as error:
                if not _may_pass(error, _FOUND_ELSEWHERE, until_s):
                    raise
                is_known, is_gone = False, isinstance(error, httpx.TransportError)
                yield Rest(0.1)

    def _renew(self) -> Flow[None]:
        """Request a new lease; while the service is unreachable, keep the old one and retry."""
        before = self.assignment["assigned"]
        try:
            yield from self._resolve(False)
        except httpx.TransportError:
            self._renew_s = time.monotonic() + RETRY_S
            return
        if self.assignment["assigned"] != before:
            yield from self._recover(is_known=True)

    def _resolve(self, is_gone: bool) -> Flow[None]:
        before = self.assignment["assigned"]
        body = {"unreachable": [before] if is_gone and before else [], "wait_s": 2.0}
        answer = yield from self._service.post(f"/sessions/{self.session}/resolve", body)
        self._take(answer)
        if before and answer["assigned"] != before:
            self.moves += 1

    def _send_again(self, number: int, is_foreign: bool) -> Flow[None]:
        if is_foreign:
            self._saved, self._sent = number, []
            return
        if number < self._saved:
            raise ServiceError(
                f"session {self.session}: node {self.assignment['assigned']} has executed {number} "
                f"commands, but {self._saved} were saved: the store was changed; open another "
                "session"
            )
        # `_asked` waits for the answer to a pending command, and sends that command again itself.
        for place in range(number + 1, self.number + (not self._is_pending)):
            sent = self._sent[place - self._saved - 1]
            params = {**sent.params, "number": place, "quiet": 1}
            url, token = f"{self._url}/{sent.word}", self.assignment["token"]
            answer = yield Ask("POST", url, sent.json, sent.content, params, token)
            check(answer)

    def _take(self, answer: dict[str, Any]) -> None:
        self.assignment = answer
        host = answer["address"]
        shown = f"[{host}]" if ":" in host else host
        place = f"{answer['scheme']}://{shown}:{answer['client_port']}"
        self._url = f"{place}/v1/worlds/{answer['session']}"
        self._renew_s = time.monotonic() + 0.6 * answer["lease_s"]

    def _trim(self, answer: httpx.Response) -> None:
        """Forget commands that a stored state includes."""
        saved = int(answer.headers.get(SAVED_HEADER, self._saved))
        if saved > self._saved:
            self._sent = self._sent[saved - self._saved :]
            self._saved = saved


def _may_pass(error: Exception, names: Sequence[str], until_s: float) -> bool:
    """Return whether repeating the request can help."""
    if isinstance(error, ServiceError) and error.problem not in names:
        return False
    return time.monotonic() < until_s


def _plain(value: Any) -> Any:
    """Return a value in JSON's types: numbers of NumPy as numbers, sequences as lists."""
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, Mapping):
        return {key: _plain(one) for key, one in value.items()}
    if isinstance(value, Iterable) and not isinstance(value, str):
        return [_plain(one) for one in value]
    return value


def pack(arrays: Mapping[str, NDArray[Any]]) -> bytes:
    """Return arrays as the bytes of an uncompressed .npz file."""
    content = io.BytesIO()
    np.savez(content, allow_pickle=False, **arrays)
    return content.getvalue()


def unpack(content: bytes) -> Arrays:
    """Return the arrays that `pack` wrote."""
    with np.load(io.BytesIO(content), allow_pickle=False) as found:
        return dict(found)


def flatten(name: str, value: Any) -> Arrays:
    """Return an array, or the arrays of a dict, by name."""
    if isinstance(value, Mapping):
        return {f"{name}/{key}": one for key, one in value.items()}
    return {name: value}


def _join(arrays: Arrays, name: str) -> Any:
    """The inverse of `flatten`."""
    if name in arrays:
        return arrays[name]
    start = f"{name}/"
    return {key[len(start) :]: one for key, one in arrays.items() if key.startswith(start)}


def _infos(arrays: Arrays) -> Arrays:
    names: Sequence[str] = [key for key in arrays if key.startswith("infos/")]
    return {name[len("infos/") :]: arrays[name] for name in names}
