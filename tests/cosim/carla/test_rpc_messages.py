"""Requests of CARLA's clients: accepted requests, and bytes that end the connection."""

from __future__ import annotations

import msgpack
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cavmarl.core.errors import MessageError
from cavmarl.cosim.carla.rpc_messages import Request, RequestReader, pack_answer

MOST = 1 << 16


def packed(number: int, name: str, *arguments: object) -> bytes:
    return bytes(msgpack.packb([0, number, name, [[False], *arguments]]))


def test_requests_are_read_without_metadata_however_their_bytes_are_split() -> None:
    data = packed(1, "version") + packed(2, "tick", 1.5, "é", [True])
    for size in (1, 3, len(data)):
        reader = RequestReader(MOST)
        parts = [data[k : k + size] for k in range(0, len(data), size)]
        found = [request for part in parts for request in reader.read(part)]
        assert found == [Request(1, "version", []), Request(2, "tick", [1.5, "é", [True]])]


def test_notifications_are_ignored() -> None:
    data = msgpack.packb([2, "notify", []]) + packed(7, "version")
    assert list(RequestReader(MOST).read(data)) == [Request(7, "version", [])]


@pytest.mark.parametrize(
    "data",
    [
        b"GET / HTTP/1.1\r\n\r\n",
        msgpack.packb("text"),
        msgpack.packb([]),
        msgpack.packb([0, 1]),
        msgpack.packb([0, 1, "version", []]),
        msgpack.packb([0, "one", "version", [[False]]]),
        msgpack.packb({"a": 1}),
        b"\xc1",
        b"\xdd\xff\xff\xff\xff",
        b"\x91" * 5000,
        packed(1, "get_map", "x" * (2 * MOST)),
    ],
    ids=["http", "text", "empty", "short", "no metadata", "number", "map", "code", "array",
         "deep", "oversized"],
)  # fmt: skip
def test_other_bytes_are_refused(data: bytes) -> None:
    with pytest.raises(MessageError, match="not a request of CARLA's client"):
        list(RequestReader(MOST).read(data))


@given(st.binary(max_size=200))
def test_any_bytes_are_read_or_refused(data: bytes) -> None:
    try:
        found = list(RequestReader(MOST).read(data))
    except MessageError:
        return
    assert all(isinstance(request, Request) for request in found)


def test_an_incomplete_request_is_kept_until_it_is_complete() -> None:
    data = packed(1, "version")
    reader = RequestReader(MOST)
    assert list(reader.read(data[:-1])) == []
    assert list(reader.read(data[-1:])) == [Request(1, "version", [])]


def test_the_buffer_for_an_incomplete_message_is_limited() -> None:
    reader = RequestReader(MOST)

    def send_text_of_4_gb() -> int:
        sent = 0
        for part in (b"\xdb\xff\xff\xff\xff", *[b"x" * 1024] * (2 * MOST // 1024)):
            sent += len(list(reader.read(part)))
        return sent

    with pytest.raises(MessageError, match="not a request of CARLA's client"):
        send_text_of_4_gb()


def test_an_answer_has_error_and_result() -> None:
    assert msgpack.unpackb(pack_answer(3, None, [[1, b"x"]])) == [1, 3, None, [[1, b"x"]]]
