"""The ports of a server: invalid input does not affect the world or other clients."""

from __future__ import annotations

import socket
import struct
import threading
import time
from collections.abc import Iterator
from typing import Any

import msgpack
import pytest

import cavmarl
from cavmarl.core.errors import ConfigError, ServiceError
from cavmarl.cosim.carla.carla_server import CarlaServer, serve, warn_of_host
from cavmarl.cosim.carla.carla_session import SessionLimits
from cavmarl.cosim.carla.carla_snapshots import VEHICLE_STATE
from cavmarl.cosim.carla.carla_streams import EPISODE_STREAM
from cavmarl.cosim.carla.hosted_world import SERVED_WORLD, GivenWorld
from cavmarl.engine.world_setup import find_map
from tests.cosim.carla.conftest import VERSION, make_server

HEAD, SNAPSHOT_HEAD = 48, 36
CONTINUOUS = {"population.mode": "respawn", "clock.ctrl_dt_s": 0.05}


class Wire:
    """A client that sends and reads bytes."""

    def __init__(self, port: int) -> None:
        self.socket = socket.create_connection(("127.0.0.1", port), 10.0)
        self._unpacker = msgpack.Unpacker(raw=False, strict_map_key=False)
        self._number = 0

    def __enter__(self) -> Wire:
        return self

    def __exit__(self, *_: object) -> None:
        self.socket.close()

    def call(self, name: str, *arguments: Any) -> Any:
        self._number += 1
        self.socket.sendall(msgpack.packb([0, self._number, name, [[False], *arguments]]))
        while True:
            for answer in self._unpacker:
                assert answer[:2] == [1, self._number]
                return answer[2] or answer[3]
            data = self.socket.recv(1 << 16)
            assert data, "the connection is closed"
            self._unpacker.feed(data)

    def is_closed(self) -> bool:
        """Return whether the server has closed the connection."""
        try:
            return self.socket.recv(1) == b""
        except ConnectionError:
            return True


def listen_to(port: int, stream: int) -> socket.socket:
    with Wire(port) as wire:
        token = wire.call("get_sensor_token", stream)[0][1][0]
    _, stream_port = struct.unpack_from("<IH", token)
    connection = socket.create_connection(("127.0.0.1", stream_port), 10.0)
    connection.sendall(struct.pack("<I", stream))
    return connection


def frame_of(connection: socket.socket) -> bytes:
    (size,) = struct.unpack("<I", receive_bytes(connection, 4))
    return receive_bytes(connection, size)


def receive_bytes(connection: socket.socket, size: int) -> bytes:
    found = b""
    while len(found) < size:
        more = connection.recv(size - len(found))
        assert more
        found += more
    return found


@pytest.mark.parametrize(
    "data", [b"GET / HTTP/1.1\r\n\r\n", b"\xc1\xc1", msgpack.packb([0, 1, 2, 3]), b"\x91" * 4000]
)
def test_an_invalid_message_closes_only_its_own_connection(port: int, data: bytes) -> None:
    with Wire(port) as good, Wire(port) as bad:
        bad.socket.sendall(data)
        assert bad.is_closed()
        assert good.call("version") == [[1, VERSION]]


def test_clients_that_vanish_leave_the_world_running(port: int) -> None:
    for data in (b"", b"\x94\x00", msgpack.packb([0, 1, "get_map_data", [[False]]])):
        wire = Wire(port)
        wire.socket.sendall(data)
        wire.socket.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        wire.socket.close()
    with Wire(port) as good, listen_to(port, EPISODE_STREAM) as stream:
        first, second = frame_of(stream), frame_of(stream)
        assert good.call("get_episode_info")[0][0] == 1
        assert struct.unpack_from("<QQ", second)[1] == struct.unpack_from("<QQ", first)[1] + 1


def test_a_snapshot_has_all_actors_and_the_time(port: int) -> None:
    with listen_to(port, EPISODE_STREAM) as stream:
        frame = frame_of(stream)
    kind, number, time_s = struct.unpack_from("<QQd", frame)
    episode, _, delta_s = struct.unpack_from("<Qdf", frame, HEAD)
    assert (kind, episode, delta_s) == (17, 1, pytest.approx(0.05))
    assert time_s == pytest.approx(0.05 * number)
    states = memoryview(frame)[HEAD + SNAPSHOT_HEAD :]
    assert len(states) % VEHICLE_STATE.itemsize == 0
    assert len(states) // VEHICLE_STATE.itemsize >= 1 + 64 + 8 + 1  # spectator, lights, vehicles


def test_valid_and_invalid_calls_are_answered_in_order(port: int) -> None:
    with Wire(port) as wire:
        assert wire.call("fly").startswith("rpclib: server could not find function 'fly'")
        assert wire.call("get_sensor_token")[0][0] == 0
        assert wire.call("destroy_actor", "x")[0][0] == 0
        assert wire.call("tick_cue")[0][0] == 1


def test_a_client_that_stops_reading_is_disconnected() -> None:
    over: list[bool] = []
    with make_server(limits=SessionLimits(max_unsent=1 << 18)) as server:
        began = time.monotonic()

        def is_over() -> bool:
            return bool(over) or time.monotonic() - began > 60.0

        thread = threading.Thread(target=server.run, args=(is_over,), daemon=True)
        thread.start()
        with Wire(server.port) as wire:
            with listen_to(server.port, EPISODE_STREAM) as deaf:
                deaf.setsockopt(
                    socket.SOL_SOCKET, socket.SO_RCVBUF, 1
                )  # the buffer is full after a few ticks
                rest = [True, 0.01, 10, 0.0, True, 3000.0, 2000.0, True]
                wire.call("set_episode_settings", [True, False, [False], *rest])
                while server.session.streams.connections and not is_over():
                    wire.call("tick_cue")
            assert not server.session.streams.connections
            assert wire.call("version") == [[1, VERSION]]
        over.append(True)
        thread.join(10.0)


@pytest.fixture
def env() -> Iterator[cavmarl.CavEnv]:
    made = cavmarl.parallel_env("grid4x4", agents=3, background=8, overrides=CONTINUOUS)
    yield made
    made.close()


def test_a_second_server_on_the_same_port_is_refused() -> None:
    with make_server() as server, pytest.raises(ServiceError, match=r"give another --port"):
        CarlaServer(server.session.source, port=server.port)


def test_only_this_machine_can_connect_without_a_flag(caplog: pytest.LogCaptureFixture) -> None:
    with pytest.raises(ConfigError, match=r"CARLA's protocol has no login; set any_host = True"):
        serve("grid4x4", host="0.0.0.0")
    warn_of_host("0.0.0.0")
    assert "every program that reaches this address controls the world" in caplog.text


def test_a_server_without_clients_does_not_change_the_world(env: cavmarl.CavEnv) -> None:
    env.reset(seed=3)
    alone = []
    for _ in range(100):
        env.step(env.suggest_actions())
        alone.append(env.state_hash())
    env.reset(seed=3)
    source = GivenWorld(env, find_map("grid4x4"))
    with CarlaServer(source, port=0, step_s=env.step_s) as server:
        served = []
        for _ in range(100):
            server.session.tick()
            served.append(env.state_hash())
    assert served == alone
    env.step(env.suggest_actions())  # closing the server releases the environment


def test_an_environment_with_discrete_actions_is_refused() -> None:
    made = cavmarl.parallel_env("grid4x4", overrides={"action.kind": "discrete"})
    with pytest.raises(ConfigError, match=r"set action\.kind = continuous"):
        CarlaServer(GivenWorld(made, find_map("grid4x4")), port=0, step_s=made.step_s)
    made.close()


def test_a_server_refuses_a_map_that_is_not_of_its_environment(env: cavmarl.CavEnv) -> None:
    with pytest.raises(ConfigError, match="not the map of grid4x4"):
        GivenWorld(env, find_map("intersection"))


def test_settings_of_a_served_world_are_valid() -> None:
    made = cavmarl.parallel_env("merge", overrides=SERVED_WORLD)
    assert made.config.action.kind == "continuous"
    made.close()
