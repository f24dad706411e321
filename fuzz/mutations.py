"""Mutations that keep most of a file valid, so that the fuzzer reaches code behind tokenizers."""

from __future__ import annotations

import random
import re

__all__ = ["mutated"]

MAX_CHANGES = 4
_BORDER = re.compile(rb'(?=[<>"\'\s:,{}\[\]=/])')
_ODD = (
    *(
        b"",
        b"0",
        b"-1",
        b"1",
        b"0.5",
        b"-0.0",
        b"nan",
        b"inf",
        b"-inf",
        b"1e308",
        b"1e-308",
        b"1e9",
    ),
    *(b"2147483648", b"-9223372036854775809", b"9" * 40, b"0x10", b"1_0", b"true", b"null", b"~"),
    *(b"\x00", b"\xff\xfe", b"\xef\xbb\xbf", "é".encode(), "٣".encode(), b"\r\n", b":", b"a" * 300),
)


def mutated(content: bytes, rng: random.Random) -> bytes:
    """Return `content` with some pieces dropped, doubled, exchanged or replaced by odd values."""
    pieces = _BORDER.split(content)
    for _ in range(rng.randint(1, MAX_CHANGES)):
        at, other = rng.randrange(len(pieces)), rng.randrange(len(pieces))
        match rng.randrange(6):
            case 0 if len(pieces) > 1:
                del pieces[at]
            case 1:
                pieces.insert(at, pieces[other])
            case 2:
                pieces[at], pieces[other] = pieces[other], pieces[at]
            case 3:
                pieces[at] = pieces[other]
            case 4:
                pieces[at] = _with_bit_flipped(pieces[at], rng)
            case _:
                pieces[at] = pieces[at][:1] + rng.choice(_ODD)
    return b"".join(pieces)


def _with_bit_flipped(piece: bytes, rng: random.Random) -> bytes:
    changed = bytearray(piece or b" ")
    changed[rng.randrange(len(changed))] ^= 1 << rng.randrange(8)
    return bytes(changed)
