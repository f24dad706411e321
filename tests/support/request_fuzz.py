"""Almost valid requests to a service and a node, as bytes for a socket."""

from __future__ import annotations

import json
import socket
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field, replace
from random import Random
from typing import Any, NamedTuple
from urllib.parse import quote, urlsplit

JSON = "application/json"
TIMEOUT_S = 20.0  # longer than any of these requests should take

# Method, path, role and body. `{NAME}` in a path or body stands for a value of `known`.
TEMPLATES: list[tuple[str, str, str, Any]] = [
    ("GET", "/v1/health", "", None),
    ("GET", "/v1/keys", "", None),
    ("GET", "/v1/openapi.json", "", None),
    ("POST", "/v1/token", "", {"secret": "{secret}"}),
    ("POST", "/v1/token", "", {"refresh_token": "{refresh}"}),
    ("DELETE", "/v1/token", "viewer", None),
    ("POST", "/v1/nodes/{node}/beat", "node",
     {"incarnation": 1, "sequence": 7, "cpu": 0.5, "ram": 0.5, "gpu": 0.0, "sent_s": 0.0,
      "counters": {"ticks": 1.0}, "watched": True, "jobs": {"s-1": [1, 2]}}),
    ("GET", "/v1/nodes", "viewer", None),
    ("POST", "/v1/nodes", "node",
     {"name": "b", "address": "127.0.0.1", "client_port": 1, "simulator_port": 1, "slots": 2,
      "capabilities": ["gpu"], "versions": {"cavmarl": "1"}, "allowed": ["client"]}),
    ("POST", "/v1/nodes/{node}/drain", "operator", None),
    ("POST", "/v1/nodes/{node}/resume", "operator", None),
    ("DELETE", "/v1/nodes/b", "node", None),
    ("POST", "/v1/configurations", "client",
     {"name": "n", "environment": "merge", "agents": 2, "background": 1, "max_cycles": 9,
      "zones": 1, "nodes": 1, "num_envs": 1, "seed": 3,
      "overrides": {"sensors.lidar.rays": 4, "clock": {"sim_dt_s": 0.1}}}),
    ("POST", "/v1/configurations", "client",
     {"environment": "merge",
      "overrides": {"population": {"agents": 1}, "sensors": {"lidar": {"rays": 4}},
                    "terms": {"weights": {"progress": 1.0}}, "scenario.name": "cut_in"}}),
    ("GET", "/v1/configurations/{sha256}", "client", None),
    ("POST", "/v1/sessions", "client",
     {"configuration": "{sha256}", "node": "{node}", "needs": [], "wait_s": 0.0}),
    ("POST", "/v1/sessions/{session}/resolve", "client", {"unreachable": ["b"], "wait_s": 0.0}),
    ("GET", "/v1/sessions", "client", None),
    ("GET", "/v1/sessions/{session}", "client", None),
    ("DELETE", "/v1/sessions/{closable}", "client", None),
    ("GET", "/v1/sessions/{session}/state", "node", None),
    ("PUT", "/v1/sessions/{session}/state?at=3", "node", b"state" * 9),
    ("POST", "/v1/jobs", "client",
     {"configuration": "{sha256}", "policies": ["idm"], "episodes": 1, "repeats": 1,
      "node": None, "needs": ["none"], "wait_s": 0.0}),
    ("POST", "/v1/trainings", "client",
     {"configuration": "{sha256}", "node": None, "needs": ["none"], "wait_s": 0.0,
      "settings": {"hidden": 8, "gamma": 0.9, "anneal": True, "opponents": "idm"}}),
    ("POST", "/v1/jobs/{closable}/outcome", "node", {"status": "done", "message": "x"}),
    ("PUT", "/v1/jobs/{session}/results/a.csv", "node", b"1,2\n"),
    ("GET", "/v1/jobs/{session}/results/a.csv", "client", None),
    ("GET", "/v1/sessions/{session}/transfers", "client", None),
    ("PUT", "/v1/sessions/{session}/transfers", "node",
     {"at": 3, "transfers": [[0, 0, 1, 5, 0, 1, 1]], "prepared": [[0, 5, 0, 1]]}),
    ("PUT", "/v1/sessions/{session}/door", "node",
     {"host": "127.0.0.1", "port": 1, "key": "{sha256}"}),
    ("GET", "/v1/events?after=0&limit=5&subject={node}", "client", None),
    ("GET", "/v1/events/stream?after=0", "viewer", None),
    ("GET", "/v1/metrics", "viewer", None),
    ("POST", "/v1/identities", "admin", {"name": "guest", "role": "viewer"}),
    ("GET", "/v1/identities", "admin", None),
    ("DELETE", "/v1/identities/{identity}", "admin", None),
    ("POST", "/v1/keys", "admin", None),
]  # fmt: skip
NODE_TEMPLATES: list[tuple[str, str, str, Any]] = [
    ("POST", "/v1/worlds/{session}?save=1", "lease", None),
    ("POST", "/v1/worlds/{session}/reset?number=1&seed=0", "lease", None),
    ("POST", "/v1/worlds/{session}/step?number={next}", "lease", b"\0" * 8),
    ("POST", "/v1/worlds/{session}/step?number={next}&quiet=1", "lease", b"\xff" * 8),
    ("GET", "/v1/worlds/{session}/hash", "lease", None),
    ("GET", "/v1/worlds/{session}/suggestion", "lease", None),
    ("GET", "/v1/worlds/{session}/transfers", "lease", None),
    ("GET", "/v1/openapi.json", "", None),
]
SEGMENTS = ["..", ".", "", "%00", "%2e%2e", "%2f", "%", "%zz", "%ff%fe", "%F0%9F%9A%97", "a" * 300,
            "s-" + "0" * 24, "-1", "null", "{}", "*", "a;b", "a%0d%0aX: y", "\\"]  # fmt: skip
VALUES: list[Any] = [
    None, True, False, -1, 0, 1, 2**53, 2**63, 2**64, -(2**70), 10**400, 10**4000, 1e308, -1e308,
    0.5, "", "x", "\0", "\ud800", "../x", "/etc/passwd", "é" * 70, "x" * 3000, "1", "merge", "idm",
    [], {}, [[]], {"": ""}, {"a": {"a": {"a": [1]}}}, float("nan"), float("inf"),
]  # fmt: skip
HEADERS = [
    b"Authorization: Bearer", b"Authorization: Basic eDp5", b"Authorization: Bearer \xff\xfe",
    b"Authorization: Bearer e30.e30.e30", b"Content-Type: text/plain", b"Content-Type: x",
    b"Content-Type: application/json; charset=utf-16", b"Content-Type: multipart/form-data",
    b"Content-Encoding: gzip", b"Content-Length: 5", b"Content-Length: -1", b"Content-Length: x",
    b"Content-Length: 99999999999999999999", b"Transfer-Encoding: chunked",
    b"Transfer-Encoding: gzip, chunked", b"Expect: 100-continue", b"Upgrade: websocket",
    b"Upgrade: h2c", b"Connection: Upgrade", b"Connection: keep-alive", b"Host: ", b"Host: a b",
    b"X: " + b"y" * 9000, b"X\x00: y", b"X : y", b": y", b"no colon", b" folded",
    b"Idempotency-Key: k", b"Idempotency-Key: \xc3\xa9", b"Idempotency-Key: " + b"k" * 99,
    b"Last-Event-ID: 3", b"Last-Event-ID: \xb2", b"Last-Event-ID: -1", b"Range: bytes=0-1",
    b"X-Forwarded-For: 1.2.3.4", b"X-HTTP-Method-Override: DELETE", b"Cookie: a=b",
]  # fmt: skip
METHODS = ["GET", "POST", "PUT", "DELETE", "PATCH", "HEAD", "OPTIONS", "TRACE", "CONNECT", "get",
           "X" * 40, "G\0T"]  # fmt: skip
QUERIES = ["after=-1", "after=9007199254740993", "after=1e3", "limit=0", "limit=1001", "limit=%00",
           "subject=%00", "subject=%ff", "subject=" + "x" * 200, "at=-1", "at=x", "at=%F0%9F%9A%97",
           "afer=1", "=", "&&&", "a=1&a=2", "number=0", "number=99999999999999999999", "seed=-1",
           "quiet=2", "save=x", "%", "[]=1", "x" * 1100]  # fmt: skip


class Answer(NamedTuple):
    """An HTTP answer; `status` is 0 if the server closed the connection without an answer."""

    status: int
    head: bytes
    body: bytes


@dataclass
class RawRequest:
    """A request as bytes on a socket.

    Attributes:
        is_cut: whether the request may be incomplete. The client then closes its sending
            side, so that the server does not wait for more bytes.
    """

    method: str
    target: str
    headers: list[bytes]
    body: bytes = b""
    version: str = "HTTP/1.1"
    is_cut: bool = False

    def content(self) -> bytes:
        first = f"{self.method} {self.target} {self.version}".encode("utf-8", "surrogateescape")
        return b"\r\n".join([first, *self.headers, b"", self.body])


@dataclass
class RequestFuzz:
    """Makes requests from templates by up to four random changes.

    Args:
        random: generator of all random choices.
        known: values for `{NAME}` in templates.
        tokens: role → token; the role `lease` has the token of the session on the node.
    """

    random: Random
    known: dict[str, str] = field(default_factory=dict)
    tokens: dict[str, str] = field(default_factory=dict)

    def make(self, templates: list[tuple[str, str, str, Any]]) -> RawRequest:
        changes = self.random.randint(0, 4)
        if self.random.random() < 0.4 and (documents := [one for one in templates if is_json(one)]):
            method, path, role, body = self.random.choice(documents)
            in_tree, changes = max(changes, 1), 0
        else:
            method, path, role, body = self.random.choice(templates)
            in_tree = 0
        path = path.format(**self.known)
        if isinstance(body, dict):
            document = self._filled(body)
            for _ in range(in_tree):
                document = self._change_tree(document)
            content = _clamped(document)
        else:
            content = body or b""
        headers = [b"Host: x", b"Connection: close"]
        if role:
            headers.append(f"Authorization: Bearer {self.tokens[role]}".encode())
        if isinstance(body, dict):
            headers.append(b"Content-Type: application/json")
        request = RawRequest(method, path, headers, content)
        is_sized = True
        for _ in range(changes):
            change = self.random.choice(CHANGES)
            request = change(self, request)
            is_sized = is_sized and change not in (change_header, change_head_bytes)
        length = len(request.body)
        if self.random.random() < 0.02:
            length = self.random.choice([0, max(length - 1, 0), length + 1, 10 * length + 9])
            is_sized = length <= len(request.body)
        if request.body or length or self.random.random() < 0.3:
            request.headers.append(f"Content-Length: {length}".encode())
        return replace(request, is_cut=request.is_cut or not is_sized)

    def _filled(self, body: Any) -> Any:
        text = json.dumps(body)
        for name, value in self.known.items():
            text = text.replace(f"{{{name}}}", value)
        return json.loads(text)

    def _change_tree(self, document: Any) -> Any:
        """Return a document with one part changed, removed or added."""
        if not isinstance(document, dict | list) or not document or self.random.random() < 0.2:
            return self._value(document)
        keys = list(document) if isinstance(document, dict) else list(range(len(document)))
        inner = [key for key in keys if isinstance(document[key], dict | list)]
        key = self.random.choice(inner if inner and self.random.random() < 0.5 else keys)
        found = document.copy()
        kind = self.random.random()
        if kind < 0.1:
            del found[key]
        elif kind < 0.2 and isinstance(found, dict):
            found[self.random.choice(["", "x", "\0", "\ud83d", "é", "a" * 500])] = self._value(1)
        else:
            found[key] = self._change_tree(found[key])
        return found

    def _value(self, old: Any) -> Any:
        if self.random.random() < 0.2:
            nested: Any = old
            for _ in range(self.random.choice([3, 31, 40, 200, 900])):
                nested = [nested] if self.random.random() < 0.5 else {"a": nested}
            return nested
        if self.random.random() < 0.1:
            return [old] * self.random.choice([2, 70, 3000])
        return self.random.choice(VALUES)


def is_json(template: tuple[str, str, str, Any]) -> bool:
    return isinstance(template[3], dict)


def _clamped(document: Any) -> bytes:
    """Return a document as JSON, with any waiting time limited to 0.01 s."""
    if isinstance(document, dict) and isinstance(document.get("wait_s"), int | float):
        wait_s = document["wait_s"]
        document = {**document, "wait_s": min(wait_s, 0.01) if wait_s == wait_s else wait_s}
    try:
        return json.dumps(document).encode()
    except RecursionError:
        return b"[" * 900 + b"]" * 900


def change_method(fuzz: RequestFuzz, request: RawRequest) -> RawRequest:
    return replace(request, method=fuzz.random.choice(METHODS))


def change_path(fuzz: RequestFuzz, request: RawRequest) -> RawRequest:
    path, mark, query = request.target.partition("?")
    parts = path.split("/")
    place = fuzz.random.randrange(len(parts))
    segment = fuzz.random.choice([*SEGMENTS, *map(quote, fuzz.known.values())])
    if fuzz.random.random() < 0.2:
        parts.insert(place, segment)
    else:
        parts[place] = segment
    return replace(request, target="/".join(parts) + mark + query)


def change_query(fuzz: RequestFuzz, request: RawRequest) -> RawRequest:
    path, _, query = request.target.partition("?")
    new = fuzz.random.choice(QUERIES)
    query = f"{query}&{new}" if query and fuzz.random.random() < 0.5 else new
    return replace(request, target=f"{path}?{query}")


def change_token(fuzz: RequestFuzz, request: RawRequest) -> RawRequest:
    token = fuzz.random.choice([*fuzz.tokens.values()])
    kind = fuzz.random.random()
    if kind < 0.3:
        place = fuzz.random.randrange(len(token))
        token = token[:place] + fuzz.random.choice("Aa0_-.") + token[place + 1 :]
    elif kind < 0.4:
        token = token[: fuzz.random.randrange(len(token))]
    headers = [one for one in request.headers if not one.startswith(b"Authorization")]
    return replace(request, headers=[*headers, f"Authorization: Bearer {token}".encode()])


def change_header(fuzz: RequestFuzz, request: RawRequest) -> RawRequest:
    headers = request.headers.copy()
    if fuzz.random.random() < 0.2:
        del headers[fuzz.random.randrange(len(headers))]
    headers.insert(fuzz.random.randrange(len(headers) + 1), fuzz.random.choice(HEADERS))
    return replace(request, headers=headers)


def change_head_bytes(fuzz: RequestFuzz, request: RawRequest) -> RawRequest:
    place = fuzz.random.randrange(len(request.headers))
    headers = request.headers.copy()
    headers[place] = _changed_bytes(fuzz.random, headers[place])
    version = fuzz.random.choice(["HTTP/1.1", "HTTP/1.0", "HTTP/2.0", "HTTP/9", "http/1.1", ""])
    return replace(request, headers=headers, version=version)


def change_body_bytes(fuzz: RequestFuzz, request: RawRequest) -> RawRequest:
    if b"wait_s" in request.body:  # a changed digit could ask for a long wait
        return request
    body = request.body
    for _ in range(fuzz.random.randint(1, 4)):
        body = _changed_bytes(fuzz.random, body)
    return replace(request, body=body)


def change_body(fuzz: RequestFuzz, request: RawRequest) -> RawRequest:
    deep = fuzz.random.choice([33, 500, 990, 5000])
    bodies = [b"", b"null", b"[" * deep, b"[" * deep + b"]" * deep, b'{"a":' * deep + b"}" * deep,
              b"1" * 5000, b'"\\ud800"', b"\xff\xfe{\0}\0", b"\xef\xbb\xbf{}", b"{}" * 9, b"NaN",
              b"1e400", fuzz.random.randbytes(200), b"\0" * 70_000, b"x" * 300_000]  # fmt: skip
    return replace(request, body=fuzz.random.choice(bodies))


def _changed_bytes(random: Random, content: bytes) -> bytes:
    place = random.randrange(len(content) + 1)
    match random.randrange(4):
        case 0:
            return content[:place] + random.randbytes(1) + content[place + 1 :]
        case 1:
            return content[:place] + random.randbytes(random.randint(1, 3)) + content[place:]
        case 2:
            return content[:place]
        case _:
            return content[:place] + content[place + random.randint(1, 9) :]


Change = Callable[[RequestFuzz, RawRequest], RawRequest]
CHANGES: list[Change] = [
    change_method, change_path, change_path, change_query, change_token, change_header,
    change_head_bytes, change_body_bytes, change_body_bytes, change_body,
]  # fmt: skip


def send(url: str, request: RawRequest) -> Answer:
    """Send a request and return the answer; raise TimeoutError if no answer arrives in time."""
    place = urlsplit(url)
    with socket.create_connection((place.hostname, place.port), timeout=TIMEOUT_S) as line:
        with suppress(
            ConnectionError
        ):  # the server may refuse the request before it has read all bytes
            line.sendall(request.content())
        if request.is_cut:
            with suppress(OSError):  # the server has closed the connection
                line.shutdown(socket.SHUT_WR)
        return _read(line, request)


def _read(line: socket.socket, request: RawRequest) -> Answer:
    content = b""
    while True:
        head, end, body = content.partition(b"\r\n\r\n")
        if (
            end and head.split(b" ", 2)[1][:1] == b"1"
        ):  # skip an interim answer such as 100 Continue
            content = body
            continue
        if end and (request.method == "HEAD" or len(body) >= _length(head)):
            return Answer(int(head.split(b" ", 2)[1]), head, body)
        try:
            more = line.recv(1 << 16)
        except ConnectionError:
            more = b""
        if not more:
            return Answer(int(head.split(b" ", 2)[1]) if end else 0, head, body)
        content += more


def _length(head: bytes) -> int:
    """Return the length of the body that the head states, or 0 for a stream."""
    for row in head.lower().split(b"\r\n"):
        if row.startswith(b"content-length:"):
            return int(row.split(b":")[1])
    return 0
