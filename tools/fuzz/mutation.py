"""Deterministic random damage to real files."""

from __future__ import annotations

import re
from collections.abc import Sequence
from random import Random

_NUMBERS = (0, 1, 2, 7, *(2**bits - less for bits in (7, 8, 15, 16, 31, 32, 63, 64) for less in (1, 0)))
_WRITTEN = b"0 -1 1e999 -0 nan inf 999999999999999999999999999999 true null [] {}".split()
_TEXTS = (
    *_WRITTEN, b"", b"[[[[[[[[", b'"', b"\n", b"\0", b"\r", b",", b";", b"\t", b"..", b"../../etc/passwd", b"/etc/passwd",
    b"C:\\x", b"%s%n", b"%00", b"%ff", b"&", b"\xff\xfe", b"\xef\xbb\xbf", "ä".encode(), "\u202e".encode(),
    "\U0001f6f0".encode(), b"<img src=x onerror=alert(1)>",
)  # fmt: skip
_NUMBER = re.compile(rb"-?\d+(\.\d+)?(e-?\d+)?")


def mutated(seeds: Sequence[bytes], rng: Random) -> bytes:
    """Damage one of the seed files with one to eight changes."""
    data = bytearray(rng.choice(seeds))
    for _ in range(rng.choice((1, 1, 1, 2, 2, 3, 5, 8))):
        _change(data, rng, rng.choice(seeds))
    return bytes(data[:2_000_000])


def _change(data: bytearray, rng: Random, other: bytes) -> None:
    kind, at = rng.choice(_CHANGES), _position(data, rng)
    if kind == "bit" and data:
        data[at % len(data)] ^= 1 << rng.randrange(8)
    elif kind == "number":
        width = rng.choice((1, 2, 4, 8))
        value = rng.choice(_NUMBERS) & (2 ** (8 * width) - 1)
        data[at : at + width] = value.to_bytes(width, rng.choice(("little", "big")))
    elif kind == "text":
        data[at : at + rng.choice((0, 1, 8))] = rng.choice(_TEXTS)
    elif kind == "written number" and (found := list(_NUMBER.finditer(data, 0, 100_000))):
        chosen = rng.choice(found)
        data[chosen.start() : chosen.end()] = rng.choice((*_WRITTEN, str(rng.choice(_NUMBERS)).encode()))
    elif kind == "cut":
        del data[at:]
    elif kind == "drop":
        del data[at : at + rng.choice((1, 4, 16, 64, len(data) // 4))]
    elif kind == "double":
        data[at:at] = data[at : at + rng.choice((1, 8, 32, 512))] * rng.choice((1, 2, 50))
    elif kind == "splice":
        start = rng.randrange(len(other) + 1)
        data[at:] = other[start : start + 100_000]
    elif kind == "noise":
        data[at : at + rng.choice((0, 1))] = rng.randbytes(rng.choice((1, 4, 64)))


_CHANGES = (
    "bit", "bit", "number", "number", "text", "written number", "cut", "drop", "double", "splice", "noise", "noise",
)  # fmt: skip


def _position(data: bytearray, rng: Random) -> int:
    """A random position, often near an end, where formats keep headers and indexes."""
    size = len(data)
    low, high = rng.choice(((0, size), (0, min(size, 256)), (max(size - 256, 0), size)))
    return rng.randint(low, max(high - 1, low))
