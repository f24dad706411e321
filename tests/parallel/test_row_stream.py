"""Ghosts and agents arrive at another node unchanged, after any changes of rows."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from cavmarl import make_vec
from cavmarl.core.errors import MessageError
from cavmarl.core.records.arrays import ZoneState
from cavmarl.core.records.codes import COUNT_REROUTED
from cavmarl.driving.vehicles import VEHICLE
from cavmarl.parallel.nodes.agent_stream import AgentStream
from cavmarl.parallel.nodes.row_stream import RowStream, forecast_of, passing_of
from cavmarl.shards.shard import make_zone_state
from cavmarl.traffic.departure_queue import make_departure_queue
from tests.support.traffic import network

CAPACITY = 40
WORLDS = 2
ROOM = 6  # capacity for vehicles that go to the departure queue of another node
ROADS = network("merge")
MINE, THEIRS = np.array([0]), np.array([1, 2])
GHOSTS = 1 + 3 * WORLDS  # index of the first word with a number of ghosts
LIKE = GHOSTS + 2 * WORLDS * len(THEIRS)  # index of the first word that says how a ghost is encoded


class Node:
    """The zone states and the row stream of one of two nodes."""

    def __init__(self, zones: NDArray[np.int64], others: NDArray[np.int64]) -> None:
        self.zoned = make_zone_state(3, WORLDS, CAPACITY)
        self.departures = make_departure_queue(WORLDS, ROOM, ROADS.arrays, VEHICLE)
        self.running = np.zeros(WORLDS, dtype=np.int64)
        self.rerouted = np.zeros(WORLDS, dtype=np.int64)
        law = forecast_of(ROADS.arrays, 0.05, 1, *2 * [np.empty((0, 4), dtype=np.int64)])
        self._frames = RowStream(self.zoned, zones, others, self.running, self.rerouted, law)

    def packed(self) -> bytearray:
        return bytearray(self._frames.packed(1, passing_of(self.departures)))

    def read(self, data: bytes | bytearray) -> None:
        self._frames.read(memoryview(data), 1, passing_of(self.departures))


def nodes() -> tuple[Node, Node]:
    """Return a node of zone 0, and a node of zones 1 and 2."""
    return Node(MINE, THEIRS), Node(THEIRS, MINE)


def fill(zoned: ZoneState, drawn: np.random.Generator, ids: NDArray[np.int64]) -> None:
    """Fill the zones with ghosts of these vehicles in random order.

    Most words of a vehicle's row are equal in each call, so the stream need not send them.
    """
    for zone in THEIRS.tolist():
        for w in range(WORLDS):
            chosen = drawn.permutation(ids)[: drawn.integers(len(ids) + 1)]
            num = len(chosen)
            rows = np.zeros(num, dtype=zoned.rows.dtype)
            rows["id"] = chosen
            rows["x"] = chosen + 0.5
            rows["speed"] = drawn.integers(3)
            rows["heading"] = drawn.choice([-0.0, 0.0])
            zoned.rows[1, zone, w, :num] = rows
            step = np.repeat(chosen, zoned.step.itemsize // 8)
            zoned.step[zone, w, :num] = step.view(zoned.step.dtype)
            zoned.step_at[zone, w, :num] = chosen % 9
            zoned.num_rows[zone, w] = num
            zoned.num_near[zone, w] = drawn.integers(num + 1)


def clear(zoned: ZoneState) -> None:
    """Remove all ghosts, as at the start of a tick, and keep two owned rows per zone."""
    zoned.num_owned[THEIRS] = 2
    zoned.num_rows[THEIRS] = zoned.num_near[THEIRS] = 2


def ghosts_of(zoned: ZoneState, first: int) -> list[list[bytes]]:
    """Return the sorted ghosts of each zone and world: near ghosts, then other ghosts."""
    parts = []
    for zone in THEIRS.tolist():
        for w in range(WORLDS):
            near, num = zoned.num_near.item(zone, w), zoned.num_rows.item(zone, w)
            for some in (range(first, near), range(near, num)):
                parts.append(
                    sorted(
                        zoned.rows[1, zone, w, i].tobytes()
                        + zoned.step[zone, w, i].tobytes()
                        + zoned.step_at[zone, w, i].tobytes()
                        for i in some
                    )
                )
    return parts


def leave(node: Node, drawn: np.random.Generator) -> None:
    """Let random vehicles leave the node, and random numbers of vehicles change their routes."""
    departures = node.departures
    departures.num_passing[:] = drawn.integers(ROOM // 2 + 1, size=WORLDS)
    departures.passing["id"] = drawn.integers(1000, size=departures.passing.shape)
    departures.counts[:, COUNT_REROUTED] += drawn.integers(3, size=WORLDS)


def test_received_ghosts_equal_sent_ghosts() -> None:
    near, far = nodes()
    drawn = np.random.default_rng(1)
    for tick in range(30):
        fill(near.zoned, drawn, np.arange(tick, tick + 30))
        leave(near, drawn)
        near.zoned.num_owned[MINE] = tick, 7
        clear(far.zoned)
        far.running[:] = 100
        first = far.departures.num_passing[:] = drawn.integers(ROOM // 2 + 1, size=WORLDS)
        counted = far.departures.counts[:, COUNT_REROUTED].copy()
        far.read(near.packed())
        assert ghosts_of(far.zoned, 2) == ghosts_of(near.zoned, 0)
        assert far.running.tolist() == [100 + tick, 107]
        more = near.departures.counts[:, COUNT_REROUTED] - near.rerouted
        assert (far.departures.counts[:, COUNT_REROUTED] - counted == more).all()
        near.rerouted[:] = near.departures.counts[:, COUNT_REROUTED]
        for w, num in enumerate(near.departures.num_passing.tolist()):
            assert far.departures.num_passing[w] == first[w] + num
            sent = far.departures.passing[w, first[w] : first[w] + num]
            assert sent.tobytes() == near.departures.passing[w, :num].tobytes()


def test_words_that_the_receiver_can_forecast_are_not_sent() -> None:
    """After the first tick, a moving vehicle needs only a few words, such as its acceleration."""
    near, far = nodes()
    vec = make_vec("merge", agents=1, background=20, overrides={"clock.ctrl_dt_s": 0.05}, seed=0)
    vec.reset()
    simulation = vec.simulation
    zone, sizes, ghosts = int(THEIRS[0]), [], 0
    for _ in range(40):
        vec.step(np.zeros_like(vec.suggest_actions()))
        zoned, side = simulation.shards[0].zoned, simulation.division.side
        ghosts = zoned.num_owned.item(0, 0)
        near.zoned.rows[1, zone, 0, :ghosts] = zoned.rows[side, 0, 0, :ghosts]
        near.zoned.step[zone, 0, :ghosts] = zoned.step[0, 0, :ghosts]
        near.zoned.num_rows[zone, 0] = near.zoned.num_near[zone, 0] = ghosts
        clear(far.zoned)
        data = near.packed()
        far.read(data)
        assert ghosts_of(far.zoned, 2) == ghosts_of(near.zoned, 0)
        sizes.append((len(data) // 8 - LIKE) / ghosts - 2)
    vec.close()
    assert sizes[0] > VEHICLE.itemsize // 8
    assert np.median(sizes) < 4, "too many words per vehicle"


def damage(words: NDArray[np.int64], harm: str) -> NDArray[np.int64]:
    """Return a frame in which no vehicle leaves, damaged as `harm` says."""
    ghosts = int(words[GHOSTS:LIKE:2].sum())
    if harm == "cut short":
        return words[:-1]
    if harm == "one additional word":
        words = np.append(words, 0)
    elif harm == "first ghost without a predecessor":
        words[LIKE] = 0
    elif harm == "part of a ghost without a predecessor":
        words[LIKE + ghosts] = 0
    elif harm == "more ghosts than the capacity":
        words[GHOSTS] = CAPACITY - 1
    elif harm == "negative number of ghosts":
        words[GHOSTS] = -1
    elif harm == "more near ghosts than ghosts":
        words[GHOSTS + 1] = words[GHOSTS] + 1
    elif harm == "more leaving vehicles than the capacity":
        words[1 + 2 * WORLDS] = ROOM + 1
        words = np.concatenate([words, np.zeros(7 * (ROOM + 1), dtype=np.int64)])
    elif harm == "negative number of leaving vehicles":
        words[1 + 2 * WORLDS] = -1
    elif harm == "negative number of route changes":
        words[1 + WORLDS] = -1
    else:
        return words[:0]
    words[0] = len(words)
    return words


@pytest.mark.parametrize(
    "harm",
    [
        "empty frame",
        "cut short",
        "one additional word",
        "first ghost without a predecessor",
        "part of a ghost without a predecessor",
        "more ghosts than the capacity",
        "negative number of ghosts",
        "more near ghosts than ghosts",
        "more leaving vehicles than the capacity",
        "negative number of leaving vehicles",
        "negative number of route changes",
    ],
)
def test_bad_frames_are_refused(harm: str) -> None:
    near, far = nodes()
    fill(near.zoned, np.random.default_rng(3), np.arange(30))
    data = damage(np.frombuffer(near.packed(), np.int64).copy(), harm).tobytes()
    clear(far.zoned)
    with pytest.raises(MessageError, match=f"^{len(data)} bytes are no"):
        far.read(data)
    assert (far.zoned.num_rows[THEIRS] == 2).all(), "a part of the frame was used"
    assert not far.departures.num_passing.any()
    assert not far.departures.counts.any()


def tables(num: int) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    return np.zeros((WORLDS, num, 3), dtype=np.float32), np.zeros((WORLDS, num), dtype=np.bool_)


def packed(here: Sequence[NDArray[Any]], mine: NDArray[np.bool_]) -> memoryview:
    own, everywhere = np.zeros((WORLDS, 4), dtype=np.bool_), np.ones(WORLDS, dtype=np.bool_)
    owner = np.full(8, 7, dtype=np.int32)
    told = AgentStream(here).packed(mine.reshape(WORLDS, 4), everywhere, 2, own, owner)
    assert (own.reshape(-1) == mine).all()
    assert (owner == np.where(mine, 2, -1)).all()
    return memoryview(told)


def test_received_agents_equal_sent_agents() -> None:
    here, there = tables(4), tables(4)
    drawn = np.random.default_rng(4)
    here[0][...], here[1][...] = drawn.random((WORLDS, 4, 3)), True
    mine = np.array([True, False, False, True, False, False, True, False])
    owner = np.full(8, -1, dtype=np.int32)
    agents = AgentStream(there).read(packed(here, mine), 5, owner)
    assert agents.tolist() == np.flatnonzero(mine).tolist()
    assert owner.tolist() == [5, -1, -1, 5, -1, -1, 5, -1]
    for sent, taken in zip(here, there, strict=True):
        flat, other = (array.reshape(8, -1) for array in (sent, taken))
        assert (other[mine] == flat[mine]).all()
        assert not other[~mine].any()


@pytest.mark.parametrize("change", [b"", bytes(4), (1).to_bytes(8, "little"), None])
def test_bad_frames_about_agents_are_refused(change: bytes | None) -> None:
    here, there = tables(4), tables(4)
    data = bytearray(packed(here, np.ones(8, dtype=np.bool_)))
    if change is None:
        data[8:16] = (8).to_bytes(8, "little")  # valid agents are 0 to 7
    owner = np.full(8, -1, dtype=np.int32)
    with pytest.raises(MessageError, match="not a frame about agents"):
        AgentStream(there).read(memoryview(data if change is None else change), 5, owner)
    assert (owner == -1).all()


@pytest.mark.parametrize("taken", [2, 3])
def test_a_frame_with_a_repeated_or_foreign_agent_is_refused(taken: int) -> None:
    """Change a frame so that it names an agent twice, or an agent of another node."""
    here, there = tables(4), tables(4)
    mine = np.array([False, False, True, True, False, False, False, False])
    owner = np.full(8, -1, dtype=np.int32)
    data = bytearray(packed(here, mine))
    if taken == 2:
        data[16:24] = data[8:16]
    else:
        owner[3] = 1
    with pytest.raises(MessageError, match="agents of other nodes, or an agent twice"):
        AgentStream(there).read(memoryview(data), 5, owner)


def test_an_agent_flag_that_is_neither_true_nor_false_is_refused() -> None:
    here, there = tables(4), tables(4)
    data = bytearray(packed(here, np.ones(8, dtype=np.bool_)))
    owner = np.full(8, -1, dtype=np.int32)
    data[-1] = 2
    with pytest.raises(MessageError, match="neither true nor false"):
        AgentStream(there).read(memoryview(data), 5, owner)
