"""Rate limits of events and of wrong tokens."""

from __future__ import annotations

import pytest

from explorer.server.rate_limiter import GUESS_RATE, GUESSES, MAX_ADDRESSES, RateLimiter, TokenBucket


def test_a_token_bucket_allows_a_burst_and_then_a_rate() -> None:
    now = [0.0]
    bucket = TokenBucket(rate=2.0, burst=4.0, clock=lambda: now[0])
    assert [bucket.take() for _ in range(4)] == [0] * 4
    assert [bucket.take() for _ in range(3)] == pytest.approx([0.5, 1.0, 1.5])
    now[0] = 100.0
    assert [bucket.take() for _ in range(5)] == pytest.approx([0, 0, 0, 0, 0.5])


def test_an_address_is_blocked_after_too_many_wrong_tokens_and_recovers() -> None:
    now = [0.0]
    limiter = RateLimiter(lambda: now[0])
    for _ in range(int(GUESSES)):
        assert not limiter.blocked("1.2.3.4")
        limiter.wrong_token("1.2.3.4")
    assert limiter.blocked("1.2.3.4")
    assert not limiter.blocked("1.2.3.5"), "other addresses are not affected"
    now[0] = 1.01 / GUESS_RATE
    assert not limiter.blocked("1.2.3.4")
    limiter.wrong_token("1.2.3.4")
    assert limiter.blocked("1.2.3.4")


@pytest.mark.parametrize(
    ("guessing", "blocked", "free"),
    [
        ("2001:db8::{}", ["2001:db8::ffff:1"], "2001:db8:0:1::1"),
        ("::ffff:1.2.3.{}", [], "::ffff:1.2.3.4"),  # addresses of IPv4 count alone
        ("127.0.{}.9", ["127.0.0.1", "127.255.3.4", "::1", "::ffff:127.9.9.9"], "128.0.0.1"),
    ],
)
def test_addresses_of_one_ipv6_network_and_of_this_machine_count_as_one(
    guessing: str, blocked: list[str], free: str
) -> None:
    limiter = RateLimiter(lambda: 0.0)
    for number in range(int(GUESSES)):
        limiter.wrong_token(guessing.format(number))
    assert all(map(limiter.blocked, blocked))
    assert not limiter.blocked(free)


def test_few_addresses_are_remembered() -> None:
    limiter = RateLimiter(lambda: 0.0)
    for _ in range(int(GUESSES)):
        limiter.wrong_token("1.2.3.4")
    for number in range(MAX_ADDRESSES - 1):
        limiter.wrong_token(f"10.0.{number // 256}.{number % 256}")
    assert limiter.blocked("1.2.3.4")
    limiter.wrong_token("10.1.0.0")
    assert not limiter.blocked("1.2.3.4"), "the least recently used address is forgotten"
