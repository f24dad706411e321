"""Targets for the ownership protocol: messages, and the coordinator's log.

Checksums are corrected before the parser reads the input; otherwise, it would refuse each mutation
for its checksum.
"""

from __future__ import annotations

import json
import struct
import zlib
from contextlib import suppress

from cavmarl.ownership.codec import decode, encode
from cavmarl.ownership.directory import Directory
from cavmarl.ownership.endpoint import Endpoint
from cavmarl.ownership.ledger import OwnedTally, state_digest
from cavmarl.ownership.limits import Limits
from cavmarl.ownership.log_records import LogChain, replay, sealed
from cavmarl.ownership.messages import (
    Abort,
    Ack,
    Birth,
    Confirmed,
    Done,
    Held,
    In,
    Message,
    Nack,
    Need,
    Offer,
    Out,
    Prepare,
    Record,
    Refusal,
    Refused,
    Removed,
    Spawn,
    Step,
    Withdrawn,
)
from fuzz.files import Target

__all__ = ["LOGS", "MESSAGES"]

RUN = bytes(range(16))
CRC_BYTES = 4


class _OneState:
    """The store of a world whose vehicles all have the same state."""

    def state(self, vehicle: int) -> bytes:
        return b"state"

    def digest_of(self, vehicle: int) -> bytes:
        return state_digest(b"state")


def _message(content: bytes) -> Message:
    body = content[:-CRC_BYTES]
    return decode(body + struct.pack("<I", zlib.crc32(body)))


def _messages() -> tuple[bytes, ...]:
    digest = bytes(16)
    header = (RUN, 1, 12)
    enter, leave = (In(7, 4, True, digest, b"state"),), (Out(9, 2),)
    messages = (
        Step(*header, 3, 2, 11, enter, leave, (Spawn(10, b"new"),), OwnedTally(5, 17), b"ghosts"),
        Done(
            *header, 3, 2, (Confirmed(7, 4),), (Removed(9, 1),), OwnedTally(5, 17), 99, b"published"
        ),
        Prepare(*header, 3, 2, 4, 1, (Offer(7, 4, digest, b"state"),)),
        Ack(*header, 4, 1, 3, (Held(7, 4, digest),)),
        Nack(*header, 4, 1, 3, (Refused(7, 4, Refusal.LOAD),)),
        Abort(*header, 3, 2, 4, (Withdrawn(7, 4),)),
        Need(*header, 4, 1, (7, 8)),
    )
    return tuple(encode(message) for message in messages)


def _log(content: bytes) -> object:
    lines, last = [], ""
    for line in content.decode("utf-8", errors="replace").splitlines(keepends=True):
        lines.append(line)
        with suppress(ValueError, RecursionError):
            found = json.loads(line)
            if isinstance(found, dict):
                found = sealed(found, last)
                lines[-1], last = json.dumps(found, separators=(",", ":")) + "\n", found["checksum"]
    chain = LogChain()
    return replay(chain.read(line) for line in lines)


def _logs() -> tuple[bytes, ...]:
    """Return the log of two zones: a vehicle enters, changes its zone by force, and leaves."""
    log = list[Record]()
    directory = Directory(RUN, range(2), _OneState(), Limits(deferral=0))
    log += directory.reset().records
    endpoints = {}
    for zone in range(2):
        log += directory.host(zone, zone).records
        endpoints[zone] = Endpoint(directory.hosting(zone), Limits())
    for tick in range(3):
        births = [Birth(7, 0, b"state")] if tick == 0 else []
        output = directory.begin([(7, 1)] if tick == 1 else [], births)
        log += output.records
        for zone, step in enumerate(output.messages):
            endpoint = endpoints[zone]
            endpoint.on_message(step)
            gone = [Removed(7, 1)] if tick == 2 and 7 in endpoint.owned else []
            directory.on_message(endpoint.complete(0, gone))
        log += directory.commit({0: 0, 1: 0}).records
    chain = LogChain()
    lines = [chain.write(record) for record in log]
    return ("".join(lines).encode(), "".join(lines[:4]).encode())


MESSAGES = Target(_message, _messages)
LOGS = Target(_log, _logs)
