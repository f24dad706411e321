"""A network simulator coupled with the world: a barrier in each tick, and checked answers."""

from __future__ import annotations

import queue
import threading
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from cavmarl.core.errors import ConfigError, MessageError
from cavmarl.v2x.kernels.v2x_records import KIND_CAM
from cavmarl.v2x.v2x_messages import RECEPTION, Exchange, messages_of
from tests.v2x.station_worlds import Standing

PLACES = np.array([[100.0, 100.0], [120.0, 100.0], [150.0, 100.0], [200.0, 100.0]])
EXTERNAL = {"channel__external": True, "channel__latency_ticks": 3}


class Federate:
    """A fake network simulator in its own thread with its own clock.

    It delivers each packet to all receivers except the sender, after `delay(sender)` ticks.
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
        return self._answers.get()  # the simulator waits at the barrier

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


def test_world_and_simulator_advance_together_and_packets_are_delayed() -> None:
    world = Standing(2, cam__rate_hz=10.0, **EXTERNAL)
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


def test_the_order_of_an_answer_does_not_matter() -> None:
    said = []
    for turn in (1, -1):
        world = Standing(2, inbox__objects=1, **EXTERNAL)

        class Everything:
            def __init__(self, turn: int) -> None:
                self.turn = turn

            def exchange(self, sent: Exchange) -> NDArray[np.void]:
                pairs = [(sent.tick, n, r) for n in range(len(sent.packets)) for r in range(2)]
                return np.array(pairs[:: self.turn], dtype=RECEPTION)

        world.bus.connect(Everything(turn))
        world.put(PLACES)
        for _ in range(3):
            world.tick()
        said.append(world.bus.mail.objects.tobytes())
        assert world.bus.mail.objects[0, 0, 0]["sender"] == 1
    assert said[0] == said[1]


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
def test_invalid_answers_are_refused(reception: tuple[int, int, int], words: str) -> None:
    world = Standing(2, **EXTERNAL)

    class Liar:
        def exchange(self, sent: Exchange) -> NDArray[np.void]:
            return np.array([reception], dtype=RECEPTION)

    world.bus.connect(Liar())
    world.put(PLACES)
    with pytest.raises(MessageError, match=words):
        world.tick()


def test_invalid_arrays_and_a_missing_simulator_are_refused() -> None:
    world = Standing(2, **EXTERNAL)
    world.put(PLACES)
    with pytest.raises(ConfigError, match="connect a network simulator"):
        world.tick()

    class Wordy:
        def exchange(self, sent: Exchange) -> Any:
            return [(1, 0, 0)]

    world.bus.connect(Wordy())
    with pytest.raises(MessageError, match="dtype RECEPTION"):
        world.tick()
    with pytest.raises(ConfigError, match="external is off"):
        Standing(2).bus.connect(Wordy())
