"""The laboratory beside the rings, used as a person would."""

from __future__ import annotations

import csv
import re
import time
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from playwright.sync_api import Locator, Page, expect

from explorer.app import App
from explorer.screen.panels.lab.service import LabFindings, lab_of
from lpn.tasks import notes
from tests.e2e.conftest import Contexts, NewPage, Running, Screen, box, expect_accessible
from tests.e2e.test_screen import SIZES, hides, scrolls
from tests.explorer.conftest import mapped_workspace
from tools.fixtures.processes import free_port
from tools.fixtures.waiting import TIMEOUT

TASK = "drone-to-satellite"
# Where the plane of the map has a point of a colour; null where it has none.
POINT = """colour => {
  const plane = document.querySelector(".lab .plane"), frame = plane.getBoundingClientRect();
  const canvas = plane.querySelector("canvas"), { left, top, width, height } = canvas.getBoundingClientRect();
  const wanted = colour.match(/[0-9]+/g).map(Number);
  const { data } = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height);
  for (let at = 0; at < data.length; at += 4) {
    if (data[at + 3] < 200 || wanted.some((one, channel) => Math.abs(one - data[at + channel]) > 2)) continue;
    const x = left + ((at / 4 % canvas.width) * width) / canvas.width;
    const y = top + (Math.floor(at / 4 / canvas.width) * height) / canvas.height;
    if (x > frame.left + 4 && x < frame.right - 4 && y > frame.top + 4 && y < frame.bottom - 4) return [x, y];
  }
  return null;
}"""


@pytest.fixture(scope="module")
def running(tmp_path_factory: pytest.TempPathFactory, model_file: Path, one_part_model_file: Path) -> Iterator[Running]:
    folder, weathers = tmp_path_factory.mktemp("lab"), {"weather": ("rain", "sun", "fog")}
    with (
        mapped_workspace(folder, model_file, one_part_model_file, 13, weathers) as workspace,
        closing(App(workspace, "127.0.0.1", free_port())) as app,
    ):
        yield Running(app, workspace)


@pytest.fixture(scope="module")
def findings(running: Running) -> LabFindings:
    lab = lab_of(running.workspace)
    assert lab.build(TASK, running).wait(120)
    return lab.findings(TASK)


class LabPage(Screen):
    """A page with the laboratory open."""

    def __init__(self, page: Page, url: str) -> None:
        super().__init__(page, url)
        self.lab, self.table = page.locator("#panel .lab"), page.locator("#panel .tabulator")
        self.lines = self.table.locator(".tabulator-tableholder .tabulator-row")
        self.shown, self.counts = self.table.locator(".tabulator-row.shown"), self.lab.locator(".counts [role=status]")

    def row(self, name: str) -> Locator:
        return self.lines.filter(has=self.page.get_by_text(name, exact=True).first)

    def eventually(self, ask: Callable[[], Any]) -> Any:
        """Wait for a true result of a script in the page, and return it."""
        deadline = time.monotonic() + TIMEOUT
        while (found := ask()) is None:
            assert time.monotonic() < deadline
            self.page.wait_for_timeout(200)
        return found

    def expect_total(self, total: int, of: int = 13) -> None:
        expect(self.counts).to_contain_text(f"{total} of {of}" if total < of else f"{of} photos")


@pytest.fixture
def lab(running: Running, new_page: NewPage) -> LabPage:
    return LabPage(new_page(), running.url)


@pytest.mark.parametrize("size", SIZES)
def test_it_stands_beside_the_rings_and_covers_neither_them_nor_the_strip(
    running: Running, contexts: Contexts, size: tuple[int, int]
) -> None:
    page = contexts(viewport={"width": size[0], "height": size[1]}).new_page()
    lab = LabPage(page, running.url).open()
    lab.key("b")
    expect(lab.lines.nth(3)).to_be_visible()
    expect(lab.lines.first.locator("img").first).to_be_visible()
    assert scrolls(page) == (0, 0)
    panel = box(page.locator("#panel"))
    headings = "#rows .head span:last-child :is(u, i)"  # "share to 0.5" and "prefers"
    shown = ("#photo .frame", "#tile .frame", "#sum", "#strip .tile", "#rows .row", headings)
    parts = [page.locator(one) for one in shown]
    for one in [single for part in parts for single in part.all()]:
        place = box(one)
        assert place["x"] >= panel["x"] + panel["width"]
        assert place["x"] + place["width"] <= size[0]
        assert place["y"] + place["height"] <= size[1]
    for row in page.locator("#rows .row").all():
        assert hides(row) == 0
    for tab in ("Charts", "Map", "Table"):
        lab.lab.get_by_role("button", name=tab, exact=True).click()
        expect(lab.lab.locator(f".body .{tab.lower()}")).to_be_visible()
        expect(lab.lab.locator(".busy")).to_be_hidden()
        if size == SIZES[0]:
            expect_accessible(page)
    lab.key("Escape")
    expect(page.locator("#panel")).to_be_hidden()
    expect(page.locator("#rail")).to_be_visible()
    assert not lab.complaints


def test_rows_open_their_queries_here_and_keys_walk_them(lab: LabPage, findings: LabFindings) -> None:
    order = findings.table.sort(findings.table.rows(), "margin")
    names = [findings.task.queries[row].name for row in order.tolist()]
    lab.open("?panel=lab")
    lab.row(names[2]).click()
    expect(lab.shown).to_contain_text(names[2])
    expect(lab.photo.locator(".picture")).to_have_attribute("aria-label", re.compile(re.escape(names[2])))
    for key, expected in (("n", 3), ("ArrowDown", 4), ("p", 3), ("ArrowUp", 2), ("PageDown", 12)):
        lab.key(key)
        expect(lab.shown).to_contain_text(names[expected])
        expect(lab.lab.locator(".note b")).to_have_text(names[expected])
    lab.rest()
    lab.table.get_by_role("button", name="rank").click()
    expect(lab.table.get_by_role("button", name="rank")).to_contain_text("▴")
    lab.table.get_by_role("button", name="rank").click()
    worst = int(findings.table.sort(findings.table.rows(), "rank", True)[0])
    expect(lab.lines.first).to_contain_text(findings.task.queries[worst].name)
    assert not lab.complaints


def test_filters_charts_and_marked_rows_narrow_the_table_and_the_address_keeps_them(
    lab: LabPage, findings: LabFindings
) -> None:
    failed = findings.graded.failed
    weather = findings.table.columns["weather"].values
    lab.open("?panel=lab")
    lab.lab.get_by_role("button", name="Missed").click()
    lab.expect_total(int(failed.sum()))
    lab.lab.get_by_role("searchbox", name="Filter").fill("weather >")
    expect(lab.lab.get_by_role("alert")).to_contain_text("weather")
    lab.lab.get_by_role("searchbox", name="Filter").fill("")
    lab.expect_total(int(failed.sum()))
    lab.lab.get_by_role("button", name="Charts").click()
    card = lab.lab.locator(".card", has_text="Missed by weather")
    card.get_by_role("button", name="sun").click()
    count = int((failed & (weather == "sun")).sum())
    lab.expect_total(count)
    expect(lab.lab.get_by_role("searchbox", name="Filter")).to_have_value('weather = "sun"')
    expect(card.get_by_role("button", name="sun")).to_have_attribute("aria-pressed", "true")
    expect(lab.page).to_have_url(re.compile("weather"))
    lab.page.reload()
    lab.expect_total(count)
    expect(lab.lab.locator(".plots figure canvas")).to_have_count(2)
    lab.lab.get_by_role("button", name="Table").click()
    lab.lab.get_by_role("searchbox", name="Filter").fill("")
    lab.lab.get_by_role("button", name="All").click()
    lab.expect_total(13)
    lab.lines.nth(1).click(modifiers=["Control"])
    lab.lines.nth(3).click(modifiers=["Shift"])
    lab.lab.get_by_role("button", name="Only the 3 marked").click()
    lab.expect_total(3)
    lab.lab.get_by_role("button", name="3 picked").click()
    lab.expect_total(13)
    assert not lab.complaints


def test_a_lasso_on_the_map_picks_queries_and_a_point_opens_its_query(lab: LabPage, findings: LabFindings) -> None:
    lab.open("?panel=lab&lab=map&points=pca")
    plane = lab.lab.locator(".plane")
    expect(lab.lab.locator(".map")).to_have_attribute("data-painted", re.compile(r"\d"))
    for column in ("weather", "rank"):
        lab.lab.get_by_label("Colour by").select_option(column)
        expect(lab.lab.locator(".legend")).to_contain_text({"weather": "rain", "rank": "1"}[column])
    lab.lab.get_by_role("button", name="Lasso").click()
    place = box(plane)
    middle = place["x"] + place["width"] / 2

    top, foot = place["y"] + 2, place["y"] + place["height"] - 2
    lab.page.mouse.move(middle, top)
    lab.page.mouse.down()
    for corner in ((place["x"] + 2, top), (place["x"] + 2, foot), (middle, foot)):
        lab.page.mouse.move(*corner, steps=4)
    lab.page.mouse.up()
    picked = lab.lab.get_by_role("button", name=re.compile(r"\d+ picked"))
    expect(picked).to_be_visible()
    left = int(re.match(r"\d+", picked.inner_text())[0])
    assert 0 < left < 13
    lab.expect_total(left)
    picked.click()
    lab.expect_total(13)
    lab.lab.get_by_role("button", name="Lasso").click()
    # Where one query alone is left, a click on its point opens it.
    lab.lab.get_by_label("Map", exact=True).select_option("ground")
    expect(plane.locator("img.leaflet-image-layer")).to_be_visible()
    wanted = findings.task.queries[int(np.argmax(findings.outcomes.rank))].name
    lab.lab.get_by_role("searchbox", name="Filter").fill(f"name = {wanted}")
    lab.expect_total(1)
    lab.lab.get_by_label("Colour by").select_option("")
    expect(lab.lab.locator(".legend")).to_contain_text("✗ missed 1")
    lab.lab.get_by_label("Colour by").select_option("weather")
    swatch = lab.lab.locator(".legend span", has_text=re.compile(r" 1$")).locator(".swatch")
    expect(lab.lab.locator(".legend")).to_contain_text(re.compile("rain|sun|fog"))
    colour = lab.eventually(lambda: swatch.evaluate("one => getComputedStyle(one).backgroundColor || null"))
    x, y = lab.eventually(lambda: lab.page.evaluate(POINT, colour))
    lab.page.mouse.move(x, y)
    expect(lab.lab.locator(".map .tip")).to_contain_text(wanted)
    lab.page.mouse.click(x, y)
    expect(lab.lab.locator(".note b")).to_have_text(wanted)
    assert not lab.complaints


def test_a_note_is_kept_and_the_table_is_saved(lab: LabPage, running: Running, tmp_path: Path) -> None:
    lab.open("?panel=lab")
    form = lab.lab.locator(".note")
    cell = lab.lines.nth(4).locator("[tabulator-field='=name']")
    expect(cell).to_have_text(re.compile(r"\d"))
    name = cell.inner_text()
    lab.lines.nth(4).click()
    expect(lab.shown).to_contain_text(name)
    expect(form.locator("b")).to_have_text(name)
    form.get_by_label("Tags").fill("blur")
    form.get_by_label("Note").fill("A twin <b>roof</b>.")
    lab.page.keyboard.press("Tab")
    lab.page.keyboard.press("Enter")
    expect(form.get_by_role("status")).to_contain_text("Saved")
    [kept] = notes.read_notes(running.workspace.root / "notes.csv").values()
    assert (kept.tags, kept.text) == (("blur",), "A twin <b>roof</b>.")
    lab.page.reload()
    note = form.get_by_label("Note")
    expect(note).to_have_value("A twin <b>roof</b>.")
    note.fill("A twin.")
    lab.lines.nth(6).click()
    expect(note).to_have_value("")
    lab.open(f"?panel=lab&query={name}")
    expect(note).to_have_value("A twin.")
    lab.lab.get_by_role("searchbox", name="Filter").fill("tags ~ blur")
    lab.expect_total(1)
    with lab.page.expect_download() as download:
        lab.lab.get_by_role("button", name="CSV").click()
    download.value.save_as(tmp_path / "table.csv")
    [row] = csv.DictReader((tmp_path / "table.csv").read_text(encoding="utf-8-sig").splitlines())
    assert (row["name"], row["tags"]) == (name, "blur")
    assert not lab.complaints


def test_on_a_phone_it_is_a_page_that_closes(running: Running, contexts: Contexts) -> None:
    page = contexts(viewport={"width": 390, "height": 844}, has_touch=True).new_page()
    lab = LabPage(page, running.url).open("?panel=lab")
    expect(lab.lines.nth(3)).to_be_visible()
    assert box(page.locator("#panel"))["width"] == 390
    assert scrolls(page)[0] == 0
    expect_accessible(page)
    name = lab.lines.nth(3).locator("[tabulator-field='=name']").inner_text()
    lab.lines.nth(3).tap()
    expect(lab.shown).to_contain_text(name)
    page.get_by_role("button", name="Close").tap()
    expect(page.locator("#panel")).to_be_hidden()
    expect(lab.photo.locator(".picture")).to_have_attribute("aria-label", re.compile(re.escape(name)))
    assert not lab.complaints
