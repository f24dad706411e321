"""Kept states of a node: at most two, and one once the newest has arrived everywhere."""

from __future__ import annotations

from io import BytesIO
from typing import Any

import numpy as np

from cavmarl.parallel.nodes.link import FrameKind, NodeFrame
from cavmarl.parallel.nodes.state_replicas import StateReplicas
from cavmarl.parallel.state.world_bytes import from_bytes, to_bytes


class Worlds:
    def save(self) -> list[np.ndarray[Any, Any]]:
        return [np.arange(3)]


class Wires:
    def __init__(self) -> None:
        self.sent: list[tuple[int, int]] = []

    def send(self, to: int, kind: FrameKind, number: int, pieces: Any) -> None:
        assert kind is FrameKind.KEEP
        self.sent.append((to, number))


def test_older_states_are_dropped_when_the_newest_has_arrived_everywhere() -> None:
    worlds, wires = Worlds(), Wires()
    kept = StateReplicas(worlds, (), wires, 1)  # type: ignore[arg-type]
    for state in (1, 2, 3):
        kept.receive(0, NodeFrame(FrameKind.KEEP, state, memoryview(b"theirs")))
        kept.keep(state, [0, 1, 4])
    assert wires.sent == [(4, 1), (4, 2), (4, 3)]
    assert (list(kept.own), list(kept.others[0])) == ([2, 3], [2, 3])
    kept.settle()
    kept.receive(0, NodeFrame(FrameKind.KEEP, 4, memoryview(b"theirs")))  # ahead of this node
    kept.settle()
    assert (list(kept.own), list(kept.others[0])) == ([3], [3, 4]), "all may go back to 3"


def test_arrays_have_the_format_of_numpy() -> None:
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
