"""`cavmarl.show`: web pages show the environment of a running program, notebook or evaluation."""

from __future__ import annotations

import json
import os
import struct
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest
from websockets.sync.client import ClientConnection, connect

import cavmarl
from cavmarl.balance.load_score import Candidate, Utilisation
from cavmarl.balance.load_snapshot import LoadSnapshot
from cavmarl.core.errors import ConfigError
from cavmarl.env.vector import CavVectorEnv, make_vec
from cavmarl.evaluate import evaluate
from cavmarl.viewer.live_env import ShownEnv
from cavmarl.viewer.run_loads import load_rows
from cavmarl.viewer.web_options import WebOptions
from tests.viewer.test_web_server import ended_with, first_of


@contextmanager
def joined(address: str, world: int = 0) -> Iterator[ClientConnection]:
    with connect(address.replace("http", "ws") + "live", max_size=2**24) as client:
        client.send(json.dumps({"kind": "hello", "world": world}))
        yield client


def until_watched(shown: ShownEnv, world: int = 0) -> None:
    end = time.monotonic() + 20.0
    while not shown.audiences[world].wishes.watchers and time.monotonic() < end:
        time.sleep(0.01)


def tick_of(client: Any) -> int:
    return int(struct.unpack_from("<I", first_of(client, 3), 16)[0])


@pytest.fixture
def vec() -> Any:
    made = make_vec("ring", num_envs=3, agents=2, background=2)
    yield made
    made.close()


def test_a_page_shows_the_world_that_it_asks_for(
    vec: CavVectorEnv, monkeypatch: pytest.MonkeyPatch
) -> None:
    vec.reset(seed=0)
    with cavmarl.show(vec, port=0) as shown, joined(shown.address, world=2) as client:
        hello = first_of(client, "hello")
        assert hello["worlds"] == ["world 0", "world 1", "world 2"]
        assert (hello["world"], hello["control"]) == (2, False)
        assert "reset" not in hello["may"]
        until_watched(shown, 2)
        for _ in range(4):
            vec.step(vec.suggest_actions())
            time.sleep(0.06)
        ticks = vec.config.clock.ticks_per_step
        assert tick_of(client) % ticks == 0
        assert shown.publishers[0].published == 0
    monkeypatch.setattr(shown, "turn", None)
    vec.step(vec.suggest_actions())  # after the `with` block, a step must not call `turn`


def test_showing_a_world_does_not_change_it() -> None:
    hashes = []
    for is_shown in (True, False):
        vec = make_vec("ring", num_envs=1, agents=2, background=2)
        vec.reset(seed=4)
        with ExitStack() as stack:
            if is_shown:
                shown = stack.enter_context(cavmarl.show(vec, port=0))
                stack.enter_context(joined(shown.address))
                until_watched(shown)
            for _ in range(20):
                vec.step(vec.suggest_actions())
            hashes.append(vec.state_hash(0))
        vec.close()
    assert hashes[0] == hashes[1]


def test_a_page_with_control_pauses_the_program(vec: CavVectorEnv) -> None:
    vec.reset(seed=0)
    with cavmarl.show(vec, port=0, control=True) as shown, joined(shown.address) as client:
        first_of(client, 1)
        client.send('{"kind": "pause"}')
        time.sleep(0.3)
        done = threading.Event()

        def step() -> None:
            vec.step(vec.suggest_actions())
            done.set()

        threading.Thread(target=step, daemon=True).start()
        assert not done.wait(0.7)
        client.send('{"kind": "play"}')
        assert done.wait(10.0)


def test_an_unknown_world_is_refused(vec: CavVectorEnv) -> None:
    with cavmarl.show(vec, port=0) as shown:
        for world in (3, -1, True, "0", None):
            with connect(shown.address.replace("http", "ws") + "live") as client:
                client.send(json.dumps({"kind": "hello", "world": world}))
                assert ended_with(client) == (1003, "no such world: must be from 0 to 2")


def test_a_notebook_on_this_machine_can_embed_the_page(vec: CavVectorEnv) -> None:
    with cavmarl.show(vec, port=0) as shown:
        assert shown.address in shown._repr_html_()  # before the first reset
        vec.reset(seed=0)
        vec.step(vec.suggest_actions())
        assert "<iframe" in shown._repr_html_()
        with joined(shown.address) as client:  # no further step is needed
            assert tick_of(client) == vec.config.clock.ticks_per_step
        policy = httpx.get(shown.address).headers["content-security-policy"]
        assert "frame-ancestors 'self' http://127.0.0.1:* http://localhost:* vscode" in policy
        assert "unsafe" not in policy
        port = int(shown.address.split(":")[2].strip("/"))
        with cavmarl.show(vec, port=port) as again, joined(again.address):
            assert again.address == shown.address


def test_watching_an_evaluation_does_not_change_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(CavVectorEnv, "watch", None)  # not needed with `looks_itself=False`
    keys: dict[str, Any] = {"agents": 2, "background": 2, "overrides": {"horizon_s": 5.0}}
    looks: list[int] = []

    def watcher(vec: CavVectorEnv) -> Any:
        shown = ShownEnv(vec, WebOptions(port=0, control=False), looks_itself=False)

        def look() -> None:
            shown.look()
            looks.append(int(vec.worlds.ticks()[0]))
            if len(looks) == 5:
                shown.close()

        return look

    watched = evaluate("ring", "idm", episodes=2, watcher=watcher, **keys)
    alone = evaluate("ring", "idm", episodes=2, **keys)
    assert len(looks) > 10
    assert watched["idm"]["duration_s"] == alone["idm"]["duration_s"]
    with pytest.raises(ConfigError, match="repeats = 2 with a watcher"):
        evaluate("ring", "idm", episodes=1, repeats=2, watcher=watcher, **keys)


def test_load_rows_have_the_zones_and_the_score_of_each_worker() -> None:
    vec = make_vec("grid4x4", num_envs=1, zones=2, workers=2, agents=1, background=2)
    try:
        vec.reset(seed=0)
        pids = vec.worlds.worker_pids
        assert sorted(pids) == [0, 1]
        assert os.getpid() not in pids.values()
        busy = Candidate(0, Utilisation(0.5, 0.25, 0.0))
        gone = Candidate(1, Utilisation(1.0, 0.25, 0.0), available=False)
        rows = load_rows(pids, LoadSnapshot((busy, gone), "none", "measured"), vec.plans)
        assert [row["zones"] for row in rows] == ["0", "1"]
        assert rows[0]["score"] == pytest.approx(0.6 * 0.5 + 0.2 * 0.25)
        assert (rows[1]["score"], rows[1]["note"]) == (None, "gone")
    finally:
        vec.close()
    assert np.all([not Path(f"/proc/{pid}").exists() for pid in pids.values()])
