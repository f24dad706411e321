"""Decoded messages equal encoded messages, and other bytes are refused."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from cavmarl.core.errors import MessageError
from cavmarl.ownership.codec import KINDS, VERSION, decode, encode
from cavmarl.ownership.ledger import OwnedTally
from cavmarl.ownership.messages import (
    Abort,
    Ack,
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
    Refusal,
    Refused,
    Removed,
    Spawn,
    Step,
    Withdrawn,
)

RUN = bytes(range(16))
DIGEST = bytes(16)
GOLDEN = Path(__file__).parent / f"messages_v{VERSION}.hex"

MESSAGES: tuple[Message, ...] = (
    Step(
        RUN, 1, 12, 3, 2, 11,
        enter=(In(7, 4, True, DIGEST, b"state"), In(8, 1, False, DIGEST, b"")),
        leave=(Out(9, 2),), spawn=(Spawn(10, b"new"),),
        owned=OwnedTally(5, (1 << 64) - 1), payload=b"ghosts",
    ),
    Done(
        RUN, 1, 12, 3, 2, confirmed=(Confirmed(7, 4),), removed=(Removed(9, 1),),
        owned=OwnedTally(5, 17), rows=(1 << 128) - 1, payload=b"published",
    ),
    Prepare(RUN, 1, 12, 3, 2, 4, 1, (Offer(7, 4, DIGEST, b"state"),)),
    Ack(RUN, 1, 12, 4, 1, 3, (Held(7, 4, DIGEST), Held(8, 0, DIGEST))),
    Nack(RUN, 1, 12, 4, 1, 3, (Refused(7, 4, Refusal.SCHEMA),)),
    Abort(RUN, 1, 12, 3, 2, 4, (Withdrawn(7, 4),)),
    Need(RUN, 1, 12, 4, 1, (7, 8)),
)  # fmt: skip


@pytest.mark.parametrize("message", MESSAGES, ids=lambda message: type(message).__name__)
def test_a_decoded_message_equals_the_encoded_message(message: Message) -> None:
    assert decode(encode(message), RUN) == message


def test_these_tests_have_a_sample_of_every_kind_of_message() -> None:
    assert {type(message) for message in MESSAGES} == set(KINDS)


def test_the_bytes_of_messages_equal_the_recorded_bytes() -> None:
    assert GOLDEN.read_text().split() == [encode(message).hex() for message in MESSAGES]


@pytest.mark.parametrize("message", MESSAGES, ids=lambda message: type(message).__name__)
def test_messages_that_are_too_short_or_too_long_are_refused(message: Message) -> None:
    wire = encode(message)
    for length in range(len(wire)):
        with pytest.raises(MessageError):
            decode(wire[:length])
    with pytest.raises(MessageError):
        decode(wire + b"\0")


@pytest.mark.parametrize("message", MESSAGES, ids=lambda message: type(message).__name__)
def test_a_message_with_any_flipped_bit_is_refused(message: Message) -> None:
    wire = encode(message)
    for bit in range(8 * len(wire)):
        damaged = bytearray(wire)
        damaged[bit // 8] ^= 1 << bit % 8
        with pytest.raises(MessageError):
            decode(bytes(damaged))


def with_checksum(body: bytes) -> bytes:
    import struct
    import zlib

    return body + struct.pack("<I", zlib.crc32(body))


def test_refused_bytes_raise_errors_with_the_reason() -> None:
    wire = encode(MESSAGES[3])
    with pytest.raises(MessageError):
        decode(wire[:5])
    with pytest.raises(MessageError, match="begins with"):
        decode(b"HTTP" + wire[4:])
    with pytest.raises(MessageError, match="version 9"):
        decode(wire[:4] + b"\x09" + wire[5:])
    with pytest.raises(MessageError, match="kind 200"):
        decode(with_checksum(wire[:6] + b"\xc8" + wire[7:-4]))
    with pytest.raises(MessageError, match="follow"):
        decode(with_checksum(wire[:-4] + b"more"))
    with pytest.raises(MessageError, match=r"incomplete|ends inside"):
        decode(with_checksum(wire[:-9]))
    with pytest.raises(MessageError, match=RUN.hex()):
        decode(wire, run=bytes(16))
    nack = encode(MESSAGES[4])
    with pytest.raises(MessageError, match="is not one of"):
        decode(with_checksum(nack[:-12] + b"\x63" + nack[-11:-4]))


@given(st.binary(max_size=200))
def test_arbitrary_bytes_are_refused(data: bytes) -> None:
    for wire in (data, with_checksum(b"CVMO\x01\x00\x00\x00" + data)):
        try:
            message = decode(wire)
        except MessageError:
            continue
        assert decode(encode(message)) == message


@given(
    st.lists(
        st.tuples(
            st.integers(0, 2**62), st.integers(0, 2**62), st.binary(max_size=20), st.binary()
        ),
        max_size=4,
    ),
    st.integers(0, 2**62),
)
def test_any_decoded_offer_equals_the_encoded_offer(
    entries: list[tuple[int, int, bytes, bytes]], tick: int
) -> None:
    message = Prepare(RUN, 0, tick, 0, 1, 1, 1, tuple(Offer(*entry) for entry in entries))
    assert decode(encode(message)) == message
