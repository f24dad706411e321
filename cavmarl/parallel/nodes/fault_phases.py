"""What a plan of faults does to the protocol's messages of one process, phase by phase.

With a plan the messages between zones, and those of zones and the coordinator, go in phases that
the caller leads: what is sent in one arrives in the next, at all nodes, or later, or never. Each
process has a `Network` for what it sends; what becomes of a message is a function of the plan's
seed and of the message, wherever its zone is hosted.
"""

from __future__ import annotations

import json
import struct
from collections import Counter
from collections.abc import Iterable, Sequence
from typing import NamedTuple

from cavmarl.config.zones import ZonesConfig
from cavmarl.core.errors import ConfigError, MessageError
from cavmarl.handoff.coordinator.coordinator_setup import check_faults
from cavmarl.handoff.fault_injection.fault_plan import Faults
from cavmarl.ownership.codec import decode, encode
from cavmarl.ownership.messages import Message
from cavmarl.ownership.transport import FaultPlan, Network
from cavmarl.parallel.nodes.link import Bytes

_PARCEL = struct.Struct("<IiBI")
_SIZE = struct.Struct("<I")


class Parcel(NamedTuple):
    """A message of a world at its destination."""

    w: int
    destination: int  # a zone, or COORDINATOR
    message: Message
    is_refused: bool  # the target of a PREPARE is to answer with a NACK


class Told(NamedTuple):
    """How the caller begins a phase."""

    phase: int  # counted from when nodes were lost last
    again: bool  # what was offered and not answered is offered once more
    harms: bool  # whether anything happens to messages, and nodes
    tick: int  # the lease that is under way, of those with ticks, also of those done again


class Said(NamedTuple):
    """How a node has ended it."""

    arrived: int  # messages that came to its zones
    owed: int  # offers that have not been answered
    unleased: list[tuple[int, int]]  # world and zone of those without a lease
    injected: list[tuple[str, str, int]]  # kind, fault, how often since the last phase


class PhasedPost:
    """Takes the messages of one process, and gives them back when they arrive."""

    def __init__(self, faults: Faults, num_worlds: int) -> None:
        self._plans = FaultPlan(), faults.plan()
        self._networks = [Network(self._plans[True]) for _ in range(num_worlds)]
        self.phase = 0

    def begin(self, harms: bool) -> None:
        """Let the plan happen to messages from now on, or nothing."""
        for network in self._networks:
            network.plan = self._plans[harms]

    def send(self, w: int, messages: Iterable[Message]) -> None:
        self._networks[w].send(messages)

    def deliver(self) -> list[Parcel]:
        """Begin the next phase: what arrives in it, in order."""
        self.phase += 1
        return [
            Parcel(w, *delivery)
            for w, network in enumerate(self._networks)
            for delivery in network.deliver()
        ]

    def take_injected(self) -> Counter[tuple[str, str]]:
        """(kind, fault) → how often since this was asked last."""
        found: Counter[tuple[str, str]] = Counter()
        for network in self._networks:
            found += network.faults
            network.faults.clear()
        return found


def packed_parcels(head: Told | Said | None, parcels: Sequence[Parcel]) -> list[Bytes]:
    """The data of a frame: a head as JSON, and messages one after the other."""
    said = json.dumps(head).encode()
    pieces: list[Bytes] = [_SIZE.pack(len(said)), said]
    for w, destination, message, is_refused in parcels:
        data = encode(message)
        pieces += (_PARCEL.pack(w, destination, is_refused, len(data)), data)
    return pieces


def unpacked_parcels(data: memoryview) -> tuple[list[object], list[Parcel]]:
    """The same, read. Raises MessageError: it is none."""
    try:
        (size,) = _SIZE.unpack_from(data)
        at = _SIZE.size + size
        head: list[object] = json.loads(bytes(data[_SIZE.size : at]))
        parcels = []
        while at < len(data):
            w, destination, is_refused, size = _PARCEL.unpack_from(data, at)
            at += _PARCEL.size
            message = decode(bytes(data[at : at + size]))
            parcels.append(Parcel(w, destination, message, bool(is_refused)))
            at += size
    except (ValueError, RecursionError, struct.error, MessageError) as error:
        raise MessageError(f"no messages of a phase: {error}") from error
    return head, parcels


def node_faults(settings: ZonesConfig, zones: int, num_worlds: int) -> Faults | None:
    """The plan of worlds over nodes; None: there is none.

    Raises:
        ConfigError: it has what cannot happen to nodes.
    """
    faults, _ = check_faults(settings, zones, num_worlds)
    if faults is None:
        return None
    refused = {
        "crash_rate": (
            faults.crash_rate,
            "a node takes seconds to come back, and a run ends when the one that keeps its state "
            "dies before; name deaths in crashes",
        ),
        "crashes without a zone": (
            any(crash.zone is None for crash in faults.crashes),
            "the coordinator is in the caller's process; name a zone",
        ),
        "crashes, lives_on": (
            any(crash.lives_on for crash in faults.crashes),
            "the process of a node that is given up is killed; leave it out",
        ),
        "crashes, times": (
            any(crash.times > 1 for crash in faults.crashes),
            "a tick of the protocol never comes again after nodes have gone back; name several",
        ),
    }
    for key, (is_there, why) in refused.items():
        if is_there:
            raise ConfigError(f"zones.faults, {key}: not over nodes: {why}")
    return faults
