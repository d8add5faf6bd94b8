"""A part of a phone's sheet is brought into sight and followed, on a page that has nothing else."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from playwright.sync_api import Browser, Page, expect

import explorer.web
from tests.e2e.conftest import empty_context

# The sheet, a part that is looked for, and what lies above and below it. The browser's own anchoring is off.
BODY = """<div class=mantine-ScrollArea-viewport style="height:360px;overflow-y:auto;overflow-anchor:none">
<div><div id=above style="height:900px"></div><div id=part style="height:110px">part</div><div style="height:900px"></div></div>
</div>"""
# Milliseconds in which a page would scroll, if it did.
QUIET = 1500


@pytest.fixture
def sheet(browser: Browser) -> Iterator[Page]:
    context = empty_context(browser, viewport={"width": 390, "height": 664}, has_touch=True, is_mobile=True)
    page = context.new_page()
    page.clock.install()
    page.set_content(f"<meta name=viewport content='width=device-width'><body style='margin:0'>{BODY}")
    for name in ("viser_compat.js", "page.js", "viewport.js"):
        page.add_script_tag(path=Path(explorer.web.__file__).parent / "js" / name)
    yield page
    context.close()


def at_rest(page: Page) -> None:
    """Wait until the part lies at the top of the sheet."""
    page.wait_for_function("() => Math.abs(part.getBoundingClientRect().top) < 60")
    expect(page.locator("#part")).to_be_in_viewport(ratio=0.95)


def grow(page: Page, pixels: int) -> None:
    """Give what lies above the part another height."""
    page.evaluate(f"above.style.height = '{pixels}px'")


def test_a_part_stays_in_sight_while_heights_above_it_change(sheet: Page) -> None:
    sheet.evaluate("lpn.reveal('#part')")
    at_rest(sheet)
    for pixels in (1500, 1534, 200, 1100):
        grow(sheet, pixels)
        sheet.wait_for_timeout(QUIET)  # longer than any wait for quiet
        at_rest(sheet)


def test_a_part_that_a_busy_server_sends_late_is_brought_into_sight(sheet: Page) -> None:
    sheet.evaluate("window.kept = part; kept.remove(); lpn.reveal('#part')")
    sheet.clock.fast_forward(100_000)
    sheet.evaluate("above.after(kept)")
    at_rest(sheet)
    grow(sheet, 1700)
    sheet.wait_for_timeout(QUIET)
    at_rest(sheet)


def test_a_person_who_scrolls_is_left_alone(sheet: Page) -> None:
    sheet.evaluate("lpn.reveal('#part')")
    sheet.wait_for_function("() => Math.abs(part.getBoundingClientRect().top) < 1")
    sheet.wait_for_timeout(QUIET)
    sheet.mouse.move(100, 100)
    sheet.mouse.wheel(0, -300)
    sheet.wait_for_function("() => part.getBoundingClientRect().top > 200")
    grow(sheet, 1300)
    sheet.wait_for_timeout(QUIET)
    assert sheet.evaluate("part.getBoundingClientRect().top") > 500


def test_a_panel_that_a_slow_phone_unfolds_late_is_brought_into_sight(sheet: Page) -> None:
    append = (
        "html => document.querySelector('.mantine-ScrollArea-viewport > div').insertAdjacentHTML('beforeend', html)"
    )
    sheet.evaluate(append, "<button aria-label='Expand panel Query'>Query</button>")
    sheet.get_by_label("Expand panel Query").click()
    sheet.wait_for_timeout(QUIET)
    sheet.evaluate(append, "<div role=tab>Query</div><div style='height:900px'></div>")
    sheet.wait_for_function("() => Math.abs(document.querySelector('[role=tab]').getBoundingClientRect().top) < 60")
