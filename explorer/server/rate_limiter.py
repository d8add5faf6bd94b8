"""Rate limits by token buckets, with one bucket for each address that guesses access tokens."""

from __future__ import annotations

import ipaddress
import time
from collections import OrderedDict
from collections.abc import Callable

# Wrong access tokens that an address may send at once, and for each second.
GUESSES, GUESS_RATE = 10.0, 0.5
# Number of remembered addresses; the least recently used are forgotten.
MAX_ADDRESSES = 1000


class TokenBucket:
    """A rate limit: `rate` events a second, and `burst` at once. Not thread-safe."""

    def __init__(self, rate: float, burst: float, clock: Callable[[], float] = time.monotonic) -> None:
        self._rate, self._burst, self._clock = rate, burst, clock
        self._level, self._updated = burst, clock()

    def level(self) -> float:
        """Return the number of events allowed now; negative while events wait."""
        now = self._clock()
        self._level = min(self._level + self._rate * (now - self._updated), self._burst)
        self._updated = now
        return self._level

    def take(self) -> float:
        """Count one event; return the seconds until the rate allows it."""
        self._level = self.level() - 1
        return max(-self._level / self._rate, 0.0)


class RateLimiter:
    """Limits guesses of the access token by address. Not thread-safe.

    Random tokens of 256 bits need no limit. Tokens that a user chose do: they may be as short as 12 characters.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._buckets: OrderedDict[str, TokenBucket] = OrderedDict()

    def blocked(self, address: str) -> bool:
        """Return whether this address sent too many wrong tokens, so that its next one must not be compared."""
        bucket = self._buckets.get(_network(address))
        return bucket is not None and bucket.level() < 1

    def wrong_token(self, address: str) -> None:
        """Count a wrong token."""
        key = _network(address)
        self._buckets.setdefault(key, TokenBucket(GUESS_RATE, GUESSES, self._clock)).take()
        self._buckets.move_to_end(key)
        if len(self._buckets) > MAX_ADDRESSES:
            self._buckets.popitem(last=False)


def _network(address: str) -> str:
    """Return the guesser behind an address: this machine, an IPv4 address, or a household's IPv6 network (/64)."""
    try:
        ip = ipaddress.ip_address(address.partition("%")[0])
    except ValueError:
        return address
    if isinstance(ip, ipaddress.IPv6Address):
        ip = ip.ipv4_mapped or ip
    if ip.is_loopback:  # a program here may choose any of 127.0.0.0/8
        return "loopback"
    return str(ip if ip.version == 4 else ipaddress.ip_network((ip, 64), strict=False))
