"""The screen's computations without a server, and a workspace of places with known positions."""

from __future__ import annotations

import csv
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from itertools import cycle
from pathlib import Path
from queue import Queue
from typing import Any

import pytest

from explorer.opening import open_model
from explorer.screen.fields import needs_answer
from explorer.screen.result import ScreenResult
from explorer.screen.session import Screens, ScreenSession
from explorer.workspace import Workspace
from tools.fixtures import small_worlds
from tools.fixtures.waiting import TIMEOUT

TASK = "drone-to-satellite"


class RefusedError(Exception):
    """The sentence that the page shows in place of a result."""


def answered(workspace: Workspace, search: str = "", own: bytes = b"", **fields: object) -> ScreenResult:
    """Return the result of a page's address, after an own photo was sent and some fields were set.

    Raises:
        RefusedError: with the sentence that the page shows instead.
    """
    messages = Queue[dict[str, Any]]()
    screens = Screens(lambda _: workspace, workspace.key, {workspace.key: workspace.data_name})
    session = ScreenSession(screens, messages.put)
    try:
        session.receive({"do": "open", "args": {"search": search}})
        if own:
            session.receive({"do": "upload", "args": {"name": "mine.png", "size": len(own)}})
            session.receive_bytes(own)
        if fields:
            session.receive({"set": fields})
        while True:
            message = messages.get(timeout=TIMEOUT)
            if "error" in message:
                raise RefusedError(message["error"])
            if own and not session.state.own:  # it was refused, which a message says
                continue
            result = session.result
            if "result" in message and result is not None and not needs_answer(result.state, session.state):
                return result
    finally:
        session.leave()


@contextmanager
def mapped_workspace(
    folder: Path, model: Path, baseline: Path, places: int = 8, columns: Mapping[str, Sequence[str]] | None = None
) -> Iterator[Workspace]:
    """Open places on a map under an LPN of four parts, with the baseline beside it; all queries are ranked.

    Args:
        columns: metadata of the queries: names, and values that the queries take in turn.
    """
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("LPN_CACHE", str(folder / "cache"))
        data = small_worlds.map_dataset(small_worlds.make_dataset(folder / "places", train=1, test=places))
        if columns:
            files = sorted((data / "test" / "query_drone").rglob("*.png"))
            paths = (file.relative_to(data).as_posix() for file in files)
            with (data / "metadata.csv").open("w", newline="") as written:
                csv.writer(written).writerows(
                    [["path", *columns], *zip(paths, *map(cycle, columns.values()), strict=False)]
                )
        opened = open_model(data, model, baseline=baseline)
        for ranking in opened.rankings.values():
            ranking.wait(opened, lambda *_: None)
        yield opened
