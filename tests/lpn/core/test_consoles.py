"""Tests of progress where there is no terminal."""

from __future__ import annotations

import pytest

from lpn.core import consoles, progress


def test_without_a_terminal_a_long_stage_writes_lines(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    moments = iter((0.0, 0.0, 10.0, 31.0, 40.0, 70.0))
    monkeypatch.setattr(progress.time, "monotonic", lambda: next(moments))
    with consoles.progress_bars():
        for done in range(1, 6):
            progress.report_progress("Reading frames", done, 5000)
    said = capsys.readouterr()
    assert said.err.splitlines() == ["Reading frames: 3 of 5,000", "Reading frames: 5 of 5,000"]
    assert said.out == ""
