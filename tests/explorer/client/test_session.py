"""A browser's session: what a change of its state does to what is told."""

from __future__ import annotations

from contextlib import nullcontext
from dataclasses import replace
from typing import Any
from unittest.mock import MagicMock

import pytest

from explorer.client.session import ClientSession
from explorer.session_state import SessionState


@pytest.mark.parametrize(
    ("shown", "failed", "forgotten"),
    [(False, False, False), (False, True, True), (True, False, True)],
    ids=["an error of the address", "an error of the first picture", "an error of a later picture"],
)
def test_an_error_goes_with_the_next_picture_and_that_of_an_address_stays_until_the_first(
    shown: bool, failed: bool, forgotten: bool
) -> None:
    session: Any = MagicMock(
        _lock=nullcontext(), _state=SessionState("drone-to-satellite", 4), _shown=object() if shown else None
    )
    session._workspace.supported_state.side_effect = lambda state: state
    session._worker.failed = failed
    ClientSession.change(session, lambda state: replace(state, query=1))
    assert session._state.query == 1
    assert session.views.panels.forget_error.called == forgotten
