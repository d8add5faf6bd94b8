"""The handle of a served page: its display in a notebook, and its end."""

from __future__ import annotations

import threading

import pytest

from lpn.core.served_page import ServedPage


def test_a_page_is_shown_in_a_cell_until_it_is_closed() -> None:
    ended: list[int] = []
    page = ServedPage("http://127.0.0.1:8080/?a=1&b=<2>", lambda: ended.append(1))
    shown = page._repr_mimebundle_(include=None, exclude=None)
    assert shown["text/html"].startswith('<iframe src="http://127.0.0.1:8080/?a=1&amp;b=&lt;2&gt;"')
    assert shown["text/plain"] == "<LPN Explorer at http://127.0.0.1:8080/?a=1&b=<2>>"
    page.close()
    page.close()
    assert ended == [1]
    assert page.closed
    closed = {"text/html": "<p>This LPN Explorer is closed.</p>", "text/plain": "<LPN Explorer closed>"}
    assert page._repr_mimebundle_() == closed


def test_a_page_that_asks_for_a_token_is_shown_as_a_link() -> None:
    page = ServedPage("http://host:1/?token=x", lambda: None, framed=False)
    assert page._repr_html_() == (
        '<p>LPN Explorer: <a href="http://host:1/?token=x" target="_blank" rel="noopener">http://host:1/?token=x</a></p>'
    )
    page.close()


def test_the_end_of_a_block_closes_the_page_and_a_script_waits_for_that(capsys: pytest.CaptureFixture[str]) -> None:
    ended: list[int] = []
    with pytest.raises(ZeroDivisionError), ServedPage("url", lambda: ended.append(1)) as page:
        raise ZeroDivisionError
    assert ended == [1]
    page.wait()  # returns at once
    assert capsys.readouterr().out == "LPN Explorer is ready: url  (stop with Ctrl-C)\n"
    other = ServedPage("url", lambda: ended.append(2))
    waiting = threading.Thread(target=other.wait)
    waiting.start()
    other.close()
    waiting.join(60)
    assert not waiting.is_alive()
    assert ended == [1, 2]
