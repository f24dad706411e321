"""A node keeps at most two states, and only one after all replicas of the newest have arrived."""

from __future__ import annotations

from collections.abc import Callable
from io import BytesIO
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from cavmarl.core.errors import ConfigError, MessageError
from cavmarl.parallel.nodes.link import FrameKind, NodeFrame
from cavmarl.parallel.nodes.peer_faults import LinkLostError
from cavmarl.parallel.nodes.state_replicas import StateReplicas
from cavmarl.parallel.state.world_bytes import from_bytes, to_bytes


class Worlds:
    """Worlds with two zones; their state is an array of numbers and the rows of each zone."""

    simulation = SimpleNamespace(num_worlds=1)
    world = SimpleNamespace(partition=SimpleNamespace(count=2))

    def save(self) -> list[np.ndarray[Any, Any]]:
        return [np.arange(3), np.zeros(0), np.ones(2)]

    def check(self, saved: list[np.ndarray[Any, Any]], is_whole: bool = True) -> None:
        if len(saved[0]) != 3:
            raise ConfigError("the state has other numbers")


class Wires:
    def __init__(self) -> None:
        self.sent: list[tuple[int, int]] = []

    def send(self, to: int, kind: FrameKind, number: int, pieces: Any) -> None:
        assert kind is FrameKind.KEEP
        self.sent.append((to, number))

    def await_urgent(self, number: int, has_come: Callable[[], bool]) -> None:
        if not has_come():
            raise LinkLostError(number, MessageError("it has not come"))


ZONES = [[0], [1], [], [], []]


def replica(state: int, arrays: list[np.ndarray[Any, Any]]) -> NodeFrame:
    return NodeFrame(FrameKind.KEEP, state, memoryview(to_bytes(arrays)))


THEIRS = [np.arange(3), np.ones(5), np.zeros(0)]


def test_older_states_are_deleted_when_all_replicas_of_the_newest_have_arrived() -> None:
    worlds, wires = Worlds(), Wires()
    kept = StateReplicas(worlds, (), wires, 1)  # type: ignore[arg-type]
    for state in (1, 2, 3):
        kept.receive(0, replica(state, THEIRS))
        saved = kept.keep(state, [0, 1, 4])
        kept.await_replica(state, ZONES, saved)
    assert wires.sent == [(4, 1), (4, 2), (4, 3)]
    assert (list(kept.own), list(kept.others[0])) == ([2, 3], [2, 3])
    kept.settle()
    kept.receive(0, replica(4, THEIRS))  # the other node has already kept the next state
    kept.settle()
    assert (list(kept.own), list(kept.others[0])) == ([3], [3]), (
        "state 3, to which nodes may have to return, is missing"
    )
    kept.await_replica(4, ZONES, saved)
    assert list(kept.others[0]) == [3, 4]


@pytest.mark.parametrize(
    ("state", "arrays", "words"),
    [
        (2, THEIRS, "it has not come"),
        (1, [*THEIRS, np.ones(1)], "there are more arrays"),
        (1, [np.arange(4), *THEIRS[1:]], "the state has other numbers"),
        (1, [np.arange(3), np.ones(5), np.ones(2)], r"vehicles of zones \[1\]"),
    ],
)
def test_a_wrong_replica_counts_as_loss_of_its_sender(
    state: int, arrays: list[np.ndarray[Any, Any]], words: str
) -> None:
    kept = StateReplicas(Worlds(), (), Wires(), 1)  # type: ignore[arg-type]
    kept.receive(0, replica(state, arrays))
    with pytest.raises(LinkLostError, match=words) as lost:
        kept.await_replica(1, ZONES, Worlds().save())
    assert lost.value.peer == 0
    assert not kept.others


def test_a_state_is_a_sequence_of_arrays_in_the_format_of_numpy() -> None:
    rows = np.zeros(5, dtype=np.dtype([("id", np.int64), ("is_near", np.bool_)], align=True))
    rows["id"] = np.arange(5)
    arrays = [rows, rows[:0], np.zeros((2, 0)), np.arange(6).reshape(2, 3).T, np.ones(1, np.bool_)]
    file = BytesIO()
    for array in arrays:
        np.lib.format.write_array(file, np.ascontiguousarray(array), allow_pickle=False)
    data = to_bytes(arrays)
    assert data == file.getvalue()
    for array, found in zip(arrays, from_bytes(data, arrays), strict=True):
        assert (array == found).all()
