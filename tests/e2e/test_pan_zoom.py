"""The one way to move a map, tried on a page that has nothing else; both maps of the app use it."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import pytest
from playwright.sync_api import Browser, Page

import explorer.web
from tests.e2e.conftest import empty_context

# A map of 400 x 300 pixels at (50, 20) of the page, of which 2 pixels are a unit; a button lies on it. `calls` is what it called.
PAGE = """() => {
  window.calls = [];
  const element = document.getElementById('map');
  const options = {
    limits: () => [0.5, 20],
    bounds: () => [-1000, -500, 1000, 500],
    ready: () => Boolean(map.view),
    changed: () => calls.push('changed'),
    home: () => calls.push('home'),
    pointed: (at) => calls.push('pointed ' + at),
    tapped: (at) => (calls.push('tapped ' + at), at[0] < 100),
    pen: {
      down: (at, event) => event.shiftKey,
      move: (at) => calls.push('pen ' + at),
      up: () => calls.push('pen up'),
      cancel: () => calls.push('pen cancelled'),
    },
    ignores: 'button',
  };
  window.map = lpn.panZoom(element, options);
  document.addEventListener('keydown', (event) => map.key(event));
  map.view = { x: 10, y: -5, scale: 2 };
}"""
BODY = """<meta name=viewport content="width=device-width"><body style="margin:0"><div id=map style="position:absolute;
left:50px;top:20px;width:400px;height:300px;touch-action:none"><button style="position:absolute;right:0">+</button></div>"""
# A place on the map, right of what `tapped` takes, as seen by the page and by the map.
AT, ON_MAP = (250, 100), [200, 80]
# Resolves when the events that came before a frame of the screen are handled.
HANDLED = "() => new Promise(done => requestAnimationFrame(() => requestAnimationFrame(() => done())))"


class PanZoomPage:
    """The page of a map."""

    def __init__(self, page: Page) -> None:
        self.page = page
        self._touch = page.context.new_cdp_session(page)
        page.set_content(BODY)
        scripts = Path(explorer.web.__file__).parent / "js"
        for name in ("viser_compat.js", "pan_zoom.js"):
            page.add_script_tag(path=scripts / name)
        page.evaluate("window.lpn.clamp = (value, low, high) => Math.min(Math.max(value, low), high)")
        page.evaluate(PAGE)

    def view(self) -> list[float]:
        """The middle and the pixels per unit."""
        view: list[float] = self.page.evaluate("[map.view.x, map.view.y, map.view.scale]")
        return view

    def under(self, at: list[float]) -> list[float]:
        """The place of the plane under one of the map."""
        place: list[float] = self.page.evaluate("(at) => map.toPlane(at)", at)
        return place

    def calls(self, *kinds: str) -> list[str]:
        """Return the calls of these kinds that the map has made since the last question."""
        calls: list[str] = self.page.evaluate("calls.splice(0)")
        return [call for call in calls if call.split()[0] in kinds]

    def wheel(self, **event: object) -> float:
        """Turn the wheel at `AT`, and return the factor by which the map has grown."""
        before = self.view()[2]
        values = json.dumps({"clientX": AT[0], "clientY": AT[1], "bubbles": True, "cancelable": True, **event})
        self.page.evaluate(f"document.getElementById('map').dispatchEvent(new WheelEvent('wheel', {values}))")
        return self.view()[2] / before

    def fingers(self, kind: str, *places: tuple[float, float]) -> None:
        """Send a touch event with fingers at places of the page."""
        points = [{"x": x, "y": y, "id": n} for n, (x, y) in enumerate(places)]
        self._touch.send("Input.dispatchTouchEvent", {"type": f"touch{kind}", "touchPoints": points})
        self.page.evaluate(HANDLED)

    def reset(self) -> None:
        """Show again what was shown first."""
        self.page.evaluate("map.view = { x: 10, y: -5, scale: 2 }")


@pytest.fixture
def pan_zoom(browser: Browser) -> Iterator[PanZoomPage]:
    context = empty_context(browser, has_touch=True, viewport={"width": 600, "height": 400})
    yield PanZoomPage(context.new_page())
    context.close()


def test_pixels_and_the_plane_are_each_other_s_inverse(pan_zoom: PanZoomPage) -> None:
    assert pan_zoom.under([200, 150]) == [10, -5]
    assert pan_zoom.under([0, 0]) == [-90, 70]  # up is positive
    assert pan_zoom.page.evaluate("map.toPixels(map.toPlane([37, 211]))") == pytest.approx([37, 211])


def test_a_drag_moves_the_map_and_a_short_press_is_a_tap(pan_zoom: PanZoomPage) -> None:
    mouse = pan_zoom.page.mouse
    place = pan_zoom.under(ON_MAP)
    mouse.move(*AT)
    mouse.down()
    mouse.move(AT[0] + 2, AT[1] + 3)
    mouse.up()
    assert pan_zoom.view() == [10, -5, 2]
    assert pan_zoom.calls("changed", "tapped") == ["tapped 202,83"]
    mouse.move(*AT)
    mouse.down()
    mouse.move(AT[0] + 60, AT[1] - 30, steps=5)
    mouse.up()
    assert pan_zoom.under([ON_MAP[0] + 60, ON_MAP[1] - 30]) == pytest.approx(place)
    assert pan_zoom.calls("tapped") == []
    mouse.move(*AT)
    assert pan_zoom.calls("changed", "pointed") == ["pointed 200,80"]


def test_a_pen_takes_a_drag_and_leaves_the_map_where_it_is(pan_zoom: PanZoomPage) -> None:
    page = pan_zoom.page
    page.keyboard.down("Shift")
    page.mouse.move(*AT)
    page.mouse.down()
    page.mouse.move(AT[0] + 40, AT[1])
    page.mouse.up()
    assert pan_zoom.calls("pen", "changed", "tapped") == ["pen 240,80", "pen up"]
    page.mouse.click(*AT)
    assert pan_zoom.calls("pen", "changed", "tapped") == ["pen cancelled", "tapped 200,80"]
    assert pan_zoom.view() == [10, -5, 2]


def test_a_wheel_zooms_about_the_cursor_whatever_its_unit(pan_zoom: PanZoomPage) -> None:
    place = pan_zoom.under(ON_MAP)
    notch = pan_zoom.wheel(deltaY=-48)
    assert 1.05 < notch < 1.3
    assert pan_zoom.under(ON_MAP) == pytest.approx(place)
    assert pan_zoom.wheel(deltaY=48) == pytest.approx(1 / notch)
    assert pan_zoom.wheel(deltaY=-3, deltaMode=1) == pytest.approx(notch)  # in lines
    pan_zoom.reset()
    page = pan_zoom.wheel(deltaY=-1, deltaMode=2)
    assert page == pytest.approx(pan_zoom.wheel(deltaY=-9000)), "one event zooms by so much at most"
    assert page < 2.5
    pan_zoom.reset()
    assert pan_zoom.wheel(deltaY=-12, ctrlKey=True) == pytest.approx(pan_zoom.wheel(deltaY=-48), abs=1e-9)


def test_zoom_ends_at_its_limits_and_the_middle_stays_within_the_bounds(pan_zoom: PanZoomPage) -> None:
    for _ in range(20):
        pan_zoom.wheel(deltaY=-300)
    assert pan_zoom.view()[2] == 20
    for _ in range(20):
        pan_zoom.wheel(deltaY=300)
    assert pan_zoom.view()[2] == 0.5
    for key, axis, border in (
        ("ArrowLeft", 0, -1000),
        ("ArrowRight", 0, 1000),
        ("ArrowUp", 1, 500),
        ("ArrowDown", 1, -500),
    ):
        for _ in range(30):
            pan_zoom.page.keyboard.press(key)
        assert pan_zoom.view()[axis] == border


def test_keys_move_zoom_and_bring_home(pan_zoom: PanZoomPage) -> None:
    press = pan_zoom.page.keyboard.press
    press("ArrowRight")
    assert pan_zoom.view() == pytest.approx([10 + 400 / 6 / 2, -5, 2])
    press("ArrowUp")
    assert pan_zoom.view() == pytest.approx([10 + 400 / 6 / 2, -5 + 300 / 6 / 2, 2])
    press("ArrowLeft")
    press("ArrowDown")
    for key, scale in (("+", 3), ("-", 2), ("=", 3)):
        press(key)
        assert pan_zoom.view() == pytest.approx([10, -5, scale])  # about the middle
    pan_zoom.calls()
    press("0")
    press("a")
    assert pan_zoom.calls("home", "changed") == ["home"]


def test_a_double_click_zooms_in_where_there_is_nothing(pan_zoom: PanZoomPage) -> None:
    place = pan_zoom.under(ON_MAP)
    pan_zoom.page.mouse.dblclick(*AT)
    assert pan_zoom.view()[2] == 4
    assert pan_zoom.under(ON_MAP) == pytest.approx(place)
    pan_zoom.page.mouse.dblclick(100, 100)  # `tapped` says that something is there
    pan_zoom.page.mouse.dblclick(440, 30)  # the button
    assert pan_zoom.view()[2] == 4


def test_two_fingers_move_and_zoom_about_their_middle(pan_zoom: PanZoomPage) -> None:
    fingers = pan_zoom.fingers
    pan_zoom.page.evaluate(
        "window.downs = []; addEventListener('pointerdown', (event) => downs.push(event.pointerId), true)"
    )
    place = pan_zoom.under([150, 130])  # between the fingers
    fingers("Start", (150, 150))
    fingers("Start", (150, 150), (250, 150))
    for step in range(1, 6):
        fingers("Move", (150 - 4 * step, 150), (250 + 16 * step, 150 + 10 * step))
    apart = ((330 - 130) ** 2 + 50**2) ** 0.5
    assert pan_zoom.view()[2] == pytest.approx(2 * apart / 100)
    assert pan_zoom.under([(130 + 330) / 2 - 50, 175 - 20]) == pytest.approx(place)
    # The tools of the browser lift all fingers at once only.
    pan_zoom.page.evaluate(
        "document.getElementById('map').dispatchEvent(new PointerEvent('pointerup', {pointerId: Math.max(...downs)}))"
    )
    held = pan_zoom.under([80, 130])
    fingers("Move", (160, 190), (330, 200))  # the finger that stays moves on
    assert pan_zoom.under([110, 170]) == pytest.approx(held)
    fingers("End")
    assert pan_zoom.calls("tapped") == []
    pan_zoom.page.touchscreen.tap(*AT)
    assert pan_zoom.calls("tapped") == ["tapped 200,80"]


def test_one_finger_is_left_to_a_page_that_may_scroll(pan_zoom: PanZoomPage) -> None:
    pan_zoom.page.evaluate(
        "() => { document.getElementById('map').style.touchAction = 'pan-y'; document.body.style.height = '2000px'; }"
    )
    place = pan_zoom.under([150, 130])
    fingers = pan_zoom.fingers
    fingers("Start", (150, 150))
    fingers("Start", (150, 150), (250, 150))
    for step in range(1, 6):
        fingers("Move", (150, 150 - 10 * step), (250, 150 - 10 * step))
    fingers("End")
    assert pan_zoom.under([150, 80]) == pytest.approx(place)
    assert pan_zoom.page.evaluate("scrollY") == 0
    view = pan_zoom.view()
    fingers("Start", (150, 250))
    for step in range(1, 16):
        fingers("Move", (150, 250 - 10 * step))
    fingers("End")
    pan_zoom.page.wait_for_function("scrollY > 50")
    assert pan_zoom.view() == view


def test_without_a_view_nothing_happens_and_a_finger_is_let_go(pan_zoom: PanZoomPage) -> None:
    page = pan_zoom.page
    page.mouse.move(*AT)
    page.mouse.down()
    page.evaluate("window.kept = map.view; map.view = null")
    page.mouse.move(AT[0] + 50, AT[1])
    page.mouse.up()
    page.keyboard.press("+")
    pan_zoom.page.evaluate("map.view = kept")
    page.mouse.move(AT[0] - 50, AT[1])
    assert pan_zoom.view() == [10, -5, 2]
