"""Memory that two processes have at the same places."""

from __future__ import annotations

import numpy as np
import pytest

from cavmarl.core.errors import MessageError
from cavmarl.parallel.split_hosts.replica_memory import ARENA, MemoryReplica, ReplicaMemory


def make() -> tuple[ReplicaMemory, list[np.ndarray]]:
    memory = ReplicaMemory()
    arrays = [
        memory.zeros(3),
        memory.zeros((4, ARENA), np.uint8),
        memory.zeros((2, 0), np.float32),
        memory.zeros((5, 3), np.bool_),
        *(memory.zeros((100, 7), np.int32) for _ in range(40)),
    ]
    return memory, arrays


def test_arrays_lie_at_the_same_places() -> None:
    first, second = make(), make()
    for one, other in zip(first[1], second[1], strict=True):
        assert not one.any()
        assert one.flags.c_contiguous
        if one.size:
            assert first[0].place_of(one) == second[0].place_of(other)
            one[...] = 1
    assert all((array == 1).all() for array in first[1]), "no two of them share a byte"
    assert len(first[0].arenas) > 2
    assert first[0].find(np.zeros(3)) is None
    with pytest.raises(ValueError, match="no part of this memory"):
        first[0].place_of(np.zeros(3))


def test_a_new_process_is_sent_everything_and_then_what_changes() -> None:
    (here, ours), (there, theirs) = make(), make()
    rng = np.random.default_rng(0)
    for array in ours:
        array[...] = rng.integers(0, 2, array.shape)
    spans = here.spans_of(ours)
    replica, caller = MemoryReplica(here, 100), MemoryReplica(there, 100)
    sizes = []
    for step in range(3):
        replica.begin()
        replica.note(spans)
        caller.take(replica.stream)
        assert all(np.array_equal(a, b) for a, b in zip(ours, theirs, strict=True))
        sizes.append(replica.stream.size)
        ours[5][step, 2] += 7
    assert sizes[0] > 8 * ARENA // 8 // 64
    assert sizes[1] == sizes[2] == 2 + 2 + 1, "part, its end, first word, mask, word"
    theirs[3][1] ^= True
    caller.begin()
    caller.note(spans)
    replica.take(caller.stream)
    assert np.array_equal(ours[3], theirs[3])
    replica.forget()
    replica.begin()
    replica.note(spans)
    assert replica.stream.size >= sizes[0] - 64


@pytest.mark.parametrize(
    "words", [[0], [0, 9, 0, 1, 1], [9, 5, 0, 1, 1], [0, 2], [0, 5, 1 << 40, 1, 1]]
)
def test_changes_of_another_memory_are_refused(words: list[int]) -> None:
    memory, _ = make()
    with pytest.raises(MessageError):
        MemoryReplica(memory, 100).take(np.array(words, dtype=np.uint64))
