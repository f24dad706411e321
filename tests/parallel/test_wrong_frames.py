"""Frames of a valid form with wrong content: their sender is lost, and the run stays equal."""

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
# A row of a frame about agents
AGENT = np.dtype([
    ("terms", "<f4", len(TERMS)), ("terminated", "?"), ("present", "?"), ("acted", "?"),
    ("events", "<i4"), ("vehicle_id", "<i8"), ("place", "<f8", 2),
])  # fmt: skip
NEW = -1  # number of a node that has not begun
REFUSED = "the state is damaged or belongs to different worlds"
SENDER = 1  # the node whose frame is changed, unless a test names another node


class Sent(NamedTuple):
    """A frame before it is sent."""

    to: int
    kind: FrameKind
    number: int
    data: bytes


Change = Callable[[Sent], Sent | None]
"""Returns another frame; None: the frame stays as it is, and the next one is tried."""

DROPPED = Sent(0, FrameKind.END, 0, b"")  # a frame that is not sent


class Forger:
    """Changes one frame of a node, and notes which nodes are lost.

    Attributes:
        frame: the changed frame.
        lost: node → why it is lost.
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
        self._numbers: dict[int, int] = {}  # link → number of each node that has begun
        self._left = after  # number of frames of the kind that are sent unchanged
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
    """Check that a run stays equal if one node sends one wrong frame, and that this node is lost.

    Args:
        patch: undoes the change.
        kind: of the frame.
        change: makes the frame wrong.
        words: part of the reason why the node is lost.
        after: number of frames that could be changed, and are sent as they are.
        sender: the node.
        nodes: number of nodes.
        overrides: of the configuration.
    """
    forger = Forger(patch, kind, change, after, sender)
    keys = {**BUSY, "overrides": BUSY["overrides"] | overrides}
    found = verify_simulated_nodes("merge", [nodes], mixes=["none"], seeds=1, **keys)
    (line,) = found.lines
    assert forger.frame is not None
    assert [text for text in line.wrong if "must be tolerated" not in text] == []
    assert list(forger.lost) == [sender]
    assert words in forger.lost[sender]


def renumbered(value: int) -> Change:
    """Return a change of the number of a frame by a value."""
    return lambda frame: frame._replace(number=frame.number + value)


def as_kind(other: FrameKind) -> Change:
    """Return a change of the kind of a frame."""
    return lambda frame: frame._replace(kind=other)


def content(data: bytes) -> Change:
    """Return a change of the content of a frame."""
    return lambda frame: frame._replace(data=data)


def drop(frame: Sent) -> Sent:
    return DROPPED


# Numbers and kinds


@pytest.mark.parametrize(
    ("of", "change", "words"),
    [
        (FrameKind.REPORT, renumbered(1), "a frame of kind REPORT is of generation 1, not 0"),
        (FrameKind.REPORT, renumbered(1 << 40), "of generation"),
        (FrameKind.RESULT, renumbered(1), "a frame of kind RESULT is of generation 1, not 0"),
        (FrameKind.REPORT, as_kind(FrameKind.RESULT), "RESULT, not REPORT"),
        (FrameKind.REPORT, as_kind(FrameKind.END), "must not send frames of kind END"),
        (FrameKind.REPORT, as_kind(FrameKind.REFUSED), "must not send frames of kind REFUSED"),
        (FrameKind.REPORT, as_kind(FrameKind.KEEP), "must not send frames of kind KEEP"),
        (FrameKind.MESSAGES, renumbered(1), "a frame of kind MESSAGES is of generation 1, not 0"),
        (FrameKind.SHARE, as_kind(FrameKind.REFUSED), "must not send frames of kind REFUSED"),
        (FrameKind.SHARE, as_kind(FrameKind.GIVE), "a frame of kind GIVE is of generation"),
        (FrameKind.SHARE, as_kind(FrameKind.SYNC), "it claims an order to recover"),
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


@pytest.mark.parametrize("change", [drop, renumbered(1), content(b"more")])
def test_the_sender_of_a_wrong_sync_is_lost(
    monkeypatch: pytest.MonkeyPatch, change: Change
) -> None:
    forger = Forger(monkeypatch, FrameKind.SYNC, change)
    found = verify_simulated_nodes("merge", [3], mixes=["none"], seeds=1, **BUSY)
    assert [text for text in found.lines[0].wrong if "must be tolerated" not in text] == []
    assert forger.frame is not None
    assert list(forger.lost) == [SENDER]


def absent(frame: Sent) -> Sent | None:
    """Change the flag of an agent that says whether it is present, in a frame about agents."""
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
    check(monkeypatch, FrameKind.SHARE, absent, "it sends agents that are absent", after=0)


# Kept states


def other_zone(frame: Sent) -> Sent | None:
    """Move the vehicles of a kept state to a zone of another node."""
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
        (content(b""), "the state is one of other worlds"),
        (lambda frame: frame._replace(data=frame.data[:-8]), "the state is one of other worlds"),
        (renumbered(1), "it sends SHARE before an awaited frame"),
        (renumbered(1 << 40), "it sends SHARE before an awaited frame"),
        (other_zone, "its state has vehicles of zones"),
    ],
)
def test_a_wrong_replica_is_noticed_when_it_is_kept(
    monkeypatch: pytest.MonkeyPatch, change: Change, words: str
) -> None:
    """When the replica is needed, it is too late to find its sender at fault."""
    check(monkeypatch, FrameKind.KEEP, change, words, after=1)


def forged(dtype: np.dtype[Any], name: str, value: float) -> Change:
    """Return a change of a field of the last record of a type in a kept state."""

    def changed(frame: Sent) -> Sent | None:
        found = read_arrays(frame.data)
        rows = [array for array in found if array.dtype == dtype and array.size]
        if not rows:
            return None
        rows[-1][name][(-1,) * rows[-1].ndim] = value
        return frame._replace(data=to_bytes(found))

    return changed


NAMES = ("lane", "link", "vtype", "goal", "stop", "way", "id", "x", "length")
# The worlds of these runs have more than 6 agents, and departures.
FORGED = [
    (name, value) for name, values in ROW.items() for value in values
    if (name, value) not in (("agent", 6), ("order", 0))
]  # fmt: skip


@pytest.mark.parametrize("name", NAMES)
def test_a_forged_replica_loses_its_sender(monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    """A node knows the key and sends a state with a number that no table allows."""
    check(monkeypatch, FrameKind.KEEP, forged(VEHICLE, name, ROW[name][-1]), REFUSED, after=1)


@pytest.mark.slow  # the same for each field and value
@pytest.mark.parametrize(("name", "value"), FORGED)
def test_each_forged_replica_loses_its_sender(
    monkeypatch: pytest.MonkeyPatch, name: str, value: float
) -> None:
    check(monkeypatch, FrameKind.KEEP, forged(VEHICLE, name, value), REFUSED, after=1)


def test_forged_arrays_of_a_replica_lose_their_sender(monkeypatch: pytest.MonkeyPatch) -> None:
    """All integers of an array out of all ranges."""

    def forge(n: int) -> Change:
        def changed(frame: Sent) -> Sent | None:
            found = read_arrays(frame.data)
            if not found[n].size:
                return None
            found[n][...] = np.iinfo(found[n].dtype).min
            return frame._replace(data=to_bytes(found))

        return changed

    for n in (4, -9):  # ticks, contacts
        with monkeypatch.context() as patch:
            check(patch, FrameKind.KEEP, forge(n), REFUSED, after=1)


@pytest.mark.parametrize("name", ["lane", "way", "goal"])
def test_a_forged_state_of_moving_zones_loses_its_sender(
    monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    """Node 1 is lost first. The node that has its zones gives them to the next node 1."""
    first = Forger(monkeypatch, FrameKind.KEEP, content(b""), after=1)
    giver = Forger(monkeypatch, FrameKind.GIVE, forged(VEHICLE, name, ROW[name][-1]), sender=2)
    keys = {**BUSY, "steps": 40}
    found = verify_simulated_nodes("merge", [3], mixes=["none"], seeds=1, **keys)
    assert first.frame is not None
    assert giver.frame is not None
    assert [text for text in found.lines[0].wrong if "must be tolerated" not in text] == []
    assert list(giver.lost)[:2] == [1, 2]
    assert REFUSED in giver.lost[2]


# Reports


def reported(change: Callable[[list[tuple[int, Message]], list[Any]], bool]) -> Change:
    """Return a change of the messages and the worlds of a report; False: try the next one."""

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


def old_birth(messages: list[tuple[int, Message]], worlds: list[Any]) -> bool:
    """Report the birth of a vehicle that already existed in the episode."""
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
        (old_birth, "at most once in an episode"),
        (other_mover, "which it does not own"),
        (other_digest, "it has offered another state of vehicle"),
        (another_episode, "an episode has begun: True"),
    ],
)
def test_the_sender_of_a_wrong_report_is_lost(
    monkeypatch: pytest.MonkeyPatch,
    change: Callable[[list[tuple[int, Message]], list[Any]], bool],
    words: str,
) -> None:
    check(monkeypatch, FrameKind.REPORT, reported(change), words, after=0)


def test_the_sender_of_a_wrong_count_of_vehicles_is_lost(monkeypatch: pytest.MonkeyPatch) -> None:
    """The report with the first difference from the records counts as the wrong one."""

    def one_more_vehicle(messages: list[tuple[int, Message]], worlds: list[Any]) -> bool:
        (zone, num, total), *rest = worlds[0][3]
        worlds[0][3] = [(zone, num + 1, total), *rest]
        return True

    check(
        monkeypatch, FrameKind.REPORT, reported(one_more_vehicle), "or epochs differ",
        **{"zones.check_invariants": True},
    )  # fmt: skip


def test_an_only_node_that_does_not_send_its_state_is_lost(monkeypatch: pytest.MonkeyPatch) -> None:
    check(
        monkeypatch, FrameKind.KEEP, drop, "it has not sent state", after=1, sender=0, nodes=1
    )  # fmt: skip


# Messages about offers


def message(of: type[Message], **changes: Any) -> Change:
    """Return a change of the fields of the first message of a class."""

    def changed(frame: Sent) -> Sent | None:
        ((w, found),) = unpacked(memoryview(frame.data))
        if not isinstance(found, of):
            return None
        new = {name: change(getattr(found, name)) for name, change in changes.items()}
        return frame._replace(data=packed([(w, dataclasses.replace(found, **new))]))

    return changed


def dropped(of: type[Message], to_coordinator: bool) -> Change:
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
        (0, message(Prepare, tick=lambda tick: tick + 5), "a Prepare of tick"),
        (0, message(Prepare, episode=lambda episode: episode + 2), "a Prepare of tick"),
        (0, message(Prepare, source=lambda zone: 7), "it sends for zone 7, which it does not host"),
        (0, message(Prepare, target=lambda zone: 0), "it sends for zones (0,) to another node"),
        (0, dropped(Prepare, to_coordinator=False), "it has not offered vehicle"),
        (1, message(Ack, tick=one_more), "a Ack of tick"),
        (1, message(Ack, incarnation=one_more), "a Ack of tick"),
        (1, message(Ack, zone=lambda zone: 0), "sends for zone 0, which it does not host"),
        (1, dropped(Ack, to_coordinator=True), "its answer to an offer is missing"),
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
        content(b"]"),
        content(b'["node", 100000, [], false]'),
        as_kind(FrameKind.RESULT),
        lambda frame: frame._replace(data=frame.data.replace(b'"node", 1', b'"node", 2')),
    ],
)
def test_a_node_that_joins_with_a_wrong_frame_is_restarted_or_lost(
    monkeypatch: pytest.MonkeyPatch, change: Change
) -> None:
    """A node with a wrong address is lost because the other nodes cannot reach it."""
    forger = Forger(monkeypatch, FrameKind.READY, change, sender=NEW)
    found = verify_simulated_nodes("merge", [3], mixes=["none"], seeds=1, **BUSY)
    assert forger.frame is not None
    assert [text for text in found.lines[0].wrong if "must be tolerated" not in text] == []
    assert len(forger.lost) <= 1
