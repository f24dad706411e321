"""The client's protocol with the service, independent of the HTTP library.

A flow is a generator. It yields requests and receives their answers, so the synchronous and the
asynchronous client share it.
"""

from __future__ import annotations

import re
import secrets
import time
from collections.abc import Callable, Generator, Mapping
from typing import Any, NamedTuple, TypeVar

import httpx

from cavmarl.core.errors import ServiceError

T = TypeVar("T")
RENEW_BEFORE_S = 60.0  # time before its expiry at which a token is renewed
AGAIN_S = 0.2  # time between two attempts
PAGE = 1000  # maximum number of events in one answer
RETRIED_S = 10.0  # how long a request is repeated after a lost answer
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,63}")


class Ask(NamedTuple):
    """A request. The flow receives its answer, or `httpx.TransportError` is raised in it."""

    method: str
    url: str
    json: Any = None
    content: bytes | None = None
    params: Mapping[str, Any] | None = None
    token: str = ""
    key: str = ""  # key that identifies a repeated request


class Rest(NamedTuple):
    """A pause."""

    time_s: float


Flow = Generator[Ask | Rest, Any, T]
Told = Callable[[dict[str, Any]], None]
"""Told what the service says of a job."""


class ServiceFlows:
    """Requests to a service, with a token that is renewed in time."""

    def __init__(self, url: str, secret: str) -> None:
        self.url = url.rstrip("/")
        self._secret = secret
        self._token = ""
        self._until_s = 0.0

    def ask(
        self,
        method: str,
        path: str,
        *,
        json: Any = None,
        content: bytes | None = None,
        params: Mapping[str, Any] | None = None,
        key: str = "",
    ) -> Flow[httpx.Response]:
        """Return the answer to a request; raise ServiceError if it is refused."""
        for is_second in (False, True):
            if is_second or time.monotonic() > self._until_s:
                yield from self._renew()
            url = f"{self.url}/v1{path}"
            answer: httpx.Response = yield Ask(method, url, json, content, params, self._token, key)
            if answer.status_code != 401:
                break
        check(answer)
        return answer

    def token(self) -> Flow[str]:
        """Return a valid token."""
        if time.monotonic() > self._until_s:
            yield from self._renew()
        return self._token

    def get(self, path: str, **params: Any) -> Flow[Any]:
        """Return a document of the service."""
        return (yield from self.ask("GET", path, params=params)).json()

    def post(self, path: str, json: Any = None) -> Flow[Any]:
        """Send a document and return the answer."""
        return (yield from self.ask("POST", path, json=json)).json()

    def post_once(self, path: str, json: Any, within_s: float) -> Flow[Any]:
        """Like `post`, repeated if the answer is lost; the service executes it once."""
        key, until_s = secrets.token_hex(16), time.monotonic() + within_s
        while True:
            try:
                return (yield from self.ask("POST", path, json=json, key=key)).json()
            except httpx.TransportError:
                if time.monotonic() > until_s:
                    raise
                yield Rest(AGAIN_S)

    def delete(self, path: str) -> Flow[None]:
        """Delete a resource."""
        yield from self.ask("DELETE", path)

    def add_configuration(self, environment: str, keys: Mapping[str, Any]) -> Flow[str]:
        """Store a configuration and return its hash."""
        body = {"environment": environment, **keys}
        found = yield from self.post("/configurations", body)
        return str(found["hash"])

    def submit(
        self,
        environment: str,
        keys: Mapping[str, Any],
        job: Mapping[str, Any],
    ) -> Flow[str]:
        """Submit a job and return its id."""
        found = yield from self.add_configuration(environment, keys)
        body = {"configuration": found, **job}
        return plain_name((yield from self.post_once("/jobs", body, RETRIED_S))["id"])

    def wait(
        self, job: str, timeout_s: float, told: Told = lambda _: None, poll_s: float = 0.25
    ) -> Flow[dict[str, Any]]:
        """Return a job when it is done; raise ServiceError if it fails or takes too long."""
        until_s = time.monotonic() + timeout_s
        while True:
            found: dict[str, Any] = yield from self.get(f"/sessions/{job}")
            told(found)
            if found["state"] == "done":
                return found
            if found["state"] in ("failed", "closed"):
                raise ServiceError(f"job {job} is {found['state']}: {found['message']}")
            if time.monotonic() > until_s:
                raise ServiceError(
                    f"job {job} is {found['state']} after {timeout_s:g} s; ask again later"
                )
            yield Rest(poll_s)

    def results(self, job: str) -> Flow[dict[str, bytes]]:
        """Return the files of a job by name."""
        found = yield from self.get(f"/sessions/{job}")
        files = {}
        for name in map(plain_name, found["results"]):
            answer = yield from self.ask("GET", f"/jobs/{job}/results/{name}")
            files[name] = answer.content
        return files

    def events(self, subject: str) -> Flow[list[dict[str, Any]]]:
        """Return the events of a session, a job or a node."""
        found: list[dict[str, Any]] = []
        after = 0
        while True:
            page = yield from self.get("/events", after=after, limit=PAGE, subject=subject)
            if not page["events"]:
                return found
            found += page["events"]
            after = found[-1]["sequence"]

    def _renew(self) -> Flow[None]:
        answer = yield Ask("POST", f"{self.url}/v1/token", {"secret": self._secret})
        check(answer)
        found = answer.json()
        self._token = found["access_token"]
        self._until_s = time.monotonic() + found["expires_in"] - RENEW_BEFORE_S


def plain_name(name: Any) -> str:
    """Return the name of a result or a job; refuse a name that could lead out of a folder.

    Raises:
        ServiceError: it does not consist of letters, digits, `_`, `.` and `-`, after a letter or
            digit.
    """
    if not isinstance(name, str) or not _NAME.fullmatch(name):
        raise ServiceError(f"{name!r}: is not a name; the server is not a cavmarl service")
    return name


def check(answer: httpx.Response) -> None:
    """Raise ServiceError if an answer is a refusal."""
    if answer.is_success:
        return
    retry_s = answer.headers.get("retry-after")
    try:
        found = answer.json()
        message, name = f"{found['detail']}", str(found["title"])
    except (ValueError, KeyError, TypeError):
        message, name = f"HTTP {answer.status_code} from {answer.request.url.host}", ""
    error = ServiceError(message, answer.status_code, name)
    error.retry_s = float(retry_s) if retry_s and retry_s.isdigit() else None
    raise error
