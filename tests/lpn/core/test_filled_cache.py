"""The cache that keeps the first entries."""

from __future__ import annotations

from lpn.core.filled_cache import FilledCache


def test_values_are_made_once_while_there_is_room_and_then_each_time() -> None:
    made: list[int] = []
    cache = FilledCache[bytes](10, len)

    def value(size: int) -> bytes:
        made.append(size)
        return bytes(size)

    for _ in range(2):
        for size in (6, 5, 4, 3):
            assert cache.get(size, lambda size=size: value(size)) == bytes(size)
    assert made == [6, 5, 4, 3, 5, 3]  # 6 and 4 fill it, and stay
