"""The failure laboratory as a person uses it."""

from __future__ import annotations

import csv
import re
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from playwright.sync_api import BrowserContext, Locator, Page, expect

import lpn
from lpn import datasets, descriptors
from lpn.analysis import breakdown
from lpn.core.numbers import signed
from lpn.core.tables import Table
from lpn.tasks import query_outcomes
from lpn.tasks.gallery_geometry import GalleryGeometry
from lpn.tasks.query_outcomes import Outcomes
from tests.e2e.conftest import ExplorerPage, RunningApp, deny_storage, started
from tools.fixtures import small_worlds
from tools.fixtures.tasks import descriptor_task

WEATHERS = ("rain", "sun", "<b>fog</b>")


@pytest.fixture(scope="module")
def places(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Drawn places with positions and weather."""
    data = small_worlds.map_dataset(
        small_worlds.make_dataset(tmp_path_factory.mktemp("lab") / "places", train=1, test=40)
    )
    files = sorted((data / "test" / "query_drone").rglob("*.png"))
    lines = [f"{file.relative_to(data).as_posix()},{WEATHERS[i % 3]}" for i, file in enumerate(files)]
    (data / "metadata.csv").write_text("\n".join(["path,weather", *lines]))
    return data


@pytest.fixture(scope="module")
def cache(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where the apps keep the places' descriptors."""
    return tmp_path_factory.mktemp("run") / "cache"


@pytest.fixture(scope="module")
def lab_app(places: Path, model_file: Path, cache: Path) -> Iterator[RunningApp]:
    """The app on those places."""
    with started(places, model_file, cache) as running:
        yield running


@pytest.fixture(scope="module")
def truth(lab_app: RunningApp) -> tuple[Outcomes, Table]:
    """The same table, made without the app."""
    model, dataset = lpn.load(lab_app.model), datasets.open_dataset(lab_app.data)
    queries, gallery = dataset.queries("drone"), dataset.gallery("satellite")
    described = [
        descriptors.temporary_descriptors(model, entries, view)
        for entries, view in ((queries, "drone"), (gallery, "satellite"))
    ]
    outcomes = descriptor_task(*described, datasets.labels_of(queries), datasets.labels_of(gallery)).outcomes
    names = model.spec.partition("drone").names()
    return outcomes, query_outcomes.table(
        dataset.root, queries, gallery, outcomes, names, GalleryGeometry.of_dataset(dataset, queries, gallery)
    )


class LabPage(ExplorerPage):
    """A page of the app with the laboratory open."""

    def enter(self, url: str) -> None:
        """Load the page and open the laboratory."""
        self.open(url)
        self.key("b")
        expect(self.rows_of_table.first).to_be_visible()
        self.settle()

    @property
    def rows_of_table(self) -> Locator:
        """The rows of the table that are drawn."""
        return self.page.locator("#lpn-lab-table tbody tr[data-row]")

    @property
    def count(self) -> Locator:
        """How many queries are chosen."""
        return self.page.locator("#lpn-lab-count")

    def shown(self) -> list[int]:
        """The queries whose rows are drawn."""
        rows: list[int] = self.rows_of_table.evaluate_all("rows => rows.map(row => Number(row.dataset.row))")
        return rows

    def open_row(self, row: int) -> str:
        """Open a query from the table, wait for its note, and return its name."""
        self.page.locator(f"#lpn-lab-table tr[data-row='{row}']").click()
        note = self.page.locator(f".lab-note[data-row='{row}']")
        expect(note).to_be_visible()
        return note.locator("b").inner_text()

    def head(self, column: str) -> None:
        """Click on the head of a column."""
        self.page.locator("#lpn-lab-table th").filter(has_text=re.compile(f"^{column}\\b")).click()

    def choose(self, tab: str) -> None:
        """Show a tab of the laboratory."""
        self.page.locator(".lab-bar .seg a", has_text=tab).click()


@pytest.fixture
def lab(lab_app: RunningApp, new_page: Callable[[], Page]) -> LabPage:
    """The laboratory in a page of its own."""
    page = LabPage(new_page())
    page.enter(lab_app.url)
    return page


def expect_rows(lab: LabPage, rows: np.ndarray, start: int = 0) -> None:
    """The table shows these queries, in order, from a position on."""
    first = str(rows[start]) if len(rows) else ""
    expect(lab.rows_of_table.first).to_have_attribute("data-row", first)

    def check() -> None:
        shown = lab.shown()
        assert shown == rows[start : start + len(shown)].tolist()

    lab.eventually(check)


# Messages that nobody should send, which do no harm.
BAD_MESSAGES = (
    ("lab-open", "1"),
    ("lab-open", 99),
    ("lab-open", -1),
    ("lab-sort", ["name"]),
    ("lab-lasso", ["pca", [[0, 0], [1, 1]]]),
    ("lab-note", ["../../etc/passwd", 1, "a", "b"]),
    ("lab-note", ["drone-to-satellite", 40, "a", "b"]),
    ("lab-find", "\ud800"),
    ("lab-where", "rank = \ud800"),
    ("lab-clear", None),
    ("lab-map", {}),
    ("lab-tip", None),
    ("lab-stop", []),
)


@pytest.mark.slow
def test_all_queries_are_listed_worst_first_and_sorted_by_any_column_whatever_is_sent(
    lab: LabPage, truth: tuple[Outcomes, Table]
) -> None:
    _, table = truth
    expect_rows(lab, table.sort(table.rows(), "margin"))
    for kind, value in BAD_MESSAGES:
        lab.page.evaluate("([kind, value]) => lpn.send(kind, value)", [kind, value])
    for descending in (False, True):
        lab.head("name")
        expect_rows(lab, table.sort(table.rows(), "name", descending))
    head = lab.page.locator("#lpn-lab-table th[aria-sort='descending']")
    expect(head).to_contain_text("name ▼")
    first = lab.rows_of_table.first.inner_text()
    row = lab.shown()[0]
    assert table.columns["answer"].text(row) in first
    assert signed(table.columns["margin"].values[row], 2) in first
    lab.head("margin")
    expect_rows(lab, table.sort(table.rows(), "margin"))
    expect(lab.count).to_contain_text("40 of 40 queries")
    expect(lab.notifications).to_have_count(0)


@pytest.mark.slow
def test_the_table_scrolls_to_its_end_and_is_used_by_keys(lab: LabPage, truth: tuple[Outcomes, Table]) -> None:
    _, table = truth
    rows = table.sort(table.rows(), "margin")
    size = len(lab.shown())
    assert 5 <= size < 40
    grid = lab.page.locator("#lpn-lab-rows")
    expect(grid).to_have_attribute("aria-rowcount", "41")
    for width in (2400, 1456):  # columns as wide as a wider window allowed would not fit now
        lab.page.set_viewport_size({"width": width, "height": 835})
        wider = f"() => document.querySelector('#lpn-lab-rows').clientWidth {'>' if width > 2000 else '<'} 1000"
        lab.page.wait_for_function(wider)
    shown, room = "document.querySelector('#lpn-lab-rows table')", "document.querySelector('#lpn-lab-rows')"
    fits = f"() => {shown}.offsetWidth <= {room}.clientWidth"
    lab.page.wait_for_function(fits)
    lab.page.evaluate(f"lpn.send('lab-open', {rows[-1]})")
    expect(lab.rows_of_table.last).to_have_attribute("data-row", str(rows[-1]))
    grid.evaluate("grid => grid.scrollTop = 0")
    grid.focus()
    lab.page.keyboard.press("ArrowDown")  # begins in sight, not at the open query
    expect(grid).to_have_attribute("aria-activedescendant", "lpn-lab-rows-0")
    beyond = "grid => (({ outlineOffset, outlineWidth }) => parseFloat(outlineOffset) + parseFloat(outlineWidth))"
    assert grid.evaluate(f"{beyond}(getComputedStyle(grid))") == 0, "the frame covers nothing around the table"
    lab.page.keyboard.press("End")
    expect(lab.rows_of_table.last).to_have_attribute("data-row", str(rows[-1]))
    assert len(lab.shown()) < 40
    lab.page.keyboard.press("ArrowUp")
    lab.page.keyboard.press("Enter")
    lab.expect_status("query", str(rows[-2]))
    expect(lab.page.locator("#lpn-lab-table tr.chosen")).to_be_in_viewport()
    lab.page.keyboard.press("Home")
    expect_rows(lab, rows)


@pytest.mark.slow
def test_a_filter_narrows_the_table_and_a_wrong_one_is_said_beside_it(
    lab: LabPage, truth: tuple[Outcomes, Table]
) -> None:
    _, table = truth
    rows = table.sort(table.filter(table.rows(), "weather = rain and altitude > 0"), "margin")
    answers = lab.sequence()
    box = lab.page.locator("#lpn-lab-where")
    box.press_sequentially("weather = rain and altitude > 0", delay=15)
    expect(lab.count).to_contain_text("14 of 40 queries")
    expect_rows(lab, rows)
    expect(box).to_be_focused()
    assert lab.sequence() == answers  # no letter was a command
    box.fill("wether = rain")
    expect(lab.page.locator(".lab-summary .error")).to_contain_text("There is no column 'wether'")
    expect_rows(lab, rows)
    expect(box).to_have_value("wether = rain")
    lab.page.locator("#lpn-lab-find").fill("0005")
    expect(lab.count).to_contain_text("1 of 40 queries" if "0005" in rows_names(table, rows) else "0 of 40 queries")
    lab.page.get_by_text("show all").first.click()
    expect(lab.count).to_contain_text("40 of 40 queries")
    expect(box).to_have_value("")
    expect(lab.page.locator("#lpn-lab-find")).to_have_value("")


def rows_names(table: Table, rows: np.ndarray) -> list[str]:
    """The names of some queries."""
    return [table.columns["name"].text(row) for row in rows]


def test_a_click_on_a_row_opens_the_query_and_next_follows_the_table(
    lab: LabPage, truth: tuple[Outcomes, Table]
) -> None:
    outcomes, table = truth
    lab.page.locator(".lab-bar .seg a", has_text="failed").click()
    failed = table.sort(np.flatnonzero(outcomes.failed), "margin")
    expect(lab.count).to_contain_text(f"{len(failed)} of 40")
    expect_rows(lab, failed)
    lab.rows_of_table.nth(2).click()
    lab.expect_status("query", str(failed[2]))
    expect(lab.page.locator("#lpn-lab-table tr.chosen")).to_have_attribute("data-row", str(failed[2]))
    lab.key("n")
    lab.expect_status("query", str(failed[3]))
    lab.key("p")
    lab.expect_status("query", str(failed[2]))
    for row in failed[3:]:
        lab.key("n")
        lab.expect_status("query", str(row))
    chosen = lab.page.locator("#lpn-lab-table tr.chosen")
    expect(chosen).to_have_attribute("data-row", str(failed[-1]))
    expect(chosen).to_be_in_viewport()  # the table has been scrolled to it
    lab.key("b")
    expect(lab.rows_of_table.first).to_be_hidden()
    lab.key("n")
    lab.expect_status("query", str((failed[-1] + 1) % 40))


@pytest.mark.slow
def test_clicks_in_the_breakdown_choose_what_they_count(
    lab: LabPage, lab_app: RunningApp, truth: tuple[Outcomes, Table]
) -> None:
    outcomes, table = truth
    dataset = datasets.open_dataset(lab_app.data)
    labels = [datasets.labels_of(entries) for entries in (dataset.queries("drone"), dataset.gallery("satellite"))]
    pair = breakdown.confusions(outcomes, *labels)[0]
    lab.choose("Breakdown")
    line = lab.page.locator(".card .line", has_text=f"{pair.place:04d} taken for")
    line.click()
    expect(lab.count).to_contain_text(f"{pair.count} of 40 queries, all failed")
    worst = min(pair.queries.tolist(), key=lambda query: outcomes.margin[query])
    lab.expect_status("query", str(worst))
    expect(lab.page.locator(".lab-summary .pick")).to_contain_text(f"{pair.place:04d} taken for {pair.answered:04d}")
    lab.page.locator(".lab-summary .pick").click()
    expect(lab.count).to_contain_text("40 of 40 queries")
    rates = breakdown.rates(outcomes.failed, table.columns["weather"])
    card = lab.page.locator(".card", has_text="Failures by weather")
    expect(card.locator(".line")).to_have_count(3)
    fog = next(rate for rate in rates if "fog" in rate.name)
    expect(card.locator(".line", has_text="<b>fog</b>")).to_contain_text(f"{100 * fog.share:.0f} %")
    card.locator(".line", has_text="<b>fog</b>").click()
    expect(lab.count).to_contain_text(
        f"{fog.queries} of 40 queries, {'all' if fog.failures == fog.queries else fog.failures} failed"
    )
    expect(card.locator(".line.chosen")).to_have_count(1)
    expect(card.locator(".line")).to_have_count(3)
    counts = breakdown.blame(outcomes, np.flatnonzero(table.columns["weather"].values == fog.name))
    lab.page.locator(".card", has_text="Part that lowers the margin most").locator(".line").nth(
        int(counts.argmax())
    ).click()
    expect(lab.count).to_contain_text(f"{counts.max()} of 40 queries")
    lab.choose("Table")
    expect(lab.page.locator("#lpn-lab-rows")).to_have_attribute("aria-rowcount", str(counts.max() + 1))


def lasso(lab: LabPage, corners: list[tuple[float, float]]) -> None:
    """Draw a lasso on the map with Shift held, in fractions of it."""
    lab.page.locator(".lab-map").evaluate("map => map.scrollIntoView({block: 'nearest'})")
    box = lab.page.locator(".lab-map").bounding_box()
    assert box is not None
    places = [(box["x"] + x * box["width"], box["y"] + y * box["height"]) for x, y in corners]
    lab.page.keyboard.down("Shift")
    lab.page.mouse.move(*places[0])
    lab.page.mouse.down()
    for place in places[1:]:
        lab.page.mouse.move(*place, steps=4)
    lab.page.mouse.up()
    lab.page.keyboard.up("Shift")


ALL = [(0.02, 0.02), (0.98, 0.02), (0.98, 0.98), (0.02, 0.98)]


@pytest.mark.slow
def test_a_lasso_on_a_live_map_chooses_queries_and_a_click_opens_one(
    lab: LabPage, truth: tuple[Outcomes, Table]
) -> None:
    _, table = truth
    lab.choose("Maps")
    shown, counted = lab.page.locator(".lab-map"), lab.page.locator(".lab-map .counted")
    expect(shown).to_have_attribute("data-map", "ground")
    lab.page.locator("#lpn-lab-maps a", has_text="PCA").click()
    expect(shown).to_have_attribute("data-map", "pca")
    expect(counted).to_have_text("40 of 40")
    expect(shown).to_have_attribute("data-pictures", re.compile("[1-9]"))  # so few queries are shown as pictures
    lab.page.get_by_label("Pictures in place of points").click()
    expect(shown).to_have_attribute("data-pictures", "0")
    # A map that is zoomed until nothing is in sight says so, and leads back.
    nothing = lab.page.get_by_text("No picture lies here.")
    expect(nothing).to_be_hidden()
    marks = lab.page.locator(".lab-map .marks")
    for _ in range(30):
        marks.press("+")
    expect(nothing).to_be_visible()
    nothing.get_by_role("button", name="Show all").click()
    expect(nothing).to_be_hidden()
    lasso(lab, ALL)
    expect(lab.page.locator(".lab-summary .pick")).to_contain_text("lasso on the PCA")
    expect(lab.count).to_contain_text("40 of 40 queries")
    lab.page.get_by_text("show all").first.click()
    expect(lab.page.locator(".lab-summary .pick")).to_have_count(0)
    lasso(lab, [(0.02, 0.02), (0.98, 0.98)])  # a diagonal spans a box
    expect(lab.page.locator(".lab-summary .pick")).to_contain_text("lasso on the PCA")
    expect(lab.count).to_contain_text("40 of 40 queries")
    lasso(lab, [(0.1, 0.5), (0.9, 0.5)])  # a line spans none
    hint = lab.page.get_by_text("Draw a loop, or a diagonal for a box")
    expect(hint).to_be_hidden()
    lab.page.get_by_role("button", name="Lasso", exact=True).click()
    expect(hint).to_be_visible()
    lab.page.get_by_role("button", name="Move", exact=True).click()
    expect(lab.count).to_contain_text("40 of 40 queries")
    lasso(lab, [(0.02, 0.02), (0.5, 0.02), (0.5, 0.98), (0.02, 0.98)])
    expect(lab.count).not_to_contain_text("40 of 40")
    left = int((lab.count.inner_text()).split()[0])
    assert 0 < left < 40
    expect(counted).to_have_text(f"{left} of 40")
    lab.page.get_by_label("Colour by").select_option("weather")
    expect(lab.page.locator(".lab-key")).to_contain_text("<b>fog</b>")
    lab.page.locator("#lpn-lab-maps a", has_text="On the ground").click()
    expect(shown).to_have_attribute("data-map", "ground")
    lab.page.get_by_text("show all").first.click()
    expect(counted).to_have_text("40 of 40")
    # The drawn places lie on a grid of four columns: the western two hold half of them.
    lasso(lab, [(0.02, 0.02), (0.5, 0.02), (0.5, 0.98), (0.02, 0.98)])
    west = np.flatnonzero(table.columns["longitude"].values < 7.002)
    expect(lab.count).to_contain_text(f"{len(west)} of 40 queries")
    row = int(west[0])
    lab.settle()  # a frame that was due anyway counts before
    frames = shown.get_attribute("data-frames")
    lab.page.get_by_role("button", name="Zoom to the chosen").click()
    expect(shown).not_to_have_attribute("data-frames", frames or "")
    place, box = lab.page.evaluate("row => lpn.labMap.pixels(row)", row), shown.locator(".marks").bounding_box()
    assert box is not None
    at = box["x"] + place[0], box["y"] + place[1]
    lab.page.mouse.move(*at)
    while shown.locator(".marks").evaluate("marks => marks.style.cursor") == "zoom-in":  # a pie of several places
        lab.settle()  # a frame that was due anyway counts before
        frames = shown.get_attribute("data-frames")
        lab.page.mouse.click(*at)
        expect(shown).not_to_have_attribute("data-frames", frames or "")
        place = lab.page.evaluate("row => lpn.labMap.pixels(row)", row)
        at = box["x"] + place[0], box["y"] + place[1]
        lab.page.mouse.move(*at)
    tip = lab.page.locator(".lab-tip")
    expect(tip).to_be_visible()
    pointed = tip.get_attribute("data-row") or ""
    expect(tip).to_contain_text(table.columns["name"].text(int(pointed)))
    lab.page.mouse.click(*at)
    lab.expect_status("query", pointed)
    lab.page.mouse.move(*at)
    before = lab.page.evaluate("row => lpn.labMap.pixels(row)", row)
    lab.page.mouse.down()
    lab.page.mouse.move(at[0] + 40, at[1] + 10, steps=4)
    lab.page.mouse.up()
    after = lab.page.evaluate("row => lpn.labMap.pixels(row)", row)
    assert np.subtract(after, before).tolist() == pytest.approx([40, 10], abs=0.5)
    far = "([one, other]) => Math.hypot(...lpn.labMap.pixels(one).map((at, i) => at - lpn.labMap.pixels(other)[i]))"
    near = lab.page.evaluate(far, [row, int(west[-1])])
    lab.page.mouse.wheel(0, -200)
    lab.page.wait_for_function(f"([pair, least]) => ({far})(pair) > least", arg=[[row, int(west[-1])], 1.2 * near])


@pytest.mark.slow
def test_a_map_has_a_scale_bar_north_and_the_position_under_the_cursor_and_chooses_by_keys(
    lab: LabPage, truth: tuple[Outcomes, Table]
) -> None:
    _, table = truth
    lab.choose("Maps")
    shown, position = lab.page.locator(".lab-map"), lab.page.locator(".lab-map .read")
    white = """([left, top]) => {
      const canvas = document.querySelector(".lab-map .marks"), ratio = canvas.width / canvas.clientWidth;
      const at = [left, top < 0 ? canvas.clientHeight + top : top].map((side) => Math.round(side * ratio));
      return Math.min(...canvas.getContext("2d").getImageData(...at, 1, 1).data) > 200;
    }"""
    bar, arrow = [20, -12], [22, 52]
    expect(shown).to_have_attribute("data-metres", re.compile("^[125]0*$"))  # it is the first of the maps
    lab.page.locator("#lpn-lab-maps a", has_text="PCA").click()
    expect(shown).not_to_have_attribute("data-metres", re.compile(""))  # descriptors have no metres
    lab.page.wait_for_function(f"at => !({white})(at)", arg=bar)
    lab.page.locator("#lpn-lab-maps a", has_text="On the ground").click()
    expect(shown).to_have_attribute("data-metres", re.compile("^[125]0*$"))
    assert lab.page.evaluate(white, bar)
    assert lab.page.evaluate(white, arrow)
    north, south = (int(np.argmax(sign * table.columns["latitude"].values)) for sign in (1, -1))
    box = shown.locator(".marks").bounding_box()
    assert box is not None
    for row in (north, south):
        place = lab.page.evaluate("row => lpn.labMap.pixels(row)", row)
        lab.page.mouse.move(box["x"] + place[0], box["y"] + place[1])
        read = [float(value) for value in position.inner_text().split(", ")]
        true = [float(table.columns[axis].values[row]) for axis in ("latitude", "longitude")]
        assert read == pytest.approx(true, abs=2e-5)
    # From the northern to the southern row are 9 times 0.0009 degrees, which are 100 m each.
    pixels = "([one, other]) => lpn.labMap.pixels(other)[1] - lpn.labMap.pixels(one)[1]"
    for _ in range(2):
        scale = lab.page.evaluate(pixels, [north, south]) / 900
        metres = int(shown.get_attribute("data-metres") or 0)
        assert metres * scale <= 130 < 2.5 * metres * scale
        lab.settle()  # a frame that was due anyway counts before
        frames = shown.get_attribute("data-frames")
        lab.page.get_by_role("button", name="Zoom in").click()
        expect(shown).not_to_have_attribute("data-frames", frames or "")
    expect(position).to_be_hidden()
    # Enter chooses the queries in sight.
    lab.page.locator("#lpn-lab-maps a", has_text="PCA").click()
    expect(lab.page.locator(".lab-map[data-map=pca] .counted")).to_have_text("40 of 40")
    marks = shown.locator(".marks")
    for _ in range(3):
        marks.press("+")
    for _ in range(40):  # no arrow pushes all points out of sight
        marks.press("ArrowRight")
    marks.press("Enter")
    expect(lab.page.locator(".lab-summary .pick")).to_contain_text("lasso on the PCA")
    expect(lab.count).not_to_contain_text(re.compile("^(0|40) of"))
    marks.press("Escape")
    expect(lab.count).to_contain_text("40 of 40 queries")
    # Escape undoes a choice that the server has not confirmed.
    sent = marks.evaluate("""(canvas) => {
      const { send } = lpn, sent = [];
      lpn.send = (kind, value) => (sent.push(kind), send(kind, value));
      for (const key of ["Enter", "Escape"]) canvas.dispatchEvent(new KeyboardEvent("keydown", { key }));
      lpn.send = send;
      return sent;
    }""")
    assert sent == ["lab-lasso", "lab-unpick"]
    expect(lab.count).to_contain_text("40 of 40 queries")


@pytest.mark.slow
def test_single_rows_are_chosen_by_mouse_and_keys(lab: LabPage, truth: tuple[Outcomes, Table]) -> None:
    _, table = truth
    order = table.sort(table.rows(), "margin")
    said, marked = lab.page.locator("#lpn-lab-chosen"), lab.page.locator("#lpn-lab-table tr.marked")
    lab.page.get_by_role("button", name="Tag", exact=True).click()
    button = lab.page.locator("#lpn-lab-tag .button")
    expect(button).to_have_text("Tag all 40 shown")
    lab.rows_of_table.nth(1).click(modifiers=["Control"])
    expect(said).to_have_text("1 chosen")
    expect(button).to_have_text("Tag the 1 chosen")
    lab.rows_of_table.nth(3).click(modifiers=["Shift"])
    expect(said).to_have_text("3 chosen")
    lab.rows_of_table.nth(2).locator(".mark").click()
    expect(said).to_have_text("2 chosen")
    expect(marked).to_have_count(2)
    grid = lab.page.locator("#lpn-lab-rows")
    grid.focus()
    lab.page.keyboard.press("Escape")
    expect(said).to_be_empty()
    for key in ("Home", "Space", "ArrowDown", "ArrowDown", "Shift+ArrowDown", "Shift+ArrowDown"):
        lab.page.keyboard.press(key)
    expect(said).to_have_text("4 chosen")
    lab.page.keyboard.press("Shift+PageUp")
    expect(said).to_have_text("3 chosen")
    lab.page.keyboard.press("Escape")
    expect(said).to_be_empty()
    lab.page.keyboard.press("Home")
    lab.page.keyboard.press("Space")
    expect(said).to_have_text("1 chosen")
    for count, key in ((2, "ArrowDown"), (3, "ArrowDown"), (2, "ArrowUp")):
        lab.page.keyboard.press("Shift+" + key)
        expect(said).to_have_text(f"{count} chosen")
    lab.page.get_by_text("show only these").click()
    expect(lab.count).to_contain_text("2 of 40 queries")
    expect_rows(lab, order[:2])
    expect(button).to_have_text("Tag all 2 shown")
    lab.page.get_by_text("show all").first.click()
    expect(lab.count).to_contain_text("40 of 40 queries")
    grid.focus()
    lab.page.keyboard.press("Control+a")
    expect(said).to_have_text("40 chosen")


@pytest.mark.slow
def test_columns_are_chosen_and_the_chosen_queries_are_saved_as_csv_and_as_a_report(
    lab: LabPage, truth: tuple[Outcomes, Table], tmp_path: Path
) -> None:
    _, table = truth
    heads = lab.page.locator("#lpn-lab-table thead")
    expect(heads).not_to_contain_text("weather")
    lab.page.locator(".lab-summary a", has_text="Columns").click()
    lab.page.locator("#lpn-lab-columns a", has_text="weather").click()
    expect(heads).to_contain_text("weather")
    expect(lab.page.locator("#lpn-lab-table")).to_contain_text("<b>fog</b>")
    lab.page.locator("#lpn-lab-columns a", has_text="altitude").click()
    expect(heads).not_to_contain_text("altitude")
    lab.page.locator("#lpn-lab-where").fill("weather = sun")
    expect(lab.count).to_contain_text("13 of 40 queries")
    with lab.page.expect_download() as download:
        lab.page.locator(".acts a", has_text="CSV").click()
    assert download.value.suggested_filename == "places-drone-to-satellite-13-queries.csv"
    download.value.save_as(tmp_path / "saved.csv")
    with (tmp_path / "saved.csv").open(newline="") as file:
        saved = list(csv.DictReader(file))
    rows = table.sort(table.filter(table.rows(), "weather = sun"), "margin")
    assert [line["path"] for line in saved] == [table.paths[row] for row in rows]
    assert [line["rank"] for line in saved] == [table.columns["rank"].text(row) for row in rows]
    assert {line["weather"] for line in saved} == {"sun"}
    lab.page.locator("#lpn-lab-where").fill("weather = sun and rank <= 3")
    expect(lab.count).not_to_contain_text("13 of 40 queries")
    with lab.page.expect_download() as download:
        lab.page.locator(".acts a", has_text="Report").click()
    download.value.save_as(tmp_path / "report.html")
    text = (tmp_path / "report.html").read_text("utf-8")
    assert "weather = sun and rank &lt;= 3, sorted by margin (All pictures in a table)" in text


@pytest.mark.slow
def test_a_link_brings_back_what_the_laboratory_shows_and_each_browser_has_its_own(
    lab: LabPage, lab_app: RunningApp, truth: tuple[Outcomes, Table], contexts: Callable[..., BrowserContext]
) -> None:
    _, table = truth
    lab.page.locator("#lpn-lab-where").fill("weather = rain")
    expect(lab.count).to_contain_text("14 of 40 queries")
    for _ in range(2):
        lab.head("name")
    rows = table.sort(table.filter(table.rows(), "weather = rain"), "name", True)
    expect_rows(lab, rows)
    lab.page.wait_for_function("new URLSearchParams(location.search).get('order') === 'down'")

    other = LabPage(contexts().new_page())
    other.open(lab.page.url)
    expect_rows(other, rows)
    expect(other.page.locator("#lpn-lab-where")).to_have_value("weather = rain")
    other.choose("Breakdown")
    card = other.page.locator(".card", has_text="Part that lowers the margin most")
    card.locator(".line").first.click()
    other.choose("Maps")
    other.page.wait_for_function("new URLSearchParams(location.search).get('tab') === 'maps'")
    other.page.reload()
    expect(other.page.locator("#lpn-lab-map canvas").first).to_be_visible()
    expect(other.page.locator(".lab-summary .pick")).to_contain_text("lowers the margin most")
    expect(other.page.locator("#lpn-lab-where")).to_have_value("weather = rain")
    expect(lab.count).to_contain_text("14 of 40 queries")
    other.page.get_by_text("show all").first.click()
    expect(other.count).to_contain_text("40 of 40 queries")
    lab.page.locator("#lpn-lab-where").fill("weather = sun")
    expect(lab.count).to_contain_text("13 of 40 queries")
    expect(other.count).to_contain_text("40 of 40 queries")
    # A note reaches both.
    other.choose("Table")
    expect(other.rows_of_table.first).to_be_visible()
    name = other.open_row(other.shown()[0])
    other.page.locator("#lpn-lab-tags").fill("shared")
    other.page.locator(".lab-note a").click()
    expect(other.page.locator("#lpn-lab-message")).to_contain_text("Saved")
    lab.page.locator("#lpn-lab-where").fill("tags ~ shared")
    expect(lab.count).to_contain_text("1 of 40 queries")
    expect(lab.rows_of_table.first).to_contain_text(name)
    (lab_app.data / "notes.csv").unlink()


@pytest.mark.slow
def test_tags_and_notes_survive_a_restart(
    lab: LabPage, lab_app: RunningApp, cache: Path, new_page: Callable[[], Page]
) -> None:
    row = lab.shown()[1]
    name = lab.open_row(row)
    tags, note = lab.page.locator("#lpn-lab-tags"), lab.page.locator("#lpn-lab-note")
    tags.fill("night, blur")
    note.fill("Looks like the twin <i>next door</i>.")
    note.blur()
    message = lab.page.locator("#lpn-lab-message")
    expect(message).to_have_text("Saved in notes.csv, beside the data, on the computer that runs this page.")
    tags.fill("what/ever")
    tags.blur()
    expect(message).to_contain_text("Not saved. The tag 'what/ever' is not a word")
    expect(tags).to_have_value("what/ever")
    expect(lab.rows_of_table.filter(has_text="night blur")).to_contain_text(name)
    with started(lab_app.data, lab_app.model, cache) as running:
        later = LabPage(new_page())
        later.enter(running.url)
        later.open_row(row)
        expect(later.rows_of_table.filter(has_text="night blur")).to_contain_text(name)
        expect(later.page.locator("#lpn-lab-tags")).to_have_value("night blur")
        expect(later.page.locator("#lpn-lab-note")).to_have_value("Looks like the twin <i>next door</i>.")
    (lab_app.data / "notes.csv").unlink()


@pytest.mark.slow
def test_a_note_that_is_typed_outlasts_new_boxes_where_storage_is_denied(lab: LabPage) -> None:
    deny_storage(lab.page)
    lab.open_row(lab.shown()[0])
    note, boxes = lab.page.locator("#lpn-lab-note"), lab.page.locator(".lab-note")
    note.fill("not saved")
    boxes.evaluate("row => lpn.noteOpened(row.dataset.path)")  # as when the same boxes come anew
    expect(note).to_have_value("not saved")
    expect(boxes).to_have_class(re.compile("unsaved"))
    note.fill("")


@pytest.mark.slow
def test_a_phones_sheet_stays_as_wide_as_the_phone(
    lab_app: RunningApp, contexts: Callable[..., BrowserContext]
) -> None:
    context = contexts(viewport={"width": 390, "height": 844}, has_touch=True, is_mobile=True)
    lab = LabPage(context.new_page())
    lab.open(f"{lab_app.url}/?lab=1")
    table = lab.page.locator("#lpn-lab-table")
    expect(table).to_be_visible()
    wide = "[...document.querySelectorAll('.mantine-ScrollArea-viewport')].filter(e => e.scrollWidth > e.clientWidth).length"
    lab.page.locator(".lab-summary a", has_text="Columns").tap()
    lab.page.locator("#lpn-lab-columns a", has_text="weather").tap()
    expect(table).to_contain_text("<b>fog</b>")
    assert lab.page.locator("#lpn-lab-rows").evaluate("e => e.scrollWidth > e.clientWidth")  # it scrolls within itself
    lab.rows_of_table.first.tap()
    expect(lab.page.locator(".lab-note")).to_be_visible()
    assert lab.page.evaluate(wide) == 0
    for tab, shown in (("Breakdown", "#lpn-lab-breakdown"), ("Maps", "#lpn-lab-map")):
        lab.choose(tab)
        expect(lab.page.locator(shown)).to_be_visible()
        assert lab.page.evaluate(wide) == 0
    for seen in (lab.verdict, lab.rows.first):
        box = seen.bounding_box()
        assert box is not None
        assert box["x"] + box["width"] <= 390
