"""Tests of progress: who hears it, and how it is drawn with and without a terminal."""

from __future__ import annotations

import io
import threading

import pytest

from lpn.core import consoles, progress

# What a terminal gets when a bar goes: its line is cleared, and the cursor is shown.
SHOWN = "\r\x1b[2K\x1b[?25h\r"


def test_without_a_terminal_a_long_stage_writes_lines(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    moments = iter((0.0, 0.0, 10.0, 31.0, 40.0, 70.0, 110.0))
    monkeypatch.setattr(progress.time, "monotonic", lambda: next(moments))
    with consoles.progress_bars():
        for done in range(1, 6):
            progress.report_progress("Reading frames" if done < 5 else "Next, loss 0.5", done, 5000)
        progress.report_progress("Ended", 7, 7)
    said = capsys.readouterr()
    assert said.err.splitlines() == ["Reading frames: 3 of 5,000", "Next, loss 0.5: 5 of 5,000"]
    assert said.out == ""


def test_a_terminal_has_a_bar_of_each_stage_until_it_ends(monkeypatch: pytest.MonkeyPatch) -> None:
    drawn = io.StringIO()
    monkeypatch.setattr(consoles, "terminal", lambda: consoles.Console(file=drawn, force_terminal=True, width=80))
    with consoles.progress_bars():
        progress.report_progress("Ready before", 7, 7)
        assert drawn.getvalue() == "", "what is done has no bar"
        for stage in ("Describing tiles", "Describing queries", "Describing tiles"):
            progress.report_progress(stage, 1, 3)
            progress.report_progress(stage, 3, 3)
            assert drawn.getvalue().endswith(SHOWN), "its bar is deleted at its end"
        progress.report_progress("Stopped", 1, 3)
        assert not drawn.getvalue().endswith(SHOWN)
    assert drawn.getvalue().endswith(SHOWN)
    assert drawn.getvalue().count("\x1b[?25l") == 4
    assert "Ready before" not in drawn.getvalue()
    before = drawn.getvalue()
    progress.report_progress("Unheard", 1, 3)
    assert drawn.getvalue() == before


def test_lists_count_among_all_and_each_thread_has_a_listener_of_its_own() -> None:
    heard: list[tuple[str, int, int]] = []
    with progress.listening(lambda *told: heard.append(told)):
        with progress.counted_among(4, 10):
            assert list(progress.tracked("read", "ab", 2)) == ["a", "b"]
        thread = threading.Thread(target=progress.report_progress, args=("elsewhere", 1, 2))
        thread.start()
        thread.join()
        with progress.listening(lambda *_: None):
            progress.report_progress("inside", 1, 2)
        progress.report_progress("after", 1, 2)
    with progress.counted_among(4, 10):
        progress.report_progress("nobody", 1, 2)
    assert heard == [("read", 5, 10), ("read", 6, 10), ("after", 1, 2)]
