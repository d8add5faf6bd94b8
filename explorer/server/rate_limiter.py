"""Slows down who gives wrong tokens, by address."""

from __future__ import annotations

import ipaddress
import time
from collections import Counter, OrderedDict
from collections.abc import Callable

FIRST, LONGEST = 0.25, 5.0
"""Seconds that the first wrong token waits for its answer, and the longest that any does; each waits twice the one before."""
FORGET = 600.0
"""Seconds after which an address that gave no further wrong token is as good as new."""
WAITING, ALL_WAITING = 4, 64
"""Answers that may wait at a time, of one address and of all."""
KEPT = 1000
"""Addresses that are remembered; beyond, the oldest are forgotten."""


class RateLimiter:
    """Counts wrong tokens by address. Used from one thread.

    A right token is never made to wait. While WAITING wrong ones of an address wait, further tokens of that address
    are turned away unread: at most WAITING in LONGEST seconds can be tried.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._wrong: OrderedDict[str, tuple[int, float]] = OrderedDict()
        self._waiting: Counter[str] = Counter()

    def full(self, address: str) -> bool:
        """Whether a token of this address is turned away unread."""
        return self._waiting[_of(address)] >= WAITING or self._waiting.total() >= ALL_WAITING

    def enter(self, address: str) -> float:
        """A wrong token of this address: seconds its answer has to wait; `leave` when it has."""
        key, now = _of(address), self._clock()
        before, last = self._wrong.pop(key, (0, now))
        count = 0 if now - last > FORGET else before
        self._wrong[key] = count + 1, now
        while len(self._wrong) > KEPT:
            self._wrong.popitem(last=False)
        self._waiting[key] += 1
        return float(min(FIRST * 2 ** min(count, 30), LONGEST))

    def leave(self, address: str) -> None:
        """The answer is given."""
        key = _of(address)
        self._waiting[key] -= 1
        if self._waiting[key] <= 0:
            del self._waiting[key]

    def __len__(self) -> int:
        return len(self._wrong)


def _of(address: str) -> str:
    """The address; of IPv6, its network of 64 bits, all of which is one household's."""
    try:
        known = ipaddress.ip_address(address.partition("%")[0])
    except ValueError:
        return address
    if isinstance(known, ipaddress.IPv6Address) and known.ipv4_mapped is None:
        return str(ipaddress.ip_network((known, 64), strict=False))
    return str(known)
