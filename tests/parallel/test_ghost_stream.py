"""Ghosts between two nodes: what is taken is what was sent, whatever changed since then."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from cavmarl.core.errors import MessageError
from cavmarl.core.records.arrays import Zoned
from cavmarl.parallel.nodes.ghost_stream import GhostStream
from cavmarl.shards.shard import make_zoned

CAPACITY = 40
WORLDS = 2
MINE, THEIRS = np.array([0]), np.array([1, 2])


def streams() -> tuple[Zoned, GhostStream, Zoned, GhostStream]:
    """A node of zone 0 and one of zones 1 and 2, and what each has for the other."""
    near, far = (make_zoned(3, WORLDS, CAPACITY) for _ in range(2))
    return near, GhostStream(near, MINE, THEIRS), far, GhostStream(far, THEIRS, MINE)


def fill(zoned: Zoned, drawn: np.random.Generator, ids: NDArray[np.int64]) -> None:
    """Ghosts of these vehicles in some order, many words of them as they were."""
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


def clear(zoned: Zoned) -> None:
    """What a tick does before ghosts are taken: owned rows stay."""
    zoned.num_owned[THEIRS] = 2
    zoned.num_rows[THEIRS] = zoned.num_near[THEIRS] = 2


def found(zoned: Zoned, first: int) -> list[list[bytes]]:
    """The ghosts of each zone and world behind its first rows, in no order; near ones apart."""
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


def test_what_is_taken_is_what_was_sent() -> None:
    near, out, far, come = streams()
    drawn = np.random.default_rng(1)
    sizes = []
    for tick in range(30):
        ids = np.arange(tick, tick + 30)
        fill(near, drawn, ids)
        clear(far)
        data = memoryview(b"".join(out.packed(1)))
        assert come.take(data, 1) == len(data)
        assert found(far, 2) == found(near, 0)
        sizes.append(len(data))
    assert all(sizes), "the other one is told how many there are, even if there are none"


def test_what_stays_is_not_sent_again() -> None:
    near, out, far, come = streams()
    fill(near, np.random.default_rng(2), np.arange(30))
    ghosts = int(near.num_rows[THEIRS].sum())
    sizes = []
    for _ in range(3):
        clear(far)
        data = memoryview(b"".join(out.packed(1)))
        come.take(data, 1)
        assert found(far, 2) == found(near, 0)
        sizes.append(len(data))
    assert sizes[0] > ghosts * near.rows.itemsize
    assert sizes[1] == sizes[2] < sizes[0] / 8


@pytest.mark.parametrize("harm", ["fewer words", "more words", "of none before", "part of none"])
def test_what_cannot_be_is_refused(harm: str) -> None:
    near, out, far, come = streams()
    fill(near, np.random.default_rng(3), np.arange(30))
    num, counts, like, bits, words = map(bytearray, out.packed(1))
    if harm == "fewer words":
        num[:] = (len(words) // 8 - 1).to_bytes(8, "little")
        del words[-8:]
    elif harm == "more words":
        num[:] = (len(words) // 8 + 1).to_bytes(8, "little")
        words += bytes(8)
    elif harm == "of none before":
        like[:8] = bytes(8)
    else:
        bits[:8] = bytes(8)
    clear(far)
    with pytest.raises(MessageError, match="cannot have"):
        come.take(memoryview(b"".join((num, counts, like, bits, words))), 1)
    assert (far.num_rows[THEIRS] == 2).all(), "nothing of it was put anywhere"
