"""A node that sends an invalid frame with a correct checksum is lost, and the run continues."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from cavmarl.core.errors import JournalError, MessageError, ProtocolError
from cavmarl.driving.vehicles import VEHICLE
from cavmarl.engine.simulation import Simulation
from cavmarl.engine.world_setup import load_world
from cavmarl.parallel.nodes.index_check import IndexCheck
from cavmarl.parallel.nodes.link import FrameKind
from cavmarl.parallel.nodes.links import Links
from cavmarl.parallel.nodes.peer_faults import LinkLostError, check_indices, reading
from cavmarl.parallel.worlds.local_worlds import LocalWorlds
from cavmarl.verify.simulated_nodes import verify_simulated_nodes

SMALL: dict[str, Any] = {"agents": 3, "background": 12, "zones": 3, "steps": 6}
HUGE = np.full(400, 1 << 40, dtype=np.int64).tobytes()
GARBAGE = (b"[[[1]]]", b"\xff" * 64, b"[" * 99_999, HUGE)
# Kind of a valid frame → kinds of forged frames that are sent before it or instead of it.
# Nodes send REPORT to the caller, the caller sends COMMAND to nodes, and nodes exchange SHARE.
FORGED = {
    FrameKind.REPORT: (
        FrameKind.REPORT, FrameKind.SHARE, FrameKind.RESULT, FrameKind.PONG, FrameKind.NOT_MINE,
        FrameKind.MISSED, FrameKind.AGENT, FrameKind.MESSAGES, FrameKind.EXCHANGE, FrameKind.READY,
    ),
    FrameKind.COMMAND: (
        FrameKind.COMMAND, FrameKind.LEASE, FrameKind.RECOVER, FrameKind.ACTIONS, FrameKind.KEEP,
        FrameKind.MESSAGES, FrameKind.RECEPTIONS, FrameKind.SHARE,
    ),
    FrameKind.SHARE: (
        FrameKind.SHARE, FrameKind.SYNC, FrameKind.MESSAGES, FrameKind.AGENT, FrameKind.ACTIONS,
        FrameKind.PING,
    ),
}  # fmt: skip


def forge(
    monkeypatch: pytest.MonkeyPatch, carrier: FrameKind, kind: FrameKind, data: bytes
) -> list[bool]:
    """Send one forged frame before a frame of the kind `carrier`, or instead of that frame."""
    send, forged = Links.send, [False]
    seen = 0

    def sent(self: Links, to: int, true: FrameKind, number: int, pieces: Any = ()) -> None:
        nonlocal seen
        seen += true is carrier
        if true is carrier and seen == 12:
            forged[0] = True
            if kind is carrier:
                pieces = [data]
            else:
                send(self, to, kind, number, [data])
        send(self, to, true, number, pieces)

    monkeypatch.setattr(Links, "send", sent)
    return forged


@pytest.mark.parametrize("carrier", FORGED)
@pytest.mark.parametrize("data", GARBAGE, ids=lambda data: f"{data[:4]!r}x{len(data)}")
def test_at_most_the_sender_of_a_forged_frame_is_lost_and_no_result_changes(
    monkeypatch: pytest.MonkeyPatch, carrier: FrameKind, data: bytes
) -> None:
    wrong = []
    for kind in FORGED[carrier]:
        with monkeypatch.context() as patch:
            forged = forge(patch, carrier, kind, data)
            found = verify_simulated_nodes("merge", [3], mixes=["none"], seeds=1, **SMALL)
        (line,) = found.lines
        assert forged[0]
        # The check reports each lost node as an error. In this test, the sender may be lost.
        others = [text for text in line.wrong if "must be tolerated" not in text]
        if others or line.lost > 1:
            wrong.append((kind, line))
    assert not wrong


@pytest.fixture(scope="module")
def simulation() -> Simulation:
    worlds = LocalWorlds(load_world("grid4x4", agents=2, background=5), 1)
    worlds.arrays.chosen[:] = True
    worlds.reset(1, 0)
    return worlds.simulation


@pytest.mark.parametrize(
    "change",
    [
        {"lane": -1}, {"lane": 10**6}, {"side_lane": -2}, {"target_lane": 10**6}, {"link": 10**6},
        {"stopped_at": -7}, {"vtype": -1}, {"vtype": 99}, {"driver": 4}, {"agent": 10**6},
        {"goal": 10**6}, {"stop": 10**6}, {"way": -(1 << 40)}, {"way": 1 << 40}, {"id": -1},
    ],
)  # fmt: skip
def test_rows_with_an_index_out_of_range_are_refused(
    simulation: Simulation, change: dict[str, int]
) -> None:
    checks, rows = IndexCheck(simulation), simulation.division.vehicles(0).copy()
    assert rows.dtype == VEHICLE
    assert len(rows) > 5
    checks.check(rows)
    checks.check(rows[:0])
    for name, value in change.items():
        rows[name][-1] = value
    with pytest.raises(MessageError, match="an index that is out of bounds"):
        checks.check(rows)


@pytest.mark.parametrize(
    "error",
    [ValueError("x"), KeyError(1), IndexError(), TypeError(), ProtocolError("x"), OverflowError()],
)
def test_an_error_in_reading_a_frame_counts_as_loss_of_its_sender(error: Exception) -> None:
    with pytest.raises(LinkLostError, match="node 7") as lost, reading(7):
        raise error
    assert lost.value.peer == 7
    with pytest.raises(JournalError), reading(7):
        raise JournalError("the disk is full")


@pytest.mark.parametrize("found", [[3], [-1], [True], [1.0], ["1"], np.array([0, 3])])
def test_indices_out_of_range_are_refused(found: Any) -> None:
    check_indices("zone", [0, 2], 3)
    check_indices("zone", np.array([0, 2]), 3)
    with pytest.raises(MessageError, match="zone"):
        check_indices("zone", found, 3)
