"""A network simulator in the caller: worlds over nodes get the receptions of one process."""

from __future__ import annotations

import os
import signal
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from cavmarl import ConfigError, make_vec
from cavmarl.core.errors import MessageError
from cavmarl.env.vector import CavVectorEnv
from cavmarl.parallel.nodes.node_network import read_request, request_of
from cavmarl.parallel.nodes.node_worlds import NodeWorlds
from cavmarl.v2x.kernels.v2x_records import PACKET, RECEIVER
from cavmarl.v2x.v2x_messages import RECEPTION, Exchange
from tests.support.vec_runs import Make, drive, same

EXTERNAL = {"v2x.enabled": True, "v2x.channel.external": True, "v2x.channel.latency_ticks": 2}
WANTED: dict[str, Any] = {"env": "grid4x4", "agents": 6, "background": 30, "max_cycles": 10}


class DelayedNetwork:
    """A network simulator that delivers packets after 0 to 2 ticks and counts its calls."""

    def __init__(self) -> None:
        self.calls = 0
        self._due: dict[tuple[int, int], list[tuple[int, int, int]]] = {}

    def exchange(self, sent: Exchange) -> NDArray[np.void]:
        self.calls += 1
        if sent.tick == 1:
            self._due = {key: due for key, due in self._due.items() if key[0] != sent.world}
        for n, packet in enumerate(sent.packets):
            for r in np.flatnonzero(sent.receivers["id"] >= 0).tolist():
                late = int(packet["sender"] + r + sent.tick) % 4
                if late < 3:
                    due = self._due.setdefault((sent.world, sent.tick + late), [])
                    due.append((sent.tick, n, r))
        return np.array(self._due.pop((sent.world, sent.tick), []), dtype=RECEPTION)


def with_network(make: Make, network: Any, **more: Any) -> CavVectorEnv:
    vec = make(**{**WANTED, **more, "overrides": EXTERNAL | more.get("overrides", {})})
    vec.worlds.connect_network(network)
    return vec


def over_nodes(vec: CavVectorEnv) -> NodeWorlds:
    assert isinstance(vec.worlds, NodeWorlds)
    return vec.worlds


@pytest.mark.parametrize("more", [{"num_envs": 2}, {"overrides": {"zones.repartition_steps": 3}}])
def test_receptions_equal_those_of_one_process(make: Make, more: dict[str, Any]) -> None:
    here, there = DelayedNetwork(), DelayedNetwork()
    alone = {**more, "overrides": {}}
    whole = drive(with_network(make, here, **alone))
    assert same(drive(with_network(make, there, zones=4, nodes=3, **more)), whole)
    assert here.calls == there.calls > 20
    silent = drive(with_network(make, SilentNetwork(), **alone))
    assert not same(silent, whole)


class SilentNetwork:
    """A network simulator that delivers no packet."""

    def exchange(self, sent: Exchange) -> NDArray[np.void]:
        return np.zeros(0, RECEPTION)


def test_a_repeated_step_does_not_ask_the_simulator_again(make: Make) -> None:
    here, there = DelayedNetwork(), DelayedNetwork()
    whole = drive(with_network(make, here), steps=20)
    vec = with_network(make, there, zones=4, nodes=3)
    worlds = over_nodes(vec)

    def kill_in_step(step: int) -> None:
        if step in (4, 11):
            os.kill(worlds.pool.pids[0 if step == 4 else 1], signal.SIGKILL)

    assert same(drive(vec, steps=20, before=kill_in_step), whole)
    assert worlds.pool.losses == 2
    assert here.calls == there.calls


class FailingNetwork(DelayedNetwork):
    """A network simulator that fails at call `at`, and does not count that call."""

    def __init__(self, at: int, how: Exception | NDArray[Any]) -> None:
        super().__init__()
        self._at, self._how = at, how

    def exchange(self, sent: Exchange) -> NDArray[np.void]:
        if self.calls == self._at:
            self._at = -1
            if isinstance(self._how, Exception):
                raise self._how
            return self._how
        return super().exchange(sent)


@pytest.mark.parametrize(
    ("how", "error", "words"),
    [
        (OSError("it is gone"), OSError, "it is gone"),
        (KeyError("a bug"), KeyError, "a bug"),
        (np.array([(9, 0, 0)], RECEPTION), MessageError, "has a tick outside"),
        (np.zeros(3), MessageError, "dtype RECEPTION"),
    ],
)
def test_a_failing_simulator_loses_no_node(
    make: Make, how: Any, error: type[Exception], words: str
) -> None:
    vec = with_network(make, FailingNetwork(0, how), zones=2, nodes=2)
    alone = with_network(make, DelayedNetwork())
    for one in (vec, alone):
        one.reset(seed=3)
    actions = alone.suggest_actions()
    with pytest.raises(error, match=words):
        vec.step(actions)
    for _ in range(4):
        actions = alone.suggest_actions()
        for one in (vec, alone):
            one.step(actions)
        assert vec.state_hash() == alone.state_hash()
    assert over_nodes(vec).pool.losses == 0


def test_a_network_simulator_is_refused_where_it_cannot_be_used(make: Make) -> None:
    vec = make(**WANTED, zones=2, nodes=2, overrides=EXTERNAL)
    vec.reset(seed=1)
    with pytest.raises(ConfigError, match="connect a network simulator before the first step"):
        vec.step(vec.suggest_actions())
    vec.worlds.connect_network(DelayedNetwork())
    vec.step(vec.suggest_actions())
    own = make(**WANTED, zones=2, nodes=2, overrides={"v2x.enabled": True})
    with pytest.raises(ConfigError, match="external is off"):
        own.worlds.connect_network(DelayedNetwork())
    with pytest.raises(ConfigError, match="use backend='local', or nodes"):
        make_vec("grid4x4", workers=1, overrides=EXTERNAL)


def test_requests_to_the_network_simulator_are_sent_without_changes() -> None:
    packets, receivers = np.zeros(3, PACKET), np.zeros(2, RECEIVER)
    packets["sender"], receivers["id"] = [4, 5, 6], [7, -1]
    pieces = request_of(Exchange(1, 12, packets, receivers), np.array([3, 0, 2]))
    data = memoryview(b"".join(map(bytes, pieces)))
    sent, num_packets = read_request(data, 2, 2)
    assert (sent.world, sent.tick, num_packets.tolist()) == (1, 12, [3, 0, 2])
    assert sent.packets.tobytes() == packets.tobytes()
    assert sent.receivers.tobytes() == receivers.tobytes()
    for worlds, cut in ((1, len(data)), (2, len(data) - 1), (2, 20)):
        with pytest.raises(MessageError, match="an exchange"):
            read_request(data[:cut], worlds, 2)
