"""A node's requests to the service: registration, heartbeats, configurations and states."""

from __future__ import annotations

import asyncio
import hashlib
import os
import secrets
import socket
import time
from collections.abc import Awaitable, Callable, Mapping
from importlib.metadata import version
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, TypeVar

import jwt
import psutil

from cavmarl.balance.probe import busiest_gpu
from cavmarl.client.clients import AsyncClient
from cavmarl.core.errors import ServiceError
from cavmarl.service.access import ALGORITHM, ISSUER
from cavmarl.service.error_names import problem, without_folders
from cavmarl.service.request_bodies import ConfigurationBody
from cavmarl.service.service_records import STATE_HEADER

T = TypeVar("T")
NEW_S = 5.0  # time for which a new session is kept without being announced by the service
GPU_EVERY = 5  # heartbeats between two measurements of the GPUs
JOIN_S = 60.0  # time in which the nodes of a session's zones must connect
ANSWER_S = 0.5  # time between two attempts to reach the service
KEYS_S = 1.0  # shortest time between two requests for the service's keys
KEYS_KEPT_S = 60.0  # age at which known keys are requested again; the service may have new ones
MOST_MESSAGE = 2000  # characters of the reason why a session or a job has failed
MOST_ROWS = 1000  # transfers in one body, which is limited to 256 KiB


class NodeLink:
    """A node's side of its connection to the service.

    Args:
        url: URL of the service.
        secret: secret of an identity with the role `node`.
        body: body of the registration; docs/guides/service.md lists its fields.
        is_supposed_idle: report no load, so that nodes are selected by their sessions alone.
        options: further arguments of `AsyncClient`.

    Attributes:
        beats: number of heartbeats sent so far; the next one has this number.
    """

    def __init__(
        self,
        url: str,
        secret: str,
        body: dict[str, Any],
        is_supposed_idle: bool = False,
        **options: Any,
    ) -> None:
        self._client = AsyncClient(url, secret, **options)
        self._body = {**body, "versions": {"cavmarl": version("cavmarl")}}
        self.name: str = body["name"]
        self.incarnation = 0
        self.is_draining = False
        self.beats = 0
        self._keys: dict[str, Any] = {}
        self._keys_s = -KEYS_S  # time of the last request for keys
        self._asking_for_keys = asyncio.Lock()
        self._expected: dict[str, float] = {}
        self._doors: dict[str, dict[str, Any]] = {}
        self._key_files: dict[str, int] = {}
        self._gpu = 0.0
        self._is_supposed_idle = is_supposed_idle

    async def register(self) -> None:
        """Register this process as the node."""
        found = await self.ask("POST", "/nodes", json=self._body)
        self.incarnation = found.json()["incarnation"]
        self.is_draining = found.json()["draining"]
        psutil.cpu_percent(None)  # the next call returns the processor use since this call

    async def beat(
        self,
        counters: dict[str, float],
        jobs: Mapping[str, tuple[int, int]],
        is_watched: bool,
    ) -> dict[str, Any]:
        """Report the load of this machine and the progress of its jobs; return the node's duties.

        With `is_watched`, the answer includes the LoadScores of all nodes.
        """
        number = self.beats
        self.beats += 1
        load = {"cpu": 0.0, "ram": 0.0, "gpu": 0.0}
        if not self._is_supposed_idle:
            if number % GPU_EVERY == 0:
                self._gpu = (await asyncio.to_thread(busiest_gpu))[0]
            load["cpu"] = min(psutil.cpu_percent(None) / 100.0, 1.0)
            load["ram"] = psutil.virtual_memory().percent / 100.0
            load["gpu"] = self._gpu
        body = {
            **load,
            "incarnation": self.incarnation,
            "sequence": number,
            "sent_s": time.time(),
            "counters": counters,
            "jobs": dict(jobs),
            "watched": is_watched,
        }
        answer = await self.ask("POST", f"/nodes/{self.name}/beat", json=body)
        told: dict[str, Any] = answer.json()
        self.is_draining = told["draining"]
        for session in told["without_door"]:  # the service has restarted
            if session in self._doors:
                await self._tell_door(session)
        return told

    def expect(self, session: str) -> None:
        """Note a session whose client arrived before a heartbeat announced it."""
        self._expected[session] = time.monotonic() + NEW_S

    def own(self, told: list[str]) -> set[str]:
        """Return the ids of this node's sessions: announced ones and newly arrived ones."""
        now_s = time.monotonic()
        self._expected = {one: until for one, until in self._expected.items() if until > now_s}
        return {*told, *self._expected}

    async def public_key(self, number: str, pause_s: float = KEYS_S) -> Any:
        """Return a key that verifies tokens; raise KeyError if the service has listed no such key.

        Args:
            number: id of the key.
            pause_s: shortest time between two requests to the service for unknown keys, so that
                tokens with invented keys cost little.
        """
        async with self._asking_for_keys:
            until_s = self._keys_s + (KEYS_KEPT_S if number in self._keys else pause_s)
            if time.monotonic() >= until_s:
                self._keys_s = time.monotonic()
                try:
                    keys = (await self.ask("GET", "/keys")).json()["keys"]
                except ServiceError:  # sessions continue until their leases end
                    if number not in self._keys:
                        raise
                else:
                    self._keys = {one["kid"]: jwt.PyJWK(one).key for one in keys}
        return self._keys[number]

    async def claims(
        self, token: str, use: str, session: str, pause_s: float = KEYS_S
    ) -> dict[str, Any]:
        """Return the claims that the service has signed for this node, a session and a purpose.

        Raises:
            KeyError or jwt.InvalidTokenError: the token was not signed by the service for them.
        """
        number = str(jwt.get_unverified_header(token).get("kid"))
        key = await self.public_key(number, pause_s)
        claims: dict[str, Any] = jwt.decode(
            token, key, [ALGORITHM], audience=f"node:{self.name}", issuer=ISSUER,
            options={"require": ["exp", "iat", "sub"], "verify_iat": False},
        )  # fmt: skip
        if claims.get("use") != use or claims["sub"] != session:
            raise jwt.InvalidTokenError("the token has another purpose")
        return claims

    async def configuration(self, sha256: str) -> dict[str, Any]:
        """Return the document of a configuration."""
        found: dict[str, Any] = (await self.ask("GET", f"/configurations/{sha256}")).json()
        return found

    async def fetch_files(self, document: dict[str, Any]) -> TemporaryDirectory[str] | None:
        """Return a new folder with the files of a configuration; None: there are no files.

        Raises:
            ServiceError: a file is missing or does not have its hash.
        """
        files = ConfigurationBody(**document).files
        if not files:
            return None
        folder = TemporaryDirectory(prefix="cavmarl-files-")
        try:
            for place, sha256 in files.items():
                content: bytes = (await self.ask("GET", f"/artefacts/{sha256}")).content
                if hashlib.sha256(content).hexdigest() != sha256:
                    raise problem("damaged", f"file {place} does not have the SHA-256 {sha256}")
                path = Path(folder.name) / place
                path.parent.mkdir(parents=True, exist_ok=True)
                path.write_bytes(content)
        except BaseException:
            folder.cleanup()
            raise
        return folder

    async def saved_state(self, session: str) -> tuple[bytes | None, int]:
        """Return the newest state of a session, and the number of commands that it includes.

        Raises:
            ServiceError: the service did not sign this state for this session and node.
        """
        answer = await self.ask("GET", f"/sessions/{session}/state")
        if answer.status_code == 204:
            return None, 0
        state: bytes = answer.content
        try:
            signature = answer.headers.get(STATE_HEADER, "")
            claims = await self.claims(signature, "state", session, pause_s=0.0)
        except (jwt.InvalidTokenError, KeyError):
            claims = {}
        signed = claims.get("sha256"), str(claims.get("number"))
        if signed != (hashlib.sha256(state).hexdigest(), answer.headers.get("cavmarl-number")):
            raise problem(
                "damaged", f"the state of session '{session}' was not signed by the service for it"
            )
        return state, int(claims["number"])

    async def fail(self, session: str, message: str) -> None:
        """Report that a session cannot continue on any node."""
        body = {"status": "failed", "message": without_folders(message)[:MOST_MESSAGE]}
        await self.ask("POST", f"/jobs/{session}/outcome", json=body)

    async def save_state(self, session: str, number: int, state: bytes) -> None:
        """Store a state with the service."""
        path = f"/sessions/{session}/state"
        await self.ask("PUT", path, content=state, params={"at": number})

    async def open_door(self, session: str, document: dict[str, Any]) -> dict[str, Any]:
        """Let other nodes host zones of a session; return keywords to await them in `make_vec`."""
        if not document.get("nodes"):
            return {}
        host: str = self._body["address"]
        with socket.socket(socket.AF_INET6 if ":" in host else socket.AF_INET) as free:
            free.bind((host, 0))
            port = free.getsockname()[1]
        key = secrets.token_hex(16)
        self._doors[session] = {"host": host, "port": port, "key": key.encode().hex()}
        await self._tell_door(session)
        keys = {"workers.key_file": self._in_memory(session, key), "workers.join_timeout_s": JOIN_S}
        shown = f"[{host}]" if ":" in host else host
        return {
            "backend": f"nodes:{document['nodes']}@{shown}:{port}",
            "overrides": keys,
        }

    def close_key_file(self, session: str) -> None:
        """Delete the key file of a session after its worlds have read it."""
        if session in self._key_files:
            os.close(self._key_files.pop(session))

    def _in_memory(self, session: str, key: str) -> str:
        """Return the path of a key file that is deleted when this process ends."""
        self.close_key_file(session)
        file = self._key_files[session] = os.memfd_create("cavmarl-key", os.MFD_CLOEXEC)
        os.fchmod(file, 0o600)
        os.write(file, key.encode())
        return f"/proc/{os.getpid()}/fd/{file}"

    async def _tell_door(self, session: str) -> None:
        await self.ask("PUT", f"/sessions/{session}/door", json=self._doors[session])

    async def tell_transfers(self, session: str, number: int, rows: dict[str, list[Any]]) -> None:
        """Report vehicles that have changed zone, and vehicles whose change is prepared."""
        told, prepared = rows["transfers"], rows["prepared"][-MOST_ROWS:]
        for first in range(0, max(len(told), 1), MOST_ROWS):
            some = told[first : first + MOST_ROWS]
            body = {"at": number, "transfers": some, "prepared": prepared}
            await self.ask("PUT", f"/sessions/{session}/transfers", json=body)

    async def drain(self) -> None:
        """Ask the service to assign nothing more to this node."""
        await self.ask("POST", f"/nodes/{self.name}/drain")

    async def leave(self) -> None:
        """Announce that this process ends."""
        await self.ask("DELETE", f"/nodes/{self.name}")

    async def ask(self, method: str, path: str, **given: Any) -> Any:
        """Send a request and return the answer; raise ServiceError if it is refused."""
        return await self._client.run(self._client.flows.ask(method, path, **given))

    async def close(self) -> None:
        """Close the connections."""
        await self._client.close()
        for session in tuple(self._key_files):
            self.close_key_file(session)


async def until_answered(ask: Callable[[], Awaitable[T]]) -> T:
    """Repeat a request while the service cannot answer it, and return its answer.

    The request must have the same effect if the service receives it again.

    Raises:
        ServiceError: the service refuses the request.
    """
    while True:
        try:
            return await ask()
        except ServiceError as error:
            if 0 < error.status < 500 and error.retry_s is None:
                raise
            await asyncio.sleep(error.retry_s or ANSWER_S)


def must_register(error: ServiceError) -> bool:
    """Return whether the node must register again, because its heartbeats are refused.

    A heartbeat with a refused number means that another process has sent heartbeats as this node.
    The new registration has another incarnation, so that process is refused from then on.
    """
    return error.problem in ("conflict", "not-found", "stale-beat")


def is_final(error: ServiceError) -> bool:
    """Return whether repeating the request cannot help."""
    return error.problem in ("superseded", "forbidden", "bad-token")
