"""The client's protocol with the service, independent of the HTTP library.

A flow is a generator. It yields requests and receives their answers, so the synchronous and the
asynchronous client share it.
"""

from __future__ import annotations

import re
import secrets
import time
from collections.abc import Callable, Generator, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import httpx

from cavmarl.client.uploads import Upload, driver_files, environment_files
from cavmarl.core.errors import ServiceError

T = TypeVar("T")
RENEW_BEFORE_S = 60.0  # a token is renewed this long before it expires
AGAIN_S = 0.2  # time between two attempts
POLL_S = 0.25  # time between two requests about a job
PAGE = 1000  # maximum number of events in one answer
TAKEOVER_S = 10.0  # how long the services are asked in turn until one answers
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
"""Called with the service's description of a job."""


class ServiceFlows:
    """Requests to a service, with a token that is renewed in time.

    Args:
        url: URL of the service; URLs of its standbys may follow, comma-separated. If a service does
            not answer, the next one is asked.
        secret: secret of an identity.
    """

    def __init__(self, url: str, secret: str) -> None:
        self._urls = [one.strip().rstrip("/") for one in url.split(",")]
        self._secret = secret
        self._token = ""
        self._until_s = 0.0

    @property
    def url(self) -> str:
        """The URL of the service that is asked first."""
        return self._urls[0]

    def _sent(self, ask: Ask, is_safe: bool) -> Flow[httpx.Response]:
        """Return the answer of the service, or of the standby that takes over.

        Args:
            ask: a request with a path as URL.
            is_safe: whether a request whose answer was lost may be repeated.
        """
        until_s = time.monotonic() + TAKEOVER_S
        while True:
            try:
                answer: httpx.Response = yield ask._replace(url=f"{self.url}{ask.url}")
            except httpx.TransportError as error:
                self._urls.append(self._urls.pop(0))
                is_unsent = isinstance(error, httpx.ConnectError | httpx.ConnectTimeout)
                is_late = time.monotonic() > until_s
                if len(self._urls) == 1 or is_late or not (is_unsent or is_safe):
                    raise
                yield Rest(AGAIN_S)
            else:
                return answer

    def ask(
        self,
        method: str,
        path: str,
        *,
        json: Any = None,
        content: bytes | None = None,
        params: Mapping[str, Any] | None = None,
        key: str = "",
        is_repeatable: bool = False,
    ) -> Flow[httpx.Response]:
        """Return the answer to a request; raise ServiceError if it is refused.

        `is_repeatable`: whether a `POST` has the same effect if a standby receives it again.
        """
        is_safe = method != "POST" or bool(key) or is_repeatable
        for is_second in (False, True):
            if is_second or time.monotonic() > self._until_s:
                yield from self._renew()
            sent = Ask(method, f"/v1{path}", json, content, params, self._token, key)
            answer = yield from self._sent(sent, is_safe)
            if answer.status_code != 401:
                break
        check(answer)
        return answer

    def token(self) -> Flow[str]:
        """Return a valid token."""
        if time.monotonic() > self._until_s:
            yield from self._renew()
        return self._token

    def get(self, /, path: str, **params: Any) -> Flow[Any]:
        """Return a document of the service: `/nodes`, `/sessions` or `/events`."""
        return (yield from self.ask("GET", path, params=params)).json()

    def post(self, path: str, json: Any = None) -> Flow[Any]:
        """Send a document to the service and return the answer."""
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
        """Delete a resource of the service."""
        yield from self.ask("DELETE", path)

    def upload(self, files: Iterable[Upload], licence: str = "") -> Flow[None]:
        """Upload the files that this identity has not stored with the service yet."""
        wanted = {one.sha256: one for one in files}
        for one in (yield from self.get("/artefacts", own=1))["artefacts"]:
            wanted.pop(one["sha256"], None)
        for sha256, file in wanted.items():
            params = {"name": file.name, "licence": licence}
            yield from self.ask("PUT", f"/artefacts/{sha256}", content=file.content, params=params)

    def add_configuration(self, environment: str | Path, keys: Mapping[str, Any]) -> Flow[str]:
        """Store a configuration with its files, and return its hash.

        `keys` may have `drivers`, a folder for each name of a trained driver, and `licence`, the
        licence of the files.
        """
        given = dict(keys)
        drivers, licence = given.pop("drivers", None) or {}, given.pop("licence", "")
        name, files = environment_files(environment)
        files |= driver_files(drivers)
        body: dict[str, Any] = {"environment": name, **given}
        if files:
            yield from self.upload(files.values(), licence)
            body["files"] = {place: one.sha256 for place, one in files.items()}
        answer = yield from self.ask("POST", "/configurations", json=body, is_repeatable=True)
        return str(answer.json()["hash"])

    def submit(
        self,
        /,
        environment: str | Path,
        *,
        policies: Sequence[str] = ("idm",),
        episodes: int = 32,
        repeats: int = 1,
        node: str | None = None,
        wait_s: float | None = None,
        **keys: Any,
    ) -> Flow[str]:
        """Submit an evaluation as by `cavmarl.evaluate.evaluate`, and return the id of the job.

        If no node is free, the job waits at most `wait_s` and then fails.
        """
        body = {
            "configuration": (yield from self.add_configuration(environment, keys)),
            "policies": list(policies),
            "episodes": episodes,
            "repeats": repeats,
            "node": node,
            "wait_s": wait_s,
        }
        return plain_name((yield from self.post_once("/jobs", body, RETRIED_S))["id"])

    def train(
        self,
        /,
        environment: str | Path,
        *,
        settings: Mapping[str, bool | int | float | str] | None = None,
        node: str | None = None,
        needs: Sequence[str] = (),
        wait_s: float | None = None,
        **keys: Any,
    ) -> Flow[str]:
        """Submit a training with `train/ppo.py`, and return the id of the job.

        `settings` are settings of the program that are not part of the world. If no node is free,
        the job waits at most `wait_s` and then fails.
        """
        body = {
            "configuration": (yield from self.add_configuration(environment, keys)),
            "settings": dict(settings or {}),
            "node": node,
            "needs": list(needs),
            "wait_s": wait_s,
        }
        return plain_name((yield from self.post_once("/trainings", body, RETRIED_S))["id"])

    def wait(
        self,
        job: str,
        folder: str | Path | None = None,
        timeout_s: float = 3600.0,
        told: Told = lambda _: None,
    ) -> Flow[dict[str, Any]]:
        """Wait for a job, write its files to `folder`, and return the job.

        Meanwhile `told` is called with the state of the job.

        Raises:
            ServiceError: the job has failed or takes too long.
        """
        until_s = time.monotonic() + timeout_s
        while True:
            found: dict[str, Any] = yield from self.get(f"/sessions/{job}")
            told(found)
            if found["state"] == "done":
                break
            if found["state"] in ("failed", "closed"):
                raise ServiceError(f"job {job} is {found['state']}: {found['message']}")
            if time.monotonic() > until_s:
                raise ServiceError(
                    f"job {job} is {found['state']} after {timeout_s:g} s; ask again later"
                )
            yield Rest(POLL_S)
        if folder is not None:
            files = yield from self.results(job)
            Path(folder).mkdir(parents=True, exist_ok=True)
            for name, content in files.items():
                (Path(folder) / name).write_bytes(content)
        return found

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
        sent = Ask("POST", "/v1/token", {"secret": self._secret})
        answer = yield from self._sent(sent, is_safe=True)
        check(answer)
        found = answer.json()
        self._token = found["access_token"]
        self._until_s = time.monotonic() + found["expires_in"] - RENEW_BEFORE_S


def plain_name(name: Any) -> str:
    """Return the name of a result or a job; refuse a name that could lead out of a folder.

    Raises:
        ServiceError: the name does not start with a letter or digit, or has characters other than
            letters, digits, `_`, `.` and `-`.
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
