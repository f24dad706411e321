"""The binary schema of messages must not change, so that recorded bytes stay readable."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

from cavmarl.core.errors import MessageError
from cavmarl.v2x.kernels.v2x_records import KIND_CAM, KIND_CPM, KIND_DENM, KIND_SPAT, PACKET, REPORT
from cavmarl.v2x.v2x_messages import HEADER, KINDS, SCHEMA_VERSION, decode, encode

GOLDEN = Path(__file__).parent / "messages.golden.txt"


def example(kind: int, count: int = 1) -> bytes:
    """Return a packet with a different number in each field."""
    reports = np.zeros(count, REPORT)
    for place, name in enumerate(REPORT.names or ()):
        reports[name] = 2 * place + np.arange(count)
    reports["kind"] = kind
    packet = np.zeros((), PACKET)
    packet["sender"], packet["tick"], packet["x"], packet["y"] = 7, 41, 1.5, -2.5
    packet["kind"], packet["count"] = kind, count
    return encode(packet, reports)


def test_the_bytes_equal_the_recorded_bytes() -> None:
    lines = [f"schema version {SCHEMA_VERSION}"]
    for kind, name in ((KIND_CAM, "CAM"), (KIND_DENM, "DENM"), (KIND_CPM, "CPM"),
                       (KIND_SPAT, "SPAT")):  # fmt: skip
        lines.append(f"{name} {example(kind, 2 if kind == KIND_CPM else 1).hex()}")
    written = "\n".join(lines) + "\n"
    if os.environ.get("CAVMARL_REWRITE"):
        GOLDEN.write_text(written, encoding="utf-8")
    assert GOLDEN.read_text(encoding="utf-8") == written, "a change needs a new SCHEMA_VERSION"


@pytest.mark.parametrize("kind", KINDS)
def test_decoded_messages_equal_encoded_ones(kind: int) -> None:
    header, records = decode(example(kind, 3))
    assert (header["kind"], header["count"], header["sender"]) == (kind, 3, 7)
    assert (header["x"], header["y"], header["tick"]) == (1.5, -2.5, 41)
    assert records.dtype == KINDS[kind]
    assert records["sender"].tolist() == [2, 3, 4]


def test_invalid_bytes_are_refused() -> None:
    data = example(KIND_CAM)
    with pytest.raises(MessageError, match="3 bytes are no message"):
        decode(data[:3])
    with pytest.raises(MessageError, match="version 9: only version 1"):
        decode(b"\x09\x00" + data[2:])
    with pytest.raises(MessageError, match="kind 8"):
        decode(data[:2] + b"\x08\x00" + data[4:])
    with pytest.raises(MessageError, match=f"1 records need {len(data)}"):
        decode(data + b"\x00")
    with pytest.raises(MessageError, match="4294967295 records need"):
        decode(data[:4] + b"\xff\xff\xff\xff" + data[8:])
    assert HEADER.itemsize == 40
