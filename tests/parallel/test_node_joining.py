"""Nodes that join a run from any machine: which nodes are accepted, and which bytes they send."""

from __future__ import annotations

import hashlib
import json
import os
import secrets
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import closing, suppress
from pathlib import Path
from typing import Any

import psutil
import pytest

from cavmarl import ConfigError, make_vec
from cavmarl.core.cache_folder import cache_dir
from cavmarl.core.errors import (
    MessageError,
    WorkerDeathError,
    WorkerError,
)
from cavmarl.env.vector import CavVectorEnv
from cavmarl.parallel.network.listener import MAX_CALLERS, Listener
from cavmarl.parallel.nodes import node_starters
from cavmarl.parallel.nodes.joining_nodes import ANYONE, JoiningNode, JoiningNodes
from cavmarl.parallel.nodes.link import Link
from cavmarl.parallel.nodes.node_files import WorldFile
from cavmarl.parallel.nodes.node_process import run_node
from cavmarl.parallel.nodes.node_starters import read_key
from cavmarl.parallel.nodes.zone_moves import moves_of
from tests.parallel.test_moving import RESTLESS, moves_per_round
from tests.parallel.test_nodes import over_nodes
from tests.support.actuated import actuated_grid
from tests.support.local_actors import FORKS, LocalActors
from tests.support.vec_runs import Make, drive, same
from tests.support.wires import Proxy, free_port, own_address

__all__ = ["moves_per_round"]

WANTED: dict[str, Any] = {"agents": 6, "background": 40, "max_cycles": 20}
KEY = secrets.token_hex(32)
WAIT_S = 60.0


def join(place: tuple[str, int], key: bytes, keeps_files: bool = False) -> None:
    """Run a node; with `keeps_files`, the node cannot read the files of the caller."""
    if keeps_files:
        found = WorldFile.found

        def kept(file: WorldFile) -> Path | None:
            return found(file._replace(path="/nowhere/" + Path(file.path).name))

        setattr(WorldFile, "found", kept)  # noqa: B010
    until_s = time.monotonic() + WAIT_S
    while time.monotonic() < until_s:
        with suppress(ConnectionRefusedError, EOFError, ConnectionResetError):
            run_node(place, key, ANYONE)
            return
        time.sleep(0.05)


class Crowd:
    """Nodes that the test starts itself, like a user on another machine."""

    def __init__(self) -> None:
        self.processes: list[Any] = []

    def call(self, place: tuple[str, int], num: int = 1, **more: Any) -> None:
        for _ in range(num):
            process = FORKS.Process(
                target=join, args=(place, KEY.encode()), kwargs=more, daemon=True
            )
            process.start()
            self.processes.append(process)

    def close(self) -> None:
        for process in self.processes:
            process.kill()
            process.join()


@pytest.fixture
def crowd() -> Iterator[Crowd]:
    with closing(Crowd()) as found:
        yield found


@pytest.fixture
def key_file(tmp_path: Path) -> Path:
    path = tmp_path / "run.key"
    path.touch(0o600)
    path.write_text(KEY + "\n")
    return path


@pytest.fixture(scope="module")
def undivided_run() -> Any:
    with closing(make_vec("grid4x4", **WANTED)) as vec:
        return drive(vec, steps=20)


def key_settings(key_file: Path, **more: Any) -> dict[str, Any]:
    return {"overrides": {"workers.key_file": str(key_file), **more}}


def outside_address() -> str:
    address = own_address()
    if address is None:
        pytest.skip("this machine has only its loopback address")
    return address


@pytest.mark.parametrize("is_elsewhere", [False, True])
def test_frames_between_machines_are_encrypted(
    make: Make, crowd: Crowd, key_file: Path, undivided_run: Any, is_elsewhere: bool
) -> None:
    """The sender of a damaged frame is lost, and a replayed handshake is refused."""
    address = outside_address() if is_elsewhere else "127.0.0.1"
    place = (address, free_port(address))
    wire = Proxy(place)
    crowd.call(place)
    crowd.call(wire.place, keeps_files=True)
    backend = "nodes:2@{}:{}".format(*place)
    vec = make("grid4x4", zones=4, backend=backend, **key_settings(key_file), **WANTED)
    said = bytes(wire.said) + b"".join(wire.heard)
    assert (b"grid4x4" in said) == (b"cavN" in said) == (not is_elsewhere)
    assert KEY.encode() not in said

    def spoil(step: int) -> None:
        if step == 12:
            wire.spoiler = bytes(100)

    assert same(drive(vec, steps=20, before=spoil), undivided_run)
    assert over_nodes(vec).pool.losses == 1
    said = bytes(wire.said) + b"".join(wire.heard)
    assert (b"cavN" in said) == (not is_elsewhere)
    assert KEY.encode() not in said
    joining_nodes = over_nodes(vec).pool.joining_nodes
    for heard in wire.heard:  # replay each handshake
        with socket.create_connection(place) as stranger, suppress(OSError):
            stranger.sendall(heard)
            for _ in range(3):
                joining_nodes.look(10.0)
            assert joining_nodes.ready == []
            assert stranger.recv(1 << 16)[:4] != b"cavN"
    assert over_nodes(vec).pool.losses == 1
    wire.close()


def test_a_node_that_joins_later_replaces_a_lost_one(
    make: Make, crowd: Crowd, key_file: Path
) -> None:
    place = ("127.0.0.1", free_port("127.0.0.1"))
    crowd.call(place, 2)
    one = make("grid4x4", **WANTED)
    vec = make(
        "grid4x4",
        zones=4,
        backend="nodes:2@{}:{}".format(*place),
        **key_settings(key_file),
        **WANTED,
    )
    worlds = over_nodes(vec)
    for each in (one, vec):
        each.reset(seed=3)
    os.kill(worlds.pool.pids[0], signal.SIGKILL)
    crowd.call(place)
    lost = step_alike(one, vec, lambda: bool(worlds.pool.replacements))
    assert (worlds.pool.losses, worlds.pool.recoveries, worlds.pool.replacements) == (1, 1, 1)
    assert worlds.pool.zones == [[0, 1], [2, 3]]
    os.kill(worlds.pool.pids[1], signal.SIGKILL)  # the node that remains takes over all zones
    step_alike(one, vec, lambda: worlds.pool.zones[1] == [])
    assert worlds.pool.zones == [[0, 1, 2, 3], []]
    assert lost > 1


def step_alike(one: CavVectorEnv, vec: CavVectorEnv, is_done: Callable[[], bool]) -> int:
    """Step both environments until `is_done()` and four steps more; return the number of steps."""
    until_s, steps, more = time.monotonic() + WAIT_S, 0, 5
    while more:
        assert time.monotonic() < until_s
        more -= is_done()
        actions = one.suggest_actions()
        for each in (one, vec):
            each.step(actions)
        steps += 1
        time.sleep(0.01)
    assert one.state_hash() == vec.state_hash()
    return steps


def test_a_lost_node_of_this_machine_is_restarted(make: Make) -> None:
    one, vec = (make("grid4x4", **WANTED, **more) for more in ({}, {"zones": 4, "nodes": 2}))
    worlds = over_nodes(vec)
    for each in (one, vec):
        each.reset(seed=3)
    os.kill(worlds.pool.pids[1], signal.SIGKILL)
    step_alike(one, vec, lambda: bool(worlds.pool.replacements))
    assert worlds.pool.zones == [[0, 1], [2, 3]]


@pytest.mark.parametrize("is_lost", [False, True])
def test_zones_that_move_to_another_node_change_no_result(
    make: Make, moves_per_round: list[int], is_lost: bool
) -> None:
    wanted = {"agents": 8, "background": 30, "max_cycles": 8}
    undivided_run = drive(make("town", **wanted), steps=20)
    vec = make("town", zones=4, nodes=3, overrides=RESTLESS, **wanted)

    def kill_in_step(step: int) -> None:
        if is_lost and step == 9:
            os.kill(over_nodes(vec).pool.pids[1], signal.SIGKILL)

    assert same(drive(vec, steps=20, before=kill_in_step), undivided_run)
    mover = over_nodes(vec).mover
    assert mover is not None
    assert mover.moves == sum(moves_per_round) > 0
    assert over_nodes(vec).pool.generation == sum(moves > 0 for moves in moves_per_round) + is_lost


def test_actors_of_ray_serve_as_nodes_and_are_replaced(
    make: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(node_starters, "RayActors", LocalActors)
    one = make("grid4x4", **WANTED)
    vec = make("grid4x4", zones=4, backend="ray:2", **WANTED)
    worlds = over_nodes(vec)
    for each in (one, vec):
        each.reset(seed=3)
    os.kill(worlds.pool.pids[0], signal.SIGKILL)
    step_alike(one, vec, lambda: bool(worlds.pool.replacements))
    assert worlds.pool.zones == [[0, 1], [2, 3]]


def test_a_node_that_two_other_nodes_cannot_reach_is_lost(
    make: Make, monkeypatch: pytest.MonkeyPatch, undivided_run: Any
) -> None:
    """Cut the connections of a node while its process runs."""
    wires: list[Proxy] = []
    take = JoiningNodes.take

    def through_a_wire(joining_nodes: JoiningNodes, number: int) -> tuple[JoiningNode, Link]:
        joining_node, link = take(joining_nodes, number)
        assert joining_node.place is not None
        wires.append(Proxy(joining_node.place))
        joining_node.place = wires[-1].place
        return joining_node, link

    monkeypatch.setattr(JoiningNodes, "take", through_a_wire)
    vec = make("grid4x4", zones=4, nodes=3, **WANTED)

    def cut(step: int) -> None:
        if step == 9:
            max(wires, key=lambda wire: len(wire.heard)).cut()

    assert same(drive(vec, steps=20, before=cut), undivided_run)
    assert over_nodes(vec).pool.losses == 1
    for wire in wires:
        wire.close()


def test_many_unknown_callers_do_not_disturb_a_run(make: Make, undivided_run: Any) -> None:
    vec = make("grid4x4", zones=4, nodes=2, **WANTED)
    worlds = over_nodes(vec)
    address, port = worlds.pool.joining_nodes.place.split(":")
    before = psutil.Process().num_fds()
    strangers: list[socket.socket] = []

    def call_often(step: int) -> None:
        for n in range(20):
            strangers.append(socket.create_connection((address, int(port))))
            if n % 2:
                strangers[-1].sendall(secrets.token_bytes(100))

    assert same(drive(vec, steps=20, before=call_often), undivided_run)
    assert worlds.pool.losses == 0
    assert psutil.Process().num_fds() <= before + len(strangers) + MAX_CALLERS
    for stranger in strangers:
        stranger.close()
    pids = worlds.pool.pids
    vec.close()
    assert psutil.Process().num_fds() < before
    assert not any(map(psutil.pid_exists, pids))


def test_a_caller_waits_for_nodes_up_to_a_limit(key_file: Path) -> None:
    port = free_port("127.0.0.1")
    limited = key_settings(key_file, **{"workers.join_timeout_s": 1.0})
    with closing(Listener("127.0.0.1", b"", port)):
        with pytest.raises(WorkerError, match=f"cannot listen on 127.0.0.1:{port}"):
            make_vec("grid4x4", zones=2, backend=f"nodes:2@127.0.0.1:{port}", **limited)
    with pytest.raises(WorkerError, match="0 of 2 nodes have joined at"):
        make_vec("grid4x4", zones=2, backend=f"nodes:2@127.0.0.1:{port}", **limited)


def test_a_missing_or_readable_key_file_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "key"
    with pytest.raises(ConfigError, match="openssl rand"):
        read_key(path)
    path.write_text("a" * 64)
    path.chmod(0o640)
    with pytest.raises(ConfigError, match="chmod 600"):
        read_key(path)
    path.chmod(0o600)
    assert read_key(path) == b"a" * 64
    path.write_text("a" * 31)
    with pytest.raises(ConfigError, match="31 of 32"):
        read_key(path)


def test_files_are_stored_by_their_content(tmp_path: Path) -> None:
    content = secrets.token_bytes(100)
    digest = hashlib.sha256(content).hexdigest()
    file = WorldFile("map.source", -1, "/nowhere/map.net.xml", digest)
    assert file.found() is None
    with pytest.raises(MessageError, match="another SHA-256 digest"):
        file.keep(content[:-1])
    file.keep(content)
    assert file.found() == cache_dir() / "files" / digest / "map.net.xml"
    file.kept.write_bytes(b"")
    assert file.found() is None
    file.kept.unlink()
    file.kept.parent.rmdir()
    with pytest.raises(MessageError, match="not an SHA-256 digest"):
        _ = file._replace(digest="../../x").kept


def test_a_node_can_be_started_from_the_command_line(
    make: Make, key_file: Path, tmp_path: Path
) -> None:
    net = actuated_grid(tmp_path)
    port = free_port("127.0.0.1")
    words = ["node", "--join", f"127.0.0.1:{port}", "--key-file", str(key_file)]
    process = subprocess.Popen(
        [sys.executable, "-m", "cavmarl", *words], stdout=subprocess.PIPE, text=True
    )
    vec = make(
        net, zones=2, backend=f"nodes:1@127.0.0.1:{port}", **key_settings(key_file), agents=2
    )
    vec.reset(seed=1)
    vec.close()
    said, _ = process.communicate(timeout=WAIT_S)
    assert said.endswith("the caller has ended\n")
    assert process.returncode == 0


def test_zones_are_assigned_to_living_nodes_after_losses_and_joins() -> None:
    first = [[0, 1], [2], [3, 4]]
    found = moves_of(first, first, lost=[1], living=[0, 2], state=1)
    assert found.zones == [[0, 1], [], [2, 3, 4]]
    assert found.heirs == {1: 2}
    again = moves_of(found.zones, first, lost=[], living=[0, 1, 2], state=2)
    assert again.zones == first
    assert again.donors == [(2, 1)]
    with pytest.raises(WorkerDeathError, match="zones 2; zones 3, 4") as caught:
        moves_of(first, first, lost=[1, 2], living=[0], state=1)
    assert "make the environment again" in str(caught.value)
    assert "SIGKILL" not in str(caught.value)  # there is no evidence that a process was killed
    assert json.dumps(again)  # nodes get the moves as JSON
