"""Deterministic random damage to real files."""

from __future__ import annotations

import re
from collections.abc import Sequence
from random import Random

_NUMBERS = (
    0,
    1,
    2,
    7,
    0x7F,
    0x80,
    0xFF,
    0x7FFF,
    0x8000,
    0xFFFF,
    2**31 - 1,
    2**31,
    2**32 - 1,
    2**63 - 1,
    2**63,
    2**64 - 1,
)
_TEXTS = (
    *(
        b"",
        b"0",
        b"-1",
        b"1e999",
        b"-0",
        b"nan",
        b"inf",
        b"9" * 30,
        b"true",
        b"null",
        b"[]",
        b"{}",
        b"[[[[[[[[",
        b'"',
        b"\n",
    ),
    *(
        b"\0",
        b"\r",
        b",",
        b";",
        b"\t",
        b"..",
        b"../../etc/passwd",
        b"/etc/passwd",
        b"C:\\x",
        b"%s%n",
        b"%00",
        b"%ff",
        b"&",
    ),
    *(
        b"\xff\xfe",
        b"\xef\xbb\xbf",
        "ä".encode(),
        "\u202e".encode(),
        "\U0001f6f0".encode(),
        b"<img src=x onerror=alert(1)>",
    ),
)
_NUMBER = re.compile(rb"-?\d+(\.\d+)?(e-?\d+)?")


def mutated(seeds: Sequence[bytes], rng: Random) -> bytes:
    """Damage one of the seed files with one to eight changes."""
    data = bytearray(rng.choice(seeds))
    for _ in range(rng.choice((1, 1, 1, 2, 2, 3, 5, 8))):
        rng.choice(_CHANGES)(data, rng, seeds)
    return bytes(data[:2_000_000])


def _at(data: bytearray, rng: Random) -> int:
    """A random position, often near an end, where formats keep headers and indexes."""
    size = len(data)
    low, high = rng.choice(((0, size), (0, min(size, 256)), (max(size - 256, 0), size)))
    return rng.randint(low, max(high - 1, low))


def _flip(data: bytearray, rng: Random, _: Sequence[bytes]) -> None:
    if data:
        data[_at(data, rng) % len(data)] ^= 1 << rng.randrange(8)


def _byte(data: bytearray, rng: Random, _: Sequence[bytes]) -> None:
    if data:
        data[_at(data, rng) % len(data)] = rng.randrange(256)


def _number(data: bytearray, rng: Random, _: Sequence[bytes]) -> None:
    width, position = rng.choice((1, 2, 4, 8)), _at(data, rng)
    value = rng.choice(_NUMBERS) & (2 ** (8 * width) - 1)
    data[position : position + width] = value.to_bytes(width, rng.choice(("little", "big")))


def _text(data: bytearray, rng: Random, _: Sequence[bytes]) -> None:
    position = _at(data, rng)
    data[position : position + rng.choice((0, 1, 8))] = rng.choice(_TEXTS)


def _written_number(data: bytearray, rng: Random, _: Sequence[bytes]) -> None:
    found = list(_NUMBER.finditer(data, 0, 100_000))
    if found:
        chosen = rng.choice(found)
        data[chosen.start() : chosen.end()] = rng.choice((*_TEXTS[:12], str(rng.choice(_NUMBERS)).encode()))


def _cut(data: bytearray, rng: Random, _: Sequence[bytes]) -> None:
    del data[_at(data, rng) :]


def _drop(data: bytearray, rng: Random, _: Sequence[bytes]) -> None:
    position = _at(data, rng)
    del data[position : position + rng.choice((1, 4, 16, 64, len(data) // 4))]


def _double(data: bytearray, rng: Random, _: Sequence[bytes]) -> None:
    start = _at(data, rng)
    part = data[start : start + rng.choice((1, 8, 32, 512))]
    data[start:start] = part * rng.choice((1, 2, 50))


def _swap(data: bytearray, rng: Random, _: Sequence[bytes]) -> None:
    one, other, size = _at(data, rng), _at(data, rng), rng.choice((1, 4, 16))
    first, second = data[one : one + size], data[other : other + size]
    data[one : one + size], data[other : other + size] = second, first


def _splice(data: bytearray, rng: Random, seeds: Sequence[bytes]) -> None:
    other = rng.choice(seeds)
    start = rng.randrange(len(other) + 1)
    data[_at(data, rng) :] = other[start : start + 100_000]


def _noise(data: bytearray, rng: Random, _: Sequence[bytes]) -> None:
    position = _at(data, rng)
    data[position:position] = rng.randbytes(rng.choice((1, 4, 64)))


_CHANGES = (_flip, _flip, _byte, _number, _number, _text, _written_number, _cut, _drop, _double, _swap, _splice, _noise)
