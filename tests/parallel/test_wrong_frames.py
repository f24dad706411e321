"""A node that sends a valid frame with wrong content is lost, and the results stay the same."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from io import BytesIO
from typing import Any, NamedTuple

import numpy as np
import pytest
from numpy.typing import NDArray

from cavmarl.config.terms import TERMS
from cavmarl.driving.vehicles import VEHICLE
from cavmarl.ownership.messages import COORDINATOR, Ack, Done, Message, Prepare
from cavmarl.parallel.nodes import node_pool
from cavmarl.parallel.nodes.link import FrameKind
from cavmarl.parallel.nodes.links import Links
from cavmarl.parallel.nodes.node_peers import NodePeers
from cavmarl.parallel.nodes.zone_endpoints import packed, packed_report, read_report, unpacked
from cavmarl.parallel.state.world_bytes import to_bytes
from cavmarl.verify.simulated_nodes import verify_simulated_nodes
from tests.support.forged_states import ROW

BUSY: dict[str, Any] = {
    "agents": 12, "background": 20, "zones": 8, "steps": 16, "overrides": {"clock.ctrl_dt_s": 0.4},
}  # fmt: skip
# The record of an agent in a frame about agents.
AGENT = np.dtype([
    ("terms", "<f4", len(TERMS)), ("terminated", "?"), ("present", "?"), ("acted", "?"),
    ("events", "<i4"), ("vehicle_id", "<i8"), ("place", "<f8", 2),
])  # fmt: skip
NEW = -1  # stands for a node that has not sent its number yet
REFUSED = "the state is damaged or belongs to different worlds"
SENDER = 1  # default number of the node whose frame is changed


class Sent(NamedTuple):
    """A frame before it is sent."""

    to: int
    kind: FrameKind
    number: int
    data: bytes


Change = Callable[[Sent], Sent | None]
"""A function that returns a changed frame, or None to try the next frame instead."""

DROPPED = Sent(0, FrameKind.END, 0, b"")  # stands for a frame that must not be sent


class Forger:
    """Changes one frame that a node sends, and records which nodes are lost.

    Attributes:
        frame: the changed frame.
        lost: number of a lost node → reason.
    """

    def __init__(
        self,
        patch: pytest.MonkeyPatch,
        kind: FrameKind,
        change: Change,
        after: int = 0,
        sender: int = SENDER,
    ) -> None:
        self.frame: Sent | None = None
        self.lost: dict[int, str] = {}
        self._numbers: dict[int, int] = {}  # id of the links of a node → number of the node
        self._left = after  # matching frames that are still to be sent unchanged
        make, send = NodePeers.__init__, Links.send

        def made(
            peers: NodePeers, simulation: Any, links: Links, zones: Any, number: int, *rest: Any
        ) -> None:
            self._numbers[id(links)] = number
            make(peers, simulation, links, zones, number, *rest)

        def sent(links: Links, to: int, of: FrameKind, number: int, pieces: Any = ()) -> None:
            is_node = COORDINATOR in links.numbers
            if is_node and self._numbers.get(id(links), NEW) == sender and of is kind:
                data = b"".join(bytes(memoryview(piece).cast("B")) for piece in pieces)
                found = self._changed(Sent(to, of, number, data), change)
                if found is DROPPED:
                    return
                of, number, pieces = found.kind, found.number, [found.data]
            send(links, to, of, number, pieces)

        def note(text: str, *values: Any) -> None:
            if text.startswith("node %d"):
                self.lost[values[0]] = str(values[-1])

        patch.setattr(NodePeers, "__init__", made)
        patch.setattr(Links, "send", sent)
        patch.setattr(node_pool.log, "warning", note)

    def _changed(self, frame: Sent, change: Change) -> Sent:
        if self.frame is not None or (found := change(frame)) is None:
            return frame
        self._left -= 1
        if self._left >= 0:
            return frame
        self.frame = found
        return found


def check(
    patch: pytest.MonkeyPatch,
    kind: FrameKind,
    change: Change,
    words: str,
    after: int = 2,
    sender: int = SENDER,
    nodes: int = 3,
    **overrides: Any,
) -> None:
    """Check that only the node that sends a wrong frame is lost, and that no result changes.

    Args:
        patch: undoes the changes of the code after the test.
        kind: kind of the changed frame.
        change: function that makes the frame wrong.
        words: part of the expected reason of the loss.
        after: number of matching frames to send unchanged before the changed one.
        sender: number of the node that sends the frame.
        nodes: number of nodes.
        overrides: settings of the environment.
    """
    forger = Forger(patch, kind, change, after, sender)
    keys = {**BUSY, "overrides": BUSY["overrides"] | overrides}
    found = verify_simulated_nodes("merge", [nodes], mixes=["none"], seeds=1, **keys)
    (line,) = found.lines
    assert forger.frame is not None
    assert [text for text in line.wrong if "must be tolerated" not in text] == []
    assert list(forger.lost) == [sender]
    assert words in forger.lost[sender]


def add_number(value: int) -> Change:
    """Return a change that adds a value to the number of a frame."""
    return lambda frame: frame._replace(number=frame.number + value)


def as_kind(other: FrameKind) -> Change:
    """Return a change that sets the kind of a frame."""
    return lambda frame: frame._replace(kind=other)


def replace_content(data: bytes) -> Change:
    """Return a change that replaces the content of a frame."""
    return lambda frame: frame._replace(data=data)


def drop(frame: Sent) -> Sent:
    return DROPPED


# Numbers and kinds


@pytest.mark.parametrize(
    ("of", "change", "words"),
    [
        (FrameKind.REPORT, add_number(1), "a frame of kind REPORT is of generation 1, not 0"),
        (FrameKind.REPORT, add_number(1 << 40), "of generation"),
        (FrameKind.RESULT, add_number(1), "a frame of kind RESULT is of generation 1, not 0"),
        (FrameKind.REPORT, as_kind(FrameKind.RESULT), "RESULT, not REPORT"),
        (FrameKind.REPORT, as_kind(FrameKind.END), "must not send frames of kind END"),
        (FrameKind.REPORT, as_kind(FrameKind.REFUSED), "must not send frames of kind REFUSED"),
        (FrameKind.REPORT, as_kind(FrameKind.KEEP), "must not send frames of kind KEEP"),
        (FrameKind.MESSAGES, add_number(1), "a frame of kind MESSAGES is of generation 1, not 0"),
        (FrameKind.SHARE, as_kind(FrameKind.REFUSED), "must not send frames of kind REFUSED"),
        (FrameKind.SHARE, as_kind(FrameKind.GIVE), "a frame of kind GIVE is of generation"),
        (FrameKind.SHARE, as_kind(FrameKind.SYNC), "it claims that a recovery was ordered"),
    ],
)  # fmt: skip
def test_the_sender_of_a_wrong_frame_number_or_kind_is_lost(
    monkeypatch: pytest.MonkeyPatch, of: FrameKind, change: Change, words: str
) -> None:
    check(monkeypatch, of, change, words)


@pytest.mark.parametrize(
    ("of", "after", "words"),
    [
        (FrameKind.REPORT, 0, "its frame is missing"),
        (FrameKind.RESULT, 0, "its frame is missing"),
        (FrameKind.KEEP, 1, "it sends SHARE before an awaited frame"),
        (FrameKind.AGENT, 0, "it sends SHARE before an awaited frame"),
    ],
)
def test_a_node_that_does_not_send_a_frame_is_lost(
    monkeypatch: pytest.MonkeyPatch, of: FrameKind, after: int, words: str
) -> None:
    check(monkeypatch, of, drop, words, after, sender=0)


@pytest.mark.parametrize("change", [drop, add_number(1), replace_content(b"more")])
def test_the_sender_of_a_wrong_sync_is_lost(
    monkeypatch: pytest.MonkeyPatch, change: Change
) -> None:
    forger = Forger(monkeypatch, FrameKind.SYNC, change)
    found = verify_simulated_nodes("merge", [3], mixes=["none"], seeds=1, **BUSY)
    assert [text for text in found.lines[0].wrong if "must be tolerated" not in text] == []
    assert forger.frame is not None
    assert list(forger.lost) == [SENDER]


def mark_absent(frame: Sent) -> Sent | None:
    """Mark all agents of a frame about agents as absent."""
    num = int.from_bytes(frame.data[:8], "little")
    row = AGENT.itemsize
    if not num or len(frame.data) != 8 + num * (8 + row):
        return None
    data = bytearray(frame.data)
    rows = np.frombuffer(data, AGENT, num, 8 + 8 * num)
    if not rows["present"].all():
        return None
    rows["present"] = 0
    return frame._replace(data=bytes(data))


def test_the_sender_of_a_wrong_presence_flag_is_lost(monkeypatch: pytest.MonkeyPatch) -> None:
    check(monkeypatch, FrameKind.SHARE, mark_absent, "it sends agents that are absent", after=0)


# Kept states


def move_to_foreign_zone(frame: Sent) -> Sent | None:
    """Move the vehicles of a zone, in a kept state, to a zone of another node."""
    found = read_arrays(frame.data)
    own = next((n for n in range(len(found) - 8, len(found)) if len(found[n])), None)
    if own is None:
        return None
    other = next(n for n in range(len(found) - 8, len(found)) if not len(found[n]))
    found[own], found[other] = found[other], found[own]
    return frame._replace(data=to_bytes(found))


def read_arrays(data: bytes) -> list[NDArray[Any]]:
    """Read all arrays of a kept state."""
    file, found = BytesIO(data), []
    while file.tell() < len(data):
        found.append(np.lib.format.read_array(file))
    return found


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (replace_content(b""), "the state belongs to other worlds"),
        (lambda frame: frame._replace(data=frame.data[:-8]), "the state belongs to other worlds"),
        (add_number(1), "it sends SHARE before an awaited frame"),
        (add_number(1 << 40), "it sends SHARE before an awaited frame"),
        (move_to_foreign_zone, "its state has vehicles of zones"),
    ],
)
def test_the_sender_of_a_wrong_replica_is_lost_when_the_replica_arrives(
    monkeypatch: pytest.MonkeyPatch, change: Change, words: str
) -> None:
    """A replica must be checked early: when it is needed, its sender may be lost already."""
    check(monkeypatch, FrameKind.KEEP, change, words, after=1)


def set_field(dtype: np.dtype[Any], name: str, value: float) -> Change:
    """Return a change that sets a field in the last record of a dtype in a kept state."""

    def changed(frame: Sent) -> Sent | None:
        found = read_arrays(frame.data)
        rows = [array for array in found if array.dtype == dtype and array.size]
        if not rows:
            return None
        rows[-1][name][(-1,) * rows[-1].ndim] = value
        return frame._replace(data=to_bytes(found))

    return changed


NAMES = ("lane", "link", "vtype", "goal", "stop", "way", "id", "x", "length")
# Agent 6 and order 0 are valid here: these worlds have more than 6 agents, and have departures.
FORGED = [
    (name, value) for name, values in ROW.items() for value in values
    if (name, value) not in (("agent", 6), ("order", 0))
]  # fmt: skip


@pytest.mark.parametrize("name", NAMES)
def test_the_sender_of_a_forged_replica_is_lost(monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    """Set a field to a value that is out of range."""
    check(monkeypatch, FrameKind.KEEP, set_field(VEHICLE, name, ROW[name][-1]), REFUSED, after=1)


@pytest.mark.slow  # all fields and values
@pytest.mark.parametrize(("name", "value"), FORGED)
def test_the_sender_of_each_forged_replica_is_lost(
    monkeypatch: pytest.MonkeyPatch, name: str, value: float
) -> None:
    check(monkeypatch, FrameKind.KEEP, set_field(VEHICLE, name, value), REFUSED, after=1)


def test_the_sender_of_a_replica_with_a_forged_array_is_lost(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Set all numbers of an array to the least value of their type."""

    def forge(n: int) -> Change:
        def changed(frame: Sent) -> Sent | None:
            found = read_arrays(frame.data)
            if not found[n].size:
                return None
            found[n][...] = np.iinfo(found[n].dtype).min
            return frame._replace(data=to_bytes(found))

        return changed

    for n in (4, -9):  # places of the arrays of ticks and of contacts in the state
        with monkeypatch.context() as patch:
            check(patch, FrameKind.KEEP, forge(n), REFUSED, after=1)


@pytest.mark.parametrize("name", ["lane", "way", "goal"])
def test_the_sender_of_a_forged_state_of_moving_zones_is_lost(
    monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    """Node 1 is lost, and node 2 takes its zones. Node 2 then gives the zones to the new node 1."""
    first = Forger(monkeypatch, FrameKind.KEEP, replace_content(b""), after=1)
    giver = Forger(monkeypatch, FrameKind.GIVE, set_field(VEHICLE, name, ROW[name][-1]), sender=2)
    keys = {**BUSY, "steps": 40}
    found = verify_simulated_nodes("merge", [3], mixes=["none"], seeds=1, **keys)
    assert first.frame is not None
    assert giver.frame is not None
    assert [text for text in found.lines[0].wrong if "must be tolerated" not in text] == []
    assert list(giver.lost)[:2] == [1, 2]
    assert REFUSED in giver.lost[2]


# Reports


def change_report(change: Callable[[list[tuple[int, Message]], list[Any]], bool]) -> Change:
    """Return a change of the messages and worlds of a report; `change` returns False to skip it."""

    def changed(frame: Sent) -> Sent | None:
        messages, reports, more = read_report(memoryview(frame.data), 1)
        worlds = [list(report) for report in reports]
        if not change(messages, worlds):
            return None
        reports = [type(reports[0])(*world) for world in worlds] if worlds else []
        return frame._replace(data=packed_report(messages, reports) + bytes(more))

    return changed


def without_done(messages: list[tuple[int, Message]], worlds: list[Any]) -> bool:
    return bool(messages) and messages.pop() is not None


def other_tally(messages: list[tuple[int, Message]], worlds: list[Any]) -> bool:
    if not messages:
        return False
    w, done = messages[0]
    assert isinstance(done, Done)
    owned = done.owned._replace(vehicles=done.owned.vehicles + 1)
    messages[0] = w, dataclasses.replace(done, owned=owned)
    return True


def other_tick(messages: list[tuple[int, Message]], worlds: list[Any]) -> bool:
    if not messages:
        return False
    w, done = messages[0]
    messages[0] = w, dataclasses.replace(done, tick=done.tick + 1)
    return True


def other_incarnation(messages: list[tuple[int, Message]], worlds: list[Any]) -> bool:
    if not messages:
        return False
    w, done = messages[0]
    assert isinstance(done, Done)
    messages[0] = w, dataclasses.replace(done, incarnation=done.incarnation + 1)
    return True


def report_as_new(messages: list[tuple[int, Message]], worlds: list[Any]) -> bool:
    """Report a vehicle of the episode as new."""
    if not worlds or not worlds[0][0]:
        return False
    (vehicle, zone, _), *_ = worlds[0][0]
    worlds[0][1] = [(vehicle, zone)]
    return True


def other_mover(messages: list[tuple[int, Message]], worlds: list[Any]) -> bool:
    if not worlds or not worlds[0][0]:
        return False
    (vehicle, zone, digest), *rest = worlds[0][0]
    worlds[0][0] = [(vehicle + 1000, zone, digest), *rest]
    return True


def other_digest(messages: list[tuple[int, Message]], worlds: list[Any]) -> bool:
    if not worlds or not worlds[0][0]:
        return False
    (vehicle, zone, digest), *rest = worlds[0][0]
    worlds[0][0] = [(vehicle, zone, digest[::-1]), *rest]
    return True


def another_episode(messages: list[tuple[int, Message]], worlds: list[Any]) -> bool:
    if not worlds or worlds[0][2]:
        return False
    worlds[0][2] = True
    return True


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (without_done, "no tick is complete"),
        (other_tally, "vehicles"),
        (other_tick, "a Done of tick"),
        (other_incarnation, "a Done of tick"),
        (report_as_new, "at most once in an episode"),
        (other_mover, "which it does not own"),
        (other_digest, "it has offered another state of vehicle"),
        (another_episode, "it wrongly reports a new episode"),
    ],
)
def test_the_sender_of_a_wrong_report_is_lost(
    monkeypatch: pytest.MonkeyPatch,
    change: Callable[[list[tuple[int, Message]], list[Any]], bool],
    words: str,
) -> None:
    check(monkeypatch, FrameKind.REPORT, change_report(change), words, after=0)


def test_the_sender_of_a_wrong_count_of_vehicles_is_lost(monkeypatch: pytest.MonkeyPatch) -> None:
    """The node whose report first differs from the records is at fault."""

    def one_more_vehicle(messages: list[tuple[int, Message]], worlds: list[Any]) -> bool:
        (zone, num, total), *rest = worlds[0][3]
        worlds[0][3] = [(zone, num + 1, total), *rest]
        return True

    check(
        monkeypatch, FrameKind.REPORT, change_report(one_more_vehicle), "ids or epochs differ",
        **{"zones.check_invariants": True},
    )  # fmt: skip


def test_the_only_node_is_lost_if_it_does_not_send_its_state(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    check(
        monkeypatch, FrameKind.KEEP, drop, "it has not sent state", after=1, sender=0, nodes=1
    )  # fmt: skip


# Messages of ownership transfers


def change_message(of: type[Message], **changes: Any) -> Change:
    """Return a change of the fields of the first message of a class."""

    def changed(frame: Sent) -> Sent | None:
        ((w, found),) = unpacked(memoryview(frame.data))
        if not isinstance(found, of):
            return None
        new = {name: change(getattr(found, name)) for name, change in changes.items()}
        return frame._replace(data=packed([(w, dataclasses.replace(found, **new))]))

    return changed


def drop_message(of: type[Message], to_coordinator: bool) -> Change:
    """Return a change that drops a message of a class."""

    def changed(frame: Sent) -> Sent | None:
        ((_, found),) = unpacked(memoryview(frame.data))
        is_wanted = isinstance(found, of) and (frame.to == COORDINATOR) == to_coordinator
        return DROPPED if is_wanted else None

    return changed


def one_more(value: int) -> int:
    return value + 1


@pytest.mark.parametrize(
    ("sender", "change", "words"),
    [
        (0, change_message(Prepare, tick=lambda tick: tick + 5), "a Prepare of tick"),
        (0, change_message(Prepare, episode=lambda episode: episode + 2), "a Prepare of tick"),
        (
            0,
            change_message(Prepare, source=lambda zone: 7),
            "it sends for zone 7, which it does not host",
        ),
        (
            0,
            change_message(Prepare, target=lambda zone: 0),
            "it sends for zones (0,) to another node",
        ),
        (0, drop_message(Prepare, to_coordinator=False), "it has not offered vehicle"),
        (1, change_message(Ack, tick=one_more), "a Ack of tick"),
        (1, change_message(Ack, incarnation=one_more), "a Ack of tick"),
        (1, change_message(Ack, zone=lambda zone: 0), "sends for zone 0, which it does not host"),
        (1, drop_message(Ack, to_coordinator=True), "its answer to an offer is missing"),
    ],
)
def test_the_sender_of_a_wrong_message_is_lost(
    monkeypatch: pytest.MonkeyPatch, sender: int, change: Change, words: str
) -> None:
    check(monkeypatch, FrameKind.MESSAGES, change, words, after=0, sender=sender)


# Nodes that join


@pytest.mark.parametrize(
    "change",
    [
        replace_content(b"]"),
        replace_content(b'["node", 100000, [], false]'),
        as_kind(FrameKind.RESULT),
        lambda frame: frame._replace(data=frame.data.replace(b'"node", 1', b'"node", 2')),
    ],
)
def test_a_node_that_joins_with_a_wrong_frame_is_restarted_or_lost(
    monkeypatch: pytest.MonkeyPatch, change: Change
) -> None:
    """A node that gives a wrong address is lost, because the other nodes cannot reach it."""
    forger = Forger(monkeypatch, FrameKind.READY, change, sender=NEW)
    found = verify_simulated_nodes("merge", [3], mixes=["none"], seeds=1, **BUSY)
    assert forger.frame is not None
    assert [text for text in found.lines[0].wrong if "must be tolerated" not in text] == []
    assert len(forger.lost) <= 1
