"""The target for messages between followers and worlds, at both ends of a socket.

An input has the messages of one end. Its first byte selects the end: `W` or `w`, a world that sends
to a `Follower`; any other byte, a follower that calls a world and answers two of its snapshots.
After a small letter, the input has lines of JSON, `[kind, payload, bytes of data]`, which are
packed to frames, so that the fuzzer reaches the content of messages. After any other byte, it has
the frames themselves, whose checksums are corrected as in the targets of the ownership protocol.
"""

from __future__ import annotations

import json
import socket
import struct
import tempfile
import zlib
from collections.abc import Sequence
from contextlib import suppress
from functools import cache
from pathlib import Path
from threading import Thread
from typing import Any

import msgpack

from cavmarl.core.errors import ClockError, FollowerError
from cavmarl.cosim.actors.client_actors import ClientActors
from cavmarl.cosim.followers.followed_world import order_of
from cavmarl.cosim.followers.follower_barrier import Barrier, FollowerSeat
from cavmarl.cosim.followers.follower_client import Follower
from cavmarl.cosim.followers.follower_connection import FollowerConnection, Reception, listen
from cavmarl.cosim.followers.follower_messages import (
    FOLLOWERS,
    ActorPoses,
    ActorRequest,
    Control,
    FollowerRefusal,
    Hello,
    PoseView,
    Say,
    Ticked,
    payload_of,
)
from cavmarl.cosim.followers.follower_snapshots import SnapshotTime, take_snapshot, welcome_to
from cavmarl.cosim.time_master import TimeMaster
from cavmarl.env.parallel import CavEnv, parallel_env
from fuzz.files import Target

__all__ = ["FOLLOWER"]

WORLD, STACK = b"W", b"F"
AGENTS = ("car_0", "car_1")
HEAD = struct.Struct("<4sHHQIQI")
CRC_BYTES = 4
WITHIN_S = 5.0
MAX_BYTES = 1 << 15  # bytes that a socket accepts before the other end reads


def _sealed(content: bytes) -> bytes:
    """Return the frames with correct checksums, up to the first bytes that are not a frame."""
    raw, at = bytearray(content), 0
    while at + HEAD.size + CRC_BYTES <= len(raw):
        *start, letter_size, size, _ = HEAD.unpack_from(raw, at)
        letter = at + HEAD.size + CRC_BYTES
        data, end = letter + letter_size, letter + letter_size + size
        if end > len(raw):
            break
        HEAD.pack_into(raw, at, *start, letter_size, size, zlib.crc32(raw[data:end]))
        checksum = zlib.crc32(raw[letter:data], zlib.crc32(raw[at : at + HEAD.size]))
        struct.pack_into("<I", raw, at + HEAD.size, checksum)
        at = end
    return bytes(raw)


def _packed(content: bytes) -> bytes:
    """Return the frames that lines of JSON describe.

    Raises:
        FollowerError: they describe no frames.
    """
    frames = []
    for line in content.splitlines():
        try:
            kind, letter, size = json.loads(line)
            words = b"" if letter is None else msgpack.packb(letter)
            data = bytes(min(size, MAX_BYTES))
            frames.append(
                HEAD.pack(FOLLOWERS.magic, FOLLOWERS.version, kind, 0, len(words), size, 0)
            )
        except (ValueError, TypeError, OverflowError, RecursionError, struct.error) as error:
            raise FollowerError(f"no frame: {error}") from error
        frames += [bytes(CRC_BYTES), words, data]
    return b"".join(frames)


def _parse(content: bytes) -> None:
    start, said = content[:1], content[1 : 1 + MAX_BYTES]
    said = _sealed(_packed(said) if start.islower() else said)[:MAX_BYTES]
    (_a_follower_hears if start.upper() == WORLD else _a_world_hears)(said)


@cache
def _place() -> tuple[Path, tempfile.TemporaryDirectory[str]]:
    folder = tempfile.TemporaryDirectory(prefix="cavmarl-fuzz-")
    return Path(folder.name) / "s", folder


@cache
def _env() -> CavEnv:
    settings = {
        "population.mode": "respawn",
        "clock.ctrl_dt_s": 0.05,
        "population.external": 2,
        "population.external_agents": True,
        "rig": {"imu": {"type": "imu", "rate_hz": 20}},
    }
    env = parallel_env("ring", agents=len(AGENTS), background=1, overrides=settings)
    env.reset(seed=0)
    return env


def _a_world_hears(said: bytes) -> None:
    """Accept a caller, and pass the barrier twice with it."""
    env, place = _env(), _place()[0]
    reception, master = Reception(place), TimeMaster(env, own_ticks="ignore")
    line = None
    try:
        with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as caller:
            caller.settimeout(WITHIN_S)
            caller.connect(str(place))
            caller.sendall(said)
            caller.shutdown(socket.SHUT_WR)
            found = [*reception.callers(WITHIN_S), *reception.callers(WITHIN_S)]
            if not found:
                raise FollowerError("the caller was turned away")
            line, hello = found[0]
            actors = ClientActors(env)
            came = actors.join(hello.name, map(order_of, hello.actors))
            agents = tuple(range(len(AGENTS)))
            seat = FollowerSeat(line, master.follow(hello.name), agents, actors=tuple(came))
            barrier = Barrier(env, actors, WITHIN_S, "error")
            for frame in range(2):
                actors.act(0.0)
                outcome = barrier.pass_through([seat], SnapshotTime(frame, 0, 0, False))
                for error in outcome.failed.values():
                    raise error
                if outcome.left:
                    break
    finally:
        master.release()
        env.reset(seed=0)  # without actors
        reception.close()
        place.unlink(missing_ok=True)
        if line is not None:
            line.close()


def _a_follower_hears(said: bytes) -> None:
    """Follow until the world sends GOODBYE, and answer each snapshot."""
    place = _place()[0]
    with listen(place) as listener:
        world = Thread(target=_talk, args=(listener, said))
        world.start()
        try:
            with Follower(place, AGENTS, joins_s=WITHIN_S) as follower:
                follower.tick()
                for sight in follower:
                    controls = {vehicle: [0.0, 0.0] for vehicle in sight.snapshot.vehicles}
                    follower.answer(controls)
        except ClockError:
            pass  # a valid refusal of the tick
        except FollowerError as error:
            if type(error) is not FollowerError:  # else the world refused it with a reason
                raise
        finally:
            world.join()
            place.unlink(missing_ok=True)


def _talk(listener: socket.socket, said: bytes) -> None:
    """Send the bytes to the first caller, and read until it closes the connection."""
    connection, _ = listener.accept()
    with connection, suppress(OSError):  # the caller may close the connection earlier
        connection.sendall(said)
        connection.shutdown(socket.SHUT_WR)
        while connection.recv(MAX_BYTES):
            pass


Words = tuple[Any, ...]  # arguments of `FollowerConnection.say`


def _lines(*said: Words) -> bytes:
    """Return lines of JSON for messages."""
    found = []
    for kind, message, arrays in ((*words, None, ())[:3] for words in said):
        letter = None if message is None else payload_of(message)
        size = sum(array.nbytes for array in arrays or ())
        found.append(json.dumps([kind, letter, size]))
    return "\n".join(found).encode()


def _frames(*said: Words) -> bytes:
    """Return the bytes that a connection sends for messages."""
    ours, theirs = socket.socketpair()
    line = FollowerConnection(ours, "nobody")
    for words in said:
        line.say(*words)
    line.close()
    with theirs, theirs.makefile("rb") as stream:
        return stream.read()


def _seeds() -> tuple[bytes, ...]:
    env = _env()
    hello = (Say.HELLO, Hello("a stack", list(AGENTS)))
    welcome = (Say.WELCOME, welcome_to(env, AGENTS, 12))
    ticked = (Say.TICKED, Ticked(False, "", 12))
    goodbye = (Say.GOODBYE,)

    own = ActorRequest("own", "cyclist", -40.0, -40.0, 0.0, rate_hz=20.0, rig=["imu"])
    other = ActorRequest("other", "bus", -40.0, -60.0, 0.0, size_m=[9.0, 2.0, 3.0], speed=2.0)
    bringing = (Say.HELLO, Hello("a lab", list(AGENTS), actors=[own, other]))
    pose = PoseView(0.05, -39.0, -40.0, 0.1, z=0.1, pitch=0.0, speed=1.0)
    given: dict[str, list[float] | int] = {"car_0": [0.25, -0.5], "car_1": [1.0, 0.0]}
    answer = (Say.CONTROL, Control(0, given, {"own": [pose]}))

    def control(frame: int, *given: list[float] | int) -> tuple[Say, Control]:
        return Say.CONTROL, Control(frame, dict(zip(AGENTS, given, strict=False)))

    def snapshot(frame: int, agents: Sequence[int], is_over: bool = False) -> Words:
        return Say.SNAPSHOT, *take_snapshot(env, agents, SnapshotTime(frame, 0, frame, is_over))

    both = [0.25, -0.5], [1.0, 0.0]
    stacks: tuple[tuple[Words, ...], ...] = (
        (hello, control(0, *both), control(1, *both)),
        (hello, (Say.TICK,), control(0, *both), control(0, *both), goodbye),
        (
            bringing,
            (Say.POSES, ActorPoses({"own": [PoseView(0.01, 1.0, 2.0, 0.3)]})),
            answer,
            goodbye,
        ),
    )
    worlds: tuple[tuple[Words, ...], ...] = (
        (welcome, ticked, snapshot(7, [0]), snapshot(8, [0, 1]), goodbye),
        (welcome, ticked, snapshot(0, [], True), goodbye),
        (welcome, (Say.TICKED, Ticked(False, "only the time master ticks", 12))),
        (welcome, ticked, (Say.REFUSAL, FollowerRefusal("too slow"))),
    )
    found = []
    for start, talks in ((STACK, stacks), (WORLD, worlds)):
        found += [start + _frames(*said) for said in talks]
        found += [start.lower() + _lines(*said) for said in talks]
    return tuple(found)


FOLLOWER = Target(_parse, _seeds)
