"""Lists that scroll, and pictures of one's own."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import msgspec
import pytest
from playwright.sync_api import Browser, Page, expect

import explorer.web
from explorer.browse.messages import BeginBatch, BrowseMessage
from explorer.server.message_filter import MAX_TEXT
from explorer.web.messages import decode
from tests.e2e.conftest import ExplorerPage, empty_context
from tools.fixtures import small_worlds


@pytest.mark.slow
def test_the_list_of_queries_is_used_by_keys_and_follows_the_query(explorer: ExplorerPage) -> None:
    queries = explorer.page.get_by_role("listbox", name="Queries")
    thumbs = queries.get_by_role("option")
    expect(thumbs).to_have_count(14)
    expect(queries.locator("img.there")).to_have_count(14)
    queries.focus()
    explorer.page.keyboard.press("End")
    explorer.page.keyboard.press("ArrowLeft")
    explorer.page.keyboard.press("Enter")
    explorer.expect_status("query", "12")
    expect(queries.get_by_role("option", selected=True)).to_have_attribute("data-query", "12")
    explorer.key("n")
    explorer.key("n")
    explorer.expect_status("query", "0")
    expect(queries.get_by_role("option", selected=True)).to_be_in_viewport()
    explorer.fill("Find name", "00")
    expect(explorer.page.locator("#lpn-queries-count")).to_contain_text("14 pictures")
    explorer.fill("Find name", "002")
    expect(thumbs.first).to_contain_text("002")
    shown = thumbs.count()
    assert 0 < shown < 14
    expect(explorer.page.locator("#lpn-queries-count")).to_have_text(f"{shown} of 14 pictures")


@pytest.mark.slow
def test_many_files_become_queries_and_bad_ones_are_listed(explorer: ExplorerPage, tmp_path: Path) -> None:
    files = [tmp_path / name for name in ("one.png", "two.jpg", "no picture.jpg", "notes.txt")]
    for number, file in enumerate(files[:2]):
        small_worlds.write(file, small_worlds.place(5 + number))
    for file in files[2:]:
        file.write_text("no picture")
    explorer.upload(*files)
    explorer.expect_status("name", "one.png")
    own = explorer.page.locator("#lpn-own")
    expect(own).to_contain_text("2 of your own")
    expect(own.locator("li")).to_have_count(2)
    expect(own.locator("summary")).to_have_text("2 left out")
    expect(explorer.page.locator("#lpn-notice")).to_contain_text("2 pictures of your own are read")
    for name in ("no picture.jpg", "notes.txt"):
        expect(own.locator("li", has_text=name)).to_be_visible()
    explorer.key("n")
    explorer.expect_status("name", "two.jpg")
    own.get_by_role("option", name="one.png").click()
    explorer.expect_status("name", "one.png")
    explorer.page.evaluate("""() => {
      const canvas = Object.assign(document.createElement('canvas'), {width: 60, height: 60});
      canvas.getContext('2d').fillRect(9, 9, 30, 30);
      canvas.toBlob(blob => {
        const data = new DataTransfer();
        for (const name of ['x.png', 'y.png']) data.items.add(new File([blob], name, {type: 'image/png'}));
        window.dispatchEvent(new DragEvent('drop', {dataTransfer: data, bubbles: true, cancelable: true}));
      });
    }""")
    explorer.expect_status("name", "x.png")
    expect(own).to_contain_text("4 of your own")
    own.get_by_text("close").click()
    expect(own).to_have_count(0)


@pytest.fixture
def bare(browser: Browser) -> Iterator[Page]:
    """A page of an upload button and the script of one's own pictures; it sends `sent`, uploads `put`, and draws `bars`."""
    page = empty_context(browser).new_page()
    page.set_content("<input type=file>")
    scripts = Path(explorer.web.__file__).parent / "js"
    page.add_script_tag(path=scripts / "viser_compat.js")
    page.evaluate("""() => {
      window.sent = []; window.put = []; window.bars = [];
      Object.assign(window.lpn, {say: () => 0, work: (...bar) => bars.push(bar)});
      Object.assign(window.lpn, {send: (kind, value) => sent.push(JSON.stringify({kind, value, count: 1000}))});
      document.querySelector('input').addEventListener('change', (event) => put.push(event.target.files[0].name));
      window.file = (name) => new File(['x'], name);
    }""")
    page.add_script_tag(path=scripts / "own.js")
    yield page
    page.context.close()


@pytest.mark.slow
def test_a_batch_with_hundreds_of_long_names_fits_into_a_message(bare: Page) -> None:
    for name in ("n" * 250 + ".txt", "\\u0007" * 250 + ".txt", "\\ud83d\\ude00" * 120 + "abc.txt"):
        text = bare.evaluate(f"lpn.own.take([file('a.png'), ...Array(400).fill(file('{name}'))]) || sent.at(-1)")
        assert len(text) < MAX_TEXT
        message = msgspec.json.decode(text)
        batch = decode(BrowseMessage, message["kind"], message["value"])
        assert isinstance(batch, BeginBatch)
        assert batch.files == 1
        assert len(batch.refused) + batch.unnamed == 400
        assert len(batch.refused) > 90
        assert all(name.endswith(".txt") and kind == "kind" for name, kind in batch.refused)


@pytest.mark.slow
def test_a_file_that_the_browser_cannot_read_is_named_and_one_waits_for_the_button(bare: Page) -> None:
    bare.evaluate("""async () => {
      const gone = file('gone.png');
      gone.arrayBuffer = () => Promise.reject(new DOMException('gone', 'NotReadableError'));
      lpn.own.take([gone, file('there.png')]);
      await lpn.own.go(0, 2);
    }""")
    assert bare.evaluate("sent.map(JSON.parse).map((one) => [one.kind, one.value])") == [
        ["own-begin", [2, [], 0]],
        ["own-skip", [0, "gone.png"]],
    ]
    assert bare.evaluate("put") == []
    assert bare.evaluate("bars") == [[0, 2]]
    bare.evaluate("""() => {
      window.lpn.say = (text) => (window.told = text);
      const gone = file("gone.png");
      gone.arrayBuffer = () => Promise.reject(new DOMException('gone', 'NotReadableError'));
      lpn.own.take([gone]);
    }""")
    bare.wait_for_function("window.told")
    assert bare.evaluate("told").startswith("gone.png cannot be read by the browser")
    assert bare.evaluate("put") == []
    bare.evaluate("window.input = document.querySelector('input'); input.remove(); lpn.own.go(1, 2); 0")
    bare.evaluate("document.body.append(input)")
    bare.wait_for_function("put.length === 1")
    assert bare.evaluate("put") == ["there.png"]
