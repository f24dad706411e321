"""External network simulators: synchronization in each tick, and checks of their answers."""

from __future__ import annotations

import queue
import threading
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from cavmarl.core.errors import ConfigError, MessageError
from cavmarl.v2x.kernels.v2x_records import KIND_CAM, KIND_SPAT
from cavmarl.v2x.v2x_messages import RECEPTION, Exchange, messages_of
from tests.v2x.station_worlds import StationWorld

PLACES = np.array([[100.0, 100.0], [120.0, 100.0], [150.0, 100.0], [200.0, 100.0]])
EXTERNAL = {"channel__external": True, "channel__latency_ticks": 3}


class Federate:
    """A fake network simulator with its own thread and clock.

    Each packet reaches all receivers except its sender after `delays[sender]` ticks.
    """

    def __init__(self, delays: dict[int, int]) -> None:
        self._delays = delays
        self._asked: queue.Queue[tuple[int, NDArray[Any], NDArray[Any]] | None] = queue.Queue()
        self._answers: queue.Queue[NDArray[Any]] = queue.Queue()
        self._pending: list[tuple[int, int, int, int]] = []
        self.clock = 0
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def exchange(self, sent: Exchange) -> NDArray[np.void]:
        self._asked.put((sent.tick, sent.packets.copy(), sent.receivers.copy()))
        return self._answers.get()  # the world waits for the answer

    def _run(self) -> None:
        while (asked := self._asked.get()) is not None:
            tick, packets, receivers = asked
            while self.clock < tick:
                self.clock += 1
            for number, packet in enumerate(packets):
                due = tick + self._delays.get(int(packet["sender"]), 0)
                self._pending += [
                    (due, tick, number, row)
                    for row, receiver in enumerate(receivers)
                    if receiver["id"] != packet["sender"]
                ]
            now = [(sent, number, row) for due, sent, number, row in self._pending if due == tick]
            self._pending = [entry for entry in self._pending if entry[0] > tick]
            self._answers.put(np.array(now[::-1], dtype=RECEPTION))

    def end(self) -> None:
        self._asked.put(None)
        self._thread.join()


def test_the_simulator_has_the_tick_of_the_world_and_delays_packets() -> None:
    world = StationWorld(2, cam__rate_hz=10.0, **EXTERNAL)
    federate = Federate({1: 2, 2: 0, 3: 3})
    world.bus.connect(federate)
    world.put(PLACES)
    heard = []
    for _ in range(5):
        tick = world.tick()
        assert federate.clock == tick
        cams = messages_of(KIND_CAM, world.bus.mail.objects[0, 0])
        heard.append({int(cam["sender"]): tick - int(cam["tick"]) for cam in cams})
    federate.end()
    assert heard[0] == {2: 0}
    assert heard[1] == {2: 0}
    assert heard[2] == {1: 2, 2: 0}
    assert heard[3] == heard[4] == {1: 2, 2: 0, 3: 3}
    statistics = world.bus.statistics()
    assert statistics.delays[:4].tolist() == [5 + 5 + 5, 0, 3, 2 * 2]
    assert statistics.mean_latency_s == pytest.approx(0.1 * (2 * 3 + 3 * 4) / 22)


class ReceiveAll:
    """A fake network simulator that delivers each packet at once to the two agents."""

    def __init__(self, turn: int = 1) -> None:
        self.turn = turn

    def exchange(self, sent: Exchange) -> NDArray[np.void]:
        pairs = [(sent.tick, n, r) for n in range(len(sent.packets)) for r in range(2)]
        return np.array(pairs[:: self.turn], dtype=RECEPTION)


def test_results_do_not_depend_on_the_order_of_receptions() -> None:
    said = []
    for turn in (1, -1):
        world = StationWorld(2, inbox__objects=1, **EXTERNAL)
        world.bus.connect(ReceiveAll(turn))
        world.put(PLACES)
        for _ in range(3):
            world.tick()
        said.append(world.bus.mail.objects.tobytes())
        assert world.bus.mail.objects[0, 0, 0]["sender"] == 1
    assert said[0] == said[1]


def test_a_vehicle_receives_the_phase_of_the_signal_whose_row_equals_its_id() -> None:
    units = {"roadside__signals": ["all"], "roadside__rate_hz": 10.0, "inbox__signals": 16}
    world = StationWorld(2, **units, **EXTERNAL)
    world.bus.connect(ReceiveAll())
    world.put(PLACES)
    world.tick()
    assert len(world.simulation.network.signals) == 16
    for agent in range(2):
        told = messages_of(KIND_SPAT, world.bus.mail.signals[0, agent])["signal"]
        assert sorted(told.tolist()) == list(range(16))


@pytest.mark.parametrize(
    ("reception", "words"),
    [
        ((-4, 0, 0), "has a tick outside 1 to 1"),
        ((2, 0, 0), "has a tick outside"),
        ((1, 99, 0), "not sent"),
        ((1, -1, 0), "not sent"),
        ((1, 0, 2), "by an unknown receiver"),
    ],
)
def test_invalid_receptions_are_refused(reception: tuple[int, int, int], words: str) -> None:
    world = StationWorld(2, **EXTERNAL)

    class InvalidReception:
        def exchange(self, sent: Exchange) -> NDArray[np.void]:
            return np.array([reception], dtype=RECEPTION)

    world.bus.connect(InvalidReception())
    world.put(PLACES)
    with pytest.raises(MessageError, match=words):
        world.tick()


def test_a_wrong_type_of_answer_and_a_missing_simulator_are_refused() -> None:
    world = StationWorld(2, **EXTERNAL)
    world.put(PLACES)
    with pytest.raises(ConfigError, match="connect a network simulator"):
        world.tick()

    class ListAnswer:
        def exchange(self, sent: Exchange) -> Any:
            return [(1, 0, 0)]

    world.bus.connect(ListAnswer())
    with pytest.raises(MessageError, match="dtype RECEPTION"):
        world.tick()
    with pytest.raises(ConfigError, match="external is off"):
        StationWorld(2).bus.connect(ListAnswer())
