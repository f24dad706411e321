"""Callers with unknown or invalid messages get a typed error and do not affect the world."""

from __future__ import annotations

import os
import socket
import threading
from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cavmarl.core.errors import ConfigError, FollowerError, FollowerLostError
from cavmarl.cosim.followers import follower_connection as reception
from cavmarl.cosim.followers.followed_world import FollowedWorld
from cavmarl.cosim.followers.follower_client import Follower
from cavmarl.cosim.followers.follower_connection import FollowerConnection
from cavmarl.cosim.followers.follower_messages import (
    FOLLOWERS,
    VERSION,
    ArrayView,
    Control,
    FollowerSnapshot,
    Hello,
    Say,
    payload_of,
    read_payload,
)
from cavmarl.cosim.followers.framed_socket import FramedSocket
from tests.cosim.conftest import hashes, join_world, make_env
from tests.cosim.test_followed_world import reference
from tests.support.descriptors import without_descriptors


def call(address: Path) -> socket.socket:
    connection = socket.socket(socket.AF_UNIX)
    connection.connect(str(address))
    connection.settimeout(10.0)
    return connection


def refusal(connection: socket.socket) -> str:
    """Return the reason that the world gave when it closed the connection."""
    line = FollowerConnection(connection, "the world")
    heard = line.hear(10.0)
    assert heard.kind is Say.REFUSAL
    line.close()
    return str(heard.payload["reason"])


def hello_in(version: int) -> bytes:
    near, far = socket.socketpair()
    wire = FramedSocket(near, FOLLOWERS._replace(version=version))
    wire.send(Say.HELLO, 0, payload_of(Hello("x", [])))
    raw = far.recv(1 << 16)
    wire.close()
    far.close()
    return raw


def oversized() -> bytes:
    raw = bytearray(hello_in(VERSION))
    raw[16:20] = (1 << 31).to_bytes(4, "little")
    return bytes(raw)


@pytest.mark.parametrize(
    ("raw", "match"),
    [
        (b"GET / HTTP/1.1\r\nHost: localhost\r\n\r\n" + bytes(40), "does not begin a frame"),
        (hello_in(1), f"a frame has version 1, this end has {VERSION}: install the same version"),
        (oversized(), "bytes is too large"),
        (hello_in(VERSION)[:-3] + b"\xff\xff\xff", "does not match its checksum"),
    ],
    ids=["another protocol", "another version", "too large", "damaged"],
)
def test_unknown_callers_get_a_reason_and_the_world_continues(
    address: Path, raw: bytes, match: str
) -> None:
    with FollowedWorld(make_env(), address) as world:
        world.reset(seed=1)
        stranger = call(address)
        stranger.sendall(raw)
        found = hashes(world, 2)
        found += hashes(world, 1)
        assert match in refusal(stranger)
        assert found == reference(3, {})


def test_a_silent_caller_is_dropped(address: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(reception, "GREETING_S", 0.0)
    with FollowedWorld(make_env(), address) as world:
        world.reset(seed=1)
        silent = call(address)
        hashes(world, 3)
        assert "not introduced itself" in refusal(silent)


def test_a_slow_caller_does_not_block_the_world(
    address: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    words = hello_in(VERSION)
    with FollowedWorld(make_env(), address) as world:
        world.reset(seed=1)
        slow = call(address)
        for k in range(len(words) - 1):
            slow.sendall(words[k : k + 1])
            world.admit(0.0)
        assert not world.master.followers
        slow.sendall(words[-1:])
        world.admit(0.0)
        assert [follower.name for follower in world.master.followers] == ["x"]
        monkeypatch.setattr(reception, "GREETING_S", 0.0)
        half = call(address)
        half.sendall(words[:20])
        world.admit(0.0)
        assert "not introduced itself" in refusal(half)
        slow.close()


def test_many_silent_callers_do_not_keep_a_follower_out(address: Path) -> None:
    with FollowedWorld(make_env(), address) as world:
        world.reset(seed=1)
        crowd = [call(address) for _ in range(reception.MAX_CALLERS)]
        world.admit(0.0)
        late = call(address)
        late.sendall(hello_in(VERSION))
        world.admit(0.0)  # the new caller replaces the oldest one
        world.admit(0.0)
        assert [follower.name for follower in world.master.followers] == ["x"]
        assert "too many callers" in refusal(crowd[0])
        for connection in (*crowd, late):
            connection.close()


def test_without_descriptors_the_oldest_caller_is_dropped(address: Path) -> None:
    with FollowedWorld(make_env(), address) as world:
        world.reset(seed=1)
        first = call(address)
        world.admit(0.0)
        later, words = call(address), hello_in(VERSION)
        with without_descriptors():
            world.admit(0.0)
            assert "no descriptors" in refusal(first)
            world.admit(0.0)
            later.sendall(words)
            world.admit(0.0)
            assert [follower.name for follower in world.master.followers] == ["x"]
        later.close()


@pytest.mark.parametrize(
    ("speak", "match"),
    [
        (lambda wire: wire.send(Say.HELLO, 0, payload_of(Hello("again", []))), "sent HELLO"),
        (lambda wire: os.write(wire.fileno(), b"garbage " * 20), "does not begin a frame"),
        (lambda wire: wire.send(Say.CONTROL, 0, {"frame": "x"}), "not a Control"),
        (lambda wire: wire.send(Say.CONTROL, 0, None), "not a Control"),
        (lambda wire: wire.send(Say.CONTROL, 0, {"frame": 0, "controls": {}, "more": 1}), "more"),
    ],
    ids=["hello twice", "garbage", "no number", "nothing", "unknown key"],
)
def test_a_follower_with_invalid_messages_is_dropped(
    address: Path, speak: Callable[[FramedSocket], object], match: str
) -> None:
    with FollowedWorld(make_env(), address) as world:
        wire = FramedSocket(call(address), FOLLOWERS)
        wire.send(Say.HELLO, 0, payload_of(Hello("x", ["car_0"])))
        world.wait_for(1, 10.0)
        speak(wire)
        with pytest.raises(FollowerError, match=match):
            world.reset(seed=1)
        assert hashes(world, 2) == reference(2, {})
        wire.close()


def test_a_hello_with_too_many_vehicles_is_refused(address: Path) -> None:
    with FollowedWorld(make_env(), address) as world:
        line = FollowerConnection(call(address), "world")
        line.say(Say.HELLO, Hello("greedy", ["car_0"] * 5000))
        world.reset(seed=0)
        hashes(world, 2)
        heard = line.hear(10.0)
        assert "requests 5000 vehicles" in heard.payload["reason"]
        line.close()


@settings(max_examples=60, deadline=None)
@given(st.binary(max_size=200))
def test_any_bytes_give_a_frame_or_a_typed_error(raw: bytes) -> None:
    near, far = socket.socketpair()
    far.sendall(raw)
    far.close()
    line = FollowerConnection(near, "somebody")
    try:
        heard = line.hear(5.0)
        line.skip(heard)
    except FollowerError:
        pass
    finally:
        line.close()


@settings(
    deadline=None
)  # no deadline: the first call creates the validators of payloads, which takes longer
@given(
    st.recursive(
        st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
        lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner),
        max_leaves=8,
    )
)
def test_any_payload_gives_a_message_or_a_typed_error(payload: object) -> None:
    for kind in (Hello, Control, FollowerSnapshot):
        try:
            read_payload(kind, payload)
        except FollowerError:
            pass


@pytest.mark.parametrize(
    ("dtype", "shape", "stamps", "words"),
    [
        ("O", [1], 1, "dtype 'O': must be one of"),
        ("<f4,<f4", [1], 1, "dtype '<f4,<f4': must be one of"),
        ("<f4", [], 1, "invalid shape"),
        ("<f4", [-1], 1, "invalid shape"),
        ("<f4", [0] + [1 << 40] * 2, 0, "invalid shape"),
        ("<f4", [1] * 40, 1, "invalid shape"),
        ("<f4", [2, 3], 1, "2 samples with 1 stamps"),
    ],
)
def test_invalid_arrays_are_refused(dtype: str, shape: list[int], stamps: int, words: str) -> None:
    near, far = socket.socketpair()
    view = ArrayView("car_0", "lidar", dtype, shape, [0.0] * stamps, [False] * stamps)
    world, line = FollowerConnection(far, "a follower"), FollowerConnection(near, "the world")
    try:
        world.say(Say.SNAPSHOT, FollowerSnapshot(0, 0, 0, 0.0, False, {}, [view]))
        with pytest.raises(FollowerError, match=words):
            line.take(line.hear(5.0))
    finally:
        line.close()
        world.close()


def test_a_port_needs_a_secret_that_callers_know() -> None:
    with pytest.raises(ConfigError, match=r"every user.*--secret-file"):
        FollowedWorld(make_env(), 0)
    with FollowedWorld(make_env(), 0, secret="of this world") as world:
        for wrong in ("", "of this World", "€"):
            refused: list[str] = []

            def join(secret: str = wrong, refused: list[str] = refused) -> None:
                with pytest.raises(FollowerError) as error:
                    Follower(world.address, [], "x", 10.0, secret)
                refused.append(str(error.value))

            caller = threading.Thread(target=join)
            caller.start()
            with pytest.raises(FollowerLostError):
                world.wait_for(1, 0.5)
            caller.join(10.0)
            assert "does not know the secret" in refused[0]
        assert world.seats == ()


def test_a_name_with_control_characters_is_refused(address: Path) -> None:
    with FollowedWorld(make_env(), address) as world:
        caller = threading.Thread(target=lambda: said.append(refusal_of(world)))
        said: list[str] = []
        caller.start()
        with pytest.raises(FollowerLostError):
            world.wait_for(1, 0.5)
        caller.join(10.0)
        assert "cannot be printed" in said[0]


def refusal_of(world: FollowedWorld) -> str:
    with pytest.raises(FollowerError) as error:
        Follower(world.address, [], "\x1b[2J", 10.0)
    return str(error.value)


def test_followers_can_connect_by_a_local_port() -> None:
    with FollowedWorld(make_env(), 0, secret="of this world") as world:
        assert isinstance(world.address, int)
        follower = join_world(world, ["car_0"], secret="of this world")
        caller = threading.Thread(target=lambda: [follower.wait(), follower.leave()])
        caller.start()
        world.reset(seed=0)
        caller.join(10.0)
        assert world.seats == ()
