from __future__ import annotations

import asyncio
import threading
from collections.abc import Callable, Iterator

import pytest

from explorer.server import picture_route
from explorer.server.picture_route import PREFIX, EncodedPicture, PictureRoute
from lpn.core.errors import DataError


class SlowPictures:
    """Pictures that are computed when `may_end` is set; `computed` has the path of each computation."""

    def __init__(self) -> None:
        self.may_end, self.computed = threading.Event(), list[str]()

    def find(self, path: str) -> Callable[[], EncodedPicture]:
        def compute() -> EncodedPicture:
            self.computed.append(path)
            assert self.may_end.wait(60)
            if path == "broken":
                raise DataError("The sheet is damaged.")
            return EncodedPicture(path.encode(), "image/jpeg")

        return compute


@pytest.fixture
def slow() -> SlowPictures:
    return SlowPictures()


@pytest.fixture
def route(slow: SlowPictures) -> Iterator[PictureRoute]:
    route = PictureRoute(slow.find)
    yield route
    slow.may_end.set()
    route.close()


async def begun(*requests: tuple[PictureRoute, str, str]) -> list[asyncio.Task[int]]:
    """Send requests, of a route, a path, and an address, and return the tasks of their statuses once all have arrived."""

    async def status(route: PictureRoute, path: str, address: str) -> int:
        return (await route.respond(PREFIX + path, address)).status_code

    tasks = [asyncio.create_task(status(*request)) for request in requests]
    await asyncio.sleep(0)
    return tasks


def test_equal_requests_share_one_computation_and_leave_a_thread_to_others(
    route: PictureRoute, slow: SlowPictures
) -> None:
    async def run() -> list[int]:
        tasks = await begun(*((route, "tile", "a") for _ in range(5)), (route, "other", "b"))
        while len(slow.computed) < 2:
            await asyncio.sleep(0.01)
        slow.may_end.set()
        return await asyncio.gather(*tasks)

    assert asyncio.run(run()) == [200] * 6
    assert sorted(slow.computed) == ["other", "tile"]


def test_a_slow_picture_is_answered_before_the_gateway_aborts_and_is_there_for_a_later_request(
    route: PictureRoute, slow: SlowPictures, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(picture_route, "_PATIENCE", 0.01)

    async def run() -> list[int]:
        first = await (await begun((route, "tile", "")))[0]
        monkeypatch.setattr(picture_route, "_PATIENCE", 60)
        (later,) = await begun((route, "tile", ""))
        later.cancel()  # the browser goes away
        (last,) = await begun((route, "tile", ""))
        slow.may_end.set()
        return [first, await last]

    assert asyncio.run(run()) == [503, 200]
    assert slow.computed == ["tile"]


def test_one_address_cannot_take_all_places(
    route: PictureRoute, slow: SlowPictures, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(picture_route, "_MAX_WAITING", 3)
    monkeypatch.setattr(picture_route, "_MAX_WAITING_FOR_ONE", 2)

    async def run() -> list[int]:
        tasks = await begun(*((route, path, address) for path, address in ("1a", "2a", "3a", "1b", "4b", "5c")))
        slow.may_end.set()
        return await asyncio.gather(*tasks)

    # The fourth request joins the first.
    assert asyncio.run(run()) == [200, 200, 503, 200, 200, 503]


def test_a_route_that_closes_answers_503(route: PictureRoute, slow: SlowPictures) -> None:
    async def run() -> list[int]:
        tasks = await begun(*((route, str(i), "") for i in range(3)))
        while len(slow.computed) < 2:
            await asyncio.sleep(0.01)
        route.close()
        tasks += await begun((route, "late", ""))
        slow.may_end.set()
        return await asyncio.gather(*tasks)

    assert asyncio.run(run()) == [200, 200, 503, 503]


def test_the_error_of_a_picture_is_logged_once(
    route: PictureRoute, slow: SlowPictures, caplog: pytest.LogCaptureFixture
) -> None:
    slow.may_end.set()

    async def run() -> list[int]:
        return [await (await begun((route, "broken", "")))[0] for _ in range(3)]

    assert asyncio.run(run()) == [500] * 3
    assert [record.getMessage() for record in caplog.records] == ["A picture cannot be shown: The sheet is damaged."]
    assert len(slow.computed) == 3


def test_letters_and_digits_of_other_scripts_are_no_path(route: PictureRoute, slow: SlowPictures) -> None:
    slow.may_end.set()

    async def run() -> list[int]:
        return [await (await begun((route, path, "")))[0] for path in ("tile/1", "tile/\u0661")]

    assert asyncio.run(run()) == [200, 404]


def test_an_empty_picture_is_no_error() -> None:
    route = PictureRoute(lambda _: lambda: EncodedPicture(b"", "application/json"))
    assert asyncio.run(route.respond("/pictures/ended/0")).status_code == 204
    route.close()
