"""The viewer's web server: headers, origins, tokens, slow and invalid clients, a used port."""

from __future__ import annotations

import json
import socket
import struct
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from typing import Any

import httpx
import pytest
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import ClientConnection, connect

from cavmarl.core.errors import ServiceError
from cavmarl.env.parallel import parallel_env
from cavmarl.viewer.frame_messages import Change, Publication
from cavmarl.viewer.map_geometry import unpack
from cavmarl.viewer.show_world import show_worlds
from cavmarl.viewer.web_options import WebOptions
from cavmarl.viewer.web_server import PAGE, POLICY, WebServer
from tests.viewer.conftest import Served

Serve = Callable[..., Served]


HANDSHAKE = "Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\nSec-WebSocket-Version: 13\r\n\r\n"


def live(server: WebServer, headers: dict[str, str] | None = None) -> Any:
    address = server.address.replace("http", "ws") + "live"
    return connect(address, max_size=2**24, additional_headers=headers)


@contextmanager
def welcome(server: WebServer, token: str = "") -> Iterator[ClientConnection]:
    with live(server) as client:
        client.send(json.dumps({"kind": "hello", "token": token}))
        yield client


def first_of(client: ClientConnection, kind: int | str) -> Any:
    """Return the next message of a kind; binary kinds are numbers, texts have names."""
    end = time.monotonic() + 20.0
    while time.monotonic() < end:
        message = client.recv(timeout=20.0)
        if isinstance(message, str):
            told = json.loads(message)
            if told["kind"] == kind:
                return told
        elif message[0] == kind:
            return message
    raise AssertionError(f"no message {kind}")


def ended_with(client: ClientConnection) -> tuple[int | None, str]:
    try:
        while True:
            client.recv(timeout=20.0)
    except ConnectionClosed:
        return client.close_code, client.close_reason or ""


def test_a_page_gets_the_world_the_map_and_frames(serve: Serve) -> None:
    served = serve()
    with welcome(served.server) as client:
        hello = first_of(client, "hello")
        assert hello["title"] == "grid4x4"
        assert len(hello["zones"]) == 4
        assert first_of(client, 1) == served.map_bytes
        assert first_of(client, 2)[1] == 1  # a complete roster
        ticks = [struct.unpack_from("<I", first_of(client, 3), 16)[0] for _ in range(3)]
        assert ticks == sorted(set(ticks))


def test_requests_reach_the_world(serve: Serve) -> None:
    served = serve()
    with welcome(served.server) as client:
        first_of(client, 3)
        client.send('{"kind": "pause"}')
        while first_of(client, 3)[1] != 1:
            pass
        steps = served.run.steps
        client.send('{"kind": "step"}')
        first_of(client, 3)
        assert served.run.steps == steps + 1
        client.send('{"kind": "watch", "number": 0}')
        told = first_of(client, "vehicle")
        assert told["here"]
        rows = dict(told["rows"])
        assert rows["agent"] == "car_0"
        assert [name for name, _ in told["terms"]] == list(served.env.config.terms.names)
        assert len(told["observation"]) == served.env.observation_space("car_0").shape[0]
        client.send('{"kind": "watch", "number": 99999}')
        assert first_of(client, "vehicle") == {
            "kind": "vehicle", "id": 99999, "here": False, "rows": [],
        }  # fmt: skip
        client.send('{"kind": "ghosts", "number": 1}')
        while struct.unpack_from("<I", first_of(client, 3), 32)[0] != 1:
            pass


def test_one_page_at_a_time_drives_a_seat(serve: Serve, monkeypatch: pytest.MonkeyPatch) -> None:
    served = serve(drives=False)
    noted, run = served.note_actions(monkeypatch), served.run
    with welcome(served.server) as one, welcome(served.server) as other:
        for client, number in ((one, 1), (other, 2)):
            first_of(client, 1)
            client.send('{"kind": "seat", "number": 0}')
            turns_until(served, lambda: bool(run.seats))
            told = first_of_turning(served, client)
            assert (told["agent"], bool(told["reason"])) == ((0, False), (None, True))[number - 1]
        one.send('{"kind": "drive", "throttle": 1.0, "steering": 0.5}')
        turns_until(served, lambda: [1.0, 0.5] in [action.tolist() for action in noted])
    turns_until(served, lambda: not run.seats)


def turns_until(served: Served, is_so: Callable[[], bool]) -> None:
    end = time.monotonic() + 20.0
    while not is_so() and time.monotonic() < end:
        served.run.turn()
    assert is_so()


def first_of_turning(served: Served, client: ClientConnection) -> Any:
    for _ in range(10):
        served.run.turn()
        time.sleep(0.03)
    return first_of(client, "seat")


@pytest.mark.parametrize("path", ["", "main.js", "viewer.css", "icon.svg", "nothing", "../app.py"])
def test_all_answers_have_the_security_headers(serve: Serve, path: str) -> None:
    served = serve(drives=False)
    answer = httpx.get(served.server.address + path)
    assert answer.status_code == (200 if (PAGE / (path or "index.html")).is_file() and
                                  ".." not in path else 404)  # fmt: skip
    assert answer.headers["content-security-policy"] == POLICY
    assert "unsafe" not in POLICY
    assert answer.headers["x-content-type-options"] == "nosniff"
    assert answer.headers["referrer-policy"] == "no-referrer"
    assert answer.headers["cache-control"] == "no-store"
    assert "server" not in answer.headers


def test_the_page_has_no_code_that_its_content_security_policy_forbids() -> None:
    for file in PAGE.iterdir():
        text = file.read_text(encoding="utf-8")
        assert "innerHTML" not in text
        assert "insertAdjacentHTML" not in text
        assert "eval(" not in text
        assert " style=" not in text
        assert " onclick=" not in text
        assert "https://" not in text
        assert text.count("\n") <= 560, f"{file.name}: too long, divide it"


def test_foreign_origins_and_host_names_are_refused(serve: Serve) -> None:
    served = serve(drives=False)
    port = served.server.port
    for headers in (
        {"Origin": "http://evil.example"},
        {"Origin": "null"},
        {"Origin": f"http://localhost:{port}"},  # the same machine, but another origin
        {"Host": f"evil.example:{port}", "Origin": f"http://evil.example:{port}"},
    ):
        assert status_of_handshake(port, headers) == 403
    host = {"Host": f"evil.example:{port}"}
    assert httpx.get(served.server.address, headers=host).status_code == 403
    own = {"Origin": f"http://127.0.0.1:{port}"}
    with live(served.server, headers=own) as client:
        client.send("{}")
        assert first_of(client, "hello")


def status_of_handshake(port: int, headers: dict[str, str]) -> int:
    fields = {"Host": f"127.0.0.1:{port}", **headers}
    lines = "".join(f"{name}: {value}\r\n" for name, value in fields.items())
    with socket.create_connection(("127.0.0.1", port), timeout=10.0) as peer:
        peer.sendall(
            f"GET /live HTTP/1.1\r\n{lines}Upgrade: websocket\r\nConnection: Upgrade\r\n"
            f"{HANDSHAKE}".encode()
        )
        status = int(peer.recv(4096).split()[1])
    return status


def test_a_configured_token_is_required(serve: Serve) -> None:
    served = serve(drives=False, options=WebOptions(port=0, token="a secret"))
    with welcome(served.server) as client:
        assert ended_with(client) == (4401, "a token is needed")
    with welcome(served.server, "another") as client:
        assert ended_with(client) == (4401, "wrong token")
    assert served.audience.wishes.watchers == 0
    with welcome(served.server, "a secret") as client:
        assert first_of(client, "hello")


def test_the_watch_token_gives_no_control(serve: Serve) -> None:
    options = WebOptions(port=0, token="a secret", watch_token="another")
    served = serve(drives=False, options=options)
    with welcome(served.server, "another") as client:
        assert first_of(client, "hello")["control"] is False
        client.send('{"kind": "pause"}')
        client.send('{"kind": "insert", "x": 0, "y": 0}')
        client.send('{"kind": "watch", "number": 0}')
        for _ in range(200):
            served.run.turn()
            if served.audience.wishes.vehicles:
                break
            time.sleep(0.01)
        assert served.audience.wishes.vehicles == {0}
        assert not served.run.clock.is_paused
    with welcome(served.server, "a secret") as client:
        assert first_of(client, "hello")["control"] is True


def test_serving_other_machines_requires_a_token() -> None:
    with pytest.raises(
        ServiceError, match=r"--host 0\.0\.0\.0: reachable from outside; give a --to"
    ):
        WebServer(WebOptions(host="0.0.0.0", port=0), [])


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("nonsense", "not valid JSON"),
        ("[1]", "a list"),
        ('{"kind": "fly"}', "'fly'"),
        ('{"kind": "watch", "number": -1}', "whole number"),
        ('{"kind": "watch", "number": true}', "whole number"),
        ('{"kind": "pace", "number": 1e9}', "from 0 to 1000"),
        ('{"kind": "drive", "throttle": 1, "steering": NaN}', "from -1 to 1"),
        ('{"kind": "drive", "throttle": "full"}', "must be a number"),
        ('{"kind": "insert", "x": 1}', "y: must be a number"),
        ('{"kind": "close", "x": 1e300, "y": 0}', "x = 1e+300: must be from"),
        (f'{{"kind": "pace", "number": {"9" * 400}}}', "pace = 9999999999…: must be from"),
        (f'{{"kind": "drive", "throttle": -{"9" * 400}}}', "throttle = -999999999…: must be from"),
        ('{"kind": "\\ud800"}', "ud800"),
        ('{"kind": "' + "\U0001f697" * 40 + '"}', "request of kind"),
    ],
)
def test_invalid_messages_end_the_connection(serve: Serve, text: str, reason: str) -> None:
    served = serve(drives=False)
    with welcome(served.server) as client:
        first_of(client, 1)
        client.send(text)
        code, why = ended_with(client)
        assert code == 1003
        assert reason in why


@pytest.mark.parametrize("hello", ['{"token": "\\ud800"}', '{"world": "\\ud800"}', "{\ud800}"])
def test_a_first_message_with_half_a_surrogate_pair_is_refused(serve: Serve, hello: str) -> None:
    served = serve(drives=False)
    with live(served.server) as client:
        client.send(hello.encode(errors="surrogatepass"), text=True)
        assert ended_with(client)[0] in (1003, 1007, 4401)
    with welcome(served.server) as client:
        assert first_of(client, "hello")


def test_a_page_without_control_changes_nothing(serve: Serve) -> None:
    served = serve(options=WebOptions(port=0, control=False))
    with welcome(served.server) as client:
        assert first_of(client, "hello")["control"] is False
        for kind in ("pause", "reset", "step"):
            client.send(json.dumps({"kind": kind}))
        for _ in range(4):
            assert first_of(client, 3)[1] == 0


def test_a_watcher_that_reads_nothing_is_dropped(serve: Serve) -> None:
    served = serve(options=WebOptions(port=0, send_s=0.5), drives=False)
    served.run.clock.pace = 0.0
    large = Publication(b"\x03" + bytes(2**20), (Change(1, b""),))
    with closing(socket.socket()) as peer:
        peer.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        peer.connect(("127.0.0.1", served.server.port))
        peer.sendall(
            f"GET /live HTTP/1.1\r\nHost: 127.0.0.1:{served.server.port}\r\n"
            f"Upgrade: websocket\r\nConnection: Upgrade\r\n{HANDSHAKE}".encode()
        )
        assert b"101" in peer.recv(512)
        peer.sendall(b"\x81\x82\x00\x00\x00\x00{}")
        turns_until(served, lambda: served.audience.wishes.watchers == 1)
        steps = served.run.steps
        end = time.monotonic() + 30.0
        while not served.audience.dropped and time.monotonic() < end:
            served.audience.publish(large)
            served.run.turn()
            time.sleep(0.02)
        assert served.audience.dropped == 1
        assert served.run.steps > steps
        turns_until(served, lambda: served.audience.wishes.watchers == 0)


def test_a_world_without_watchers_publishes_nothing(serve: Serve) -> None:
    served = serve(drives=False)
    served.run.clock.pace = 0.0
    for _ in range(30):
        served.run.turn()
    assert (served.run.steps, served.run.publisher.published) == (30, 0)


def test_frames_are_published_no_more_often_than_20_times_a_second(serve: Serve) -> None:
    served = serve(drives=False)
    served.run.clock.pace = 0.0
    with welcome(served.server) as client:
        first_of(client, 1)
        begun = time.monotonic()
        while time.monotonic() - begun < 1.0:
            served.run.turn()
        took = time.monotonic() - begun
    assert 2 <= served.run.publisher.published <= 20 * took + 1
    assert served.run.steps > served.run.publisher.published


def test_a_used_port_is_a_typed_error(serve: Serve) -> None:
    served = serve(drives=False)
    env = parallel_env("ring", agents=1, background=0)
    with pytest.raises(ServiceError, match="Address already in use; give another --port"):
        show_worlds([env], "idm", 0, WebOptions(port=served.server.port), lambda _: None, 1.0)


def test_the_head_of_a_map_lists_its_sections(serve: Serve) -> None:
    head, sections = unpack(serve(drives=False).map_bytes)
    assert head["name"]
    ends = [start for start, _ in head["sections"].values()]
    assert ends == sorted(ends)
    assert len(sections) >= ends[-1]
