"""Conversations with the service and with nodes, without input or output.

A flow yields what is to be asked and is sent the answer, so that the client that waits and the one
that awaits have the same code.
"""

from __future__ import annotations

import secrets
import time
from collections.abc import Callable, Generator, Mapping
from typing import Any, NamedTuple, TypeVar

import httpx

from cavmarl.core.errors import ServiceError

T = TypeVar("T")
RENEW_BEFORE_S = 60.0  # a token ends
AGAIN_S = 0.2  # between two attempts
PAGE = 1000  # events in one answer
RETRIED_S = 10.0  # for so long is asked again for an answer that was lost


class Ask(NamedTuple):
    """A request; the flow is sent its answer, or thrown `httpx.TransportError`."""

    method: str
    url: str
    json: Any = None
    content: bytes | None = None
    params: Mapping[str, Any] | None = None
    token: str = ""
    key: str = ""  # by which the service knows the same request again


class Rest(NamedTuple):
    """Wait."""

    time_s: float


Flow = Generator[Ask | Rest, Any, T]
Told = Callable[[dict[str, Any]], None]
"""Told what the service says of a job."""


class ServiceFlows:
    """What a service is asked, with a token that is renewed in time."""

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
        """The answer to a request; raises ServiceError where it was refused."""
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
        """A token that is good for a while."""
        if time.monotonic() > self._until_s:
            yield from self._renew()
        return self._token

    def get(self, path: str, **params: Any) -> Flow[Any]:
        """A document of the service."""
        return (yield from self.ask("GET", path, params=params)).json()

    def post(self, path: str, json: Any = None) -> Flow[Any]:
        """What the service answers to a document."""
        return (yield from self.ask("POST", path, json=json)).json()

    def post_once(self, path: str, json: Any, within_s: float) -> Flow[Any]:
        """As `post`; asked again where the answer is lost, and carried out once."""
        key, until_s = secrets.token_hex(16), time.monotonic() + within_s
        while True:
            try:
                return (yield from self.ask("POST", path, json=json, key=key)).json()
            except httpx.TransportError:
                if time.monotonic() > until_s:
                    raise
                yield Rest(AGAIN_S)

    def delete(self, path: str) -> Flow[None]:
        """Take something away."""
        yield from self.ask("DELETE", path)

    def add_configuration(self, environment: str, keys: Mapping[str, Any]) -> Flow[str]:
        """The hash of a configuration."""
        body = {"environment": environment, **keys}
        found = yield from self.post("/configurations", body)
        return str(found["hash"])

    def submit(
        self,
        environment: str,
        keys: Mapping[str, Any],
        job: Mapping[str, Any],
    ) -> Flow[str]:
        """The id of a new job."""
        found = yield from self.add_configuration(environment, keys)
        return str(
            (yield from self.post_once("/jobs", {"configuration": found, **job}, RETRIED_S))["id"]
        )

    def wait(
        self, job: str, timeout_s: float, told: Told = lambda _: None, poll_s: float = 0.25
    ) -> Flow[dict[str, Any]]:
        """A job that is over; raises ServiceError if it has failed, or takes longer."""
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
        """The files that a job has made, by name."""
        found = yield from self.get(f"/sessions/{job}")
        files = {}
        for name in found["results"]:
            answer = yield from self.ask("GET", f"/jobs/{job}/results/{name}")
            files[name] = answer.content
        return files

    def events(self, subject: str) -> Flow[list[dict[str, Any]]]:
        """What the log has of a session, a job or a node."""
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


def check(answer: httpx.Response) -> None:
    """Raise what an answer refuses."""
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
