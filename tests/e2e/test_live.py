"""A flight that goes on, followed in a browser."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from playwright.sync_api import Page, expect

from explorer.live_window.record import LiveRecord
from explorer.live_window.server import LiveApp
from explorer.server.auth import make_authenticator
from lpn.live.outputs import LiveFix
from lpn.live.run import live_answer
from lpn.locate.located import LocatedFlight, LocatedFrame
from tests.explorer.flight_window.conftest import flight as flight
from tools.fixtures.processes import free_port

# The corners of the newest photo lie within the view.
IN_SIGHT = """() => {
  const { map, data, chosen } = lpn.flight, [width, height] = map.size();
  const corners = data.outlines[chosen].slice(0, 4).map(map.toPixels);
  return corners.every(([left, top]) => left >= 0 && left <= width && top >= 0 && top <= height);
}"""


@pytest.mark.slow
def test_the_page_follows_the_newest_frame_and_lays_its_photo_over_the_map(
    flight: LocatedFlight, new_page: Callable[[], Page]
) -> None:
    def fix(located: LocatedFrame) -> LiveFix:
        return LiveFix(
            located, live_answer(located), 47.0, 8.0, 1e9, 0.25, 2, None, np.full((60, 80, 3), 200, np.uint8)
        )

    record, port = LiveRecord("live", flight.basemap), free_port()
    app = LiveApp(record, "127.0.0.1", port, make_authenticator("127.0.0.1", None, False, ()))
    try:
        page = new_page()
        page.goto(app.link)
        record.send(fix(flight.frames[0]))
        expect(page.locator("#lpn-flight .about")).to_contain_text("photo0.png")
        expect(page.locator("#lpn-flight .laid img")).to_be_visible()
        page.evaluate("lpn.flight.map.view().scale *= 20")
        expect(page.locator("#lpn-flight .status")).to_have_text("Answered in 0.25 s, 2 frames dropped")
        record.send(fix(flight.frames[2]))
        expect(page.locator("#lpn-flight .about")).to_contain_text("<b>photo2</b>.png")
        page.wait_for_function(IN_SIGHT)
        assert page.locator("#lpn-first").count() == 0
    finally:
        app.close()
        record.forget()
