"""What a person has typed, while the disk is full and after it: nothing of it is lost, and saving again works."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from playwright.sync_api import BrowserContext, Page, expect

from lpn.tasks.notes import Note, read_notes
from tests.e2e.conftest import RunningApp, started
from tests.e2e.test_lab import LabPage
from tools.fixtures import small_worlds
from tools.fixtures.small_disks import fill, small_disk

LONG = "The roof looks like that of the twin. " * 50


@pytest.fixture(scope="module")
def places(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A data set of seven places on a disk of 2 MB."""
    folder = tmp_path_factory.mktemp("small") / "disk"
    with small_disk(folder, 2048) as mounted:
        if not mounted:
            pytest.skip("a small disk can be mounted by root alone")
        yield small_worlds.make_dataset(folder / "places", train=1, test=6)


@pytest.fixture(scope="module")
def small_app(places: Path, model_file: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[RunningApp]:
    with started(places, model_file, tmp_path_factory.mktemp("run") / "cache") as running:
        yield running


def open_row(lab: LabPage, row: int) -> str:
    """Open a query from the table, and return its path below the data."""
    lab.open_row(row)
    return str(lab.page.locator(".lab-note").get_attribute("data-path"))


@pytest.mark.slow
def test_a_note_a_view_and_a_story_are_not_lost_while_the_disk_is_full(
    places: Path, small_app: RunningApp, new_page: Callable[[], Page]
) -> None:
    lab = LabPage(new_page())
    lab.enter(small_app.url)
    tags, note, message = (lab.page.locator(name) for name in ("#lpn-lab-tags", "#lpn-lab-note", "#lpn-lab-message"))
    unsaved = lab.page.locator(".lab-note .unsaved")
    first = open_row(lab, 1)
    tags.fill("kept")
    tags.blur()
    expect(message).to_contain_text("Saved in notes.csv")
    filler = fill(places)
    second = open_row(lab, 2)
    note.fill(LONG)
    note.blur()
    expect(message).to_contain_text("Not saved. ")
    expect(message).to_contain_text("No space left on device); free space or choose another place.")
    expect(note).to_have_value(LONG)
    open_row(lab, 3)
    expect(message).to_contain_text("is not saved, and waits in this browser for Save.")
    expect(note).to_have_value("")
    expect(unsaved).to_be_hidden()
    open_row(lab, 2)
    expect(note).to_have_value(LONG)
    expect(unsaved).to_be_visible()
    assert read_notes(places / "notes.csv") == {first: Note(("kept",))}
    lab.page.reload()
    lab.enter(small_app.url)
    assert open_row(lab, 2) == second
    expect(note).to_have_value(LONG)
    filler.unlink()
    lab.page.locator(".lab-note a").click()
    expect(message).to_contain_text("Saved in notes.csv")
    expect(unsaved).to_be_hidden()
    assert read_notes(places / "notes.csv") == {first: Note(("kept",)), second: Note((), LONG.strip())}
    lab.key("b")
    expect(note).to_be_hidden()
    lab.key("b")
    expect(note).to_be_visible()
    expect(note).to_have_value(LONG)
    note.fill("short")
    note.blur()

    def saved() -> None:
        assert read_notes(places / "notes.csv")[second] == Note((), "short")

    lab.eventually(saved)  # the message of the save before may still stand there
    expect(message).to_contain_text("Saved in notes.csv")
    # A view and a story.
    page = lab.page
    filler = fill(places)
    page.locator(".lab-summary a", has_text="Views").click()
    page.locator("#lpn-lab-view-name").fill("dark roofs")
    page.locator("#lpn-lab-views a.button").click()
    expect(page.locator("#lpn-lab-views .error")).to_contain_text("No space left on device); free space")
    expect(page.locator("#lpn-lab-view-name")).to_have_value("dark roofs")
    lab.key("b")
    lab.key("s")
    notice = page.locator("#lpn-notice")
    expect(notice).to_contain_text("Not saved. ")
    expect(notice).to_contain_text("No space left on device); free space")
    assert not (places / "stories.json").exists()
    filler.unlink()
    lab.key("s")
    expect(notice).to_contain_text("is kept in stories.json")
    assert len(json.loads((places / "stories.json").read_bytes())[0]["steps"]) == 1
    lab.key("b")
    page.locator("#lpn-lab-views a.button").click()
    expect(page.locator("#lpn-lab-views .dim", has_text="Saved in views.json")).to_be_visible()
    assert json.loads((places / "views.json").read_bytes())["views"][0]["name"] == "dark roofs"


@pytest.fixture(scope="module")
def second_app(
    places: Path, model_file: Path, small_app: RunningApp, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[RunningApp]:
    """A second server over the same folder."""
    assert small_app.data == places
    with started(places, model_file, tmp_path_factory.mktemp("second") / "cache") as running:
        yield running


@pytest.mark.slow
@pytest.mark.parametrize(("apps", "row"), [(("small_app", "small_app"), 4), (("small_app", "second_app"), 5)])
def test_two_browsers_that_write_one_note_lose_neither(
    places: Path,
    apps: tuple[str, str],
    row: int,
    request: pytest.FixtureRequest,
    contexts: Callable[[], BrowserContext],
) -> None:
    """They use one server, or two over the same folder."""
    first, second = (LabPage(contexts().new_page()) for _ in range(2))
    for lab, app in zip((first, second), apps, strict=True):
        lab.enter(request.getfixturevalue(app).url)
        path = open_row(lab, row)
    note, message = "#lpn-lab-note", "#lpn-lab-message"
    first.page.locator(note).press_sequentially("mine")
    second.page.locator(note).fill("theirs")
    second.page.locator(note).blur()
    expect(second.page.locator(message)).to_contain_text("Saved in")
    first.page.locator(".lab-note a").click()
    expect(first.page.locator(message)).to_contain_text(
        "Not saved. Somebody else has changed this note meanwhile: it is now 'theirs'; save again to replace it."
    )
    expect(first.page.locator(note)).to_have_value("mine")
    expect(first.page.locator(note)).to_have_js_property("defaultValue", "theirs")  # what the next save replaces
    assert read_notes(places / "notes.csv")[path].text == "theirs"
    first.page.locator(note).fill("theirs, and mine")
    first.page.locator(note).blur()
    expect(first.page.locator(message)).to_contain_text("Saved in")
    assert read_notes(places / "notes.csv")[path].text == "theirs, and mine"
    if apps[0] == apps[1]:
        open_row(second, 3)
        open_row(second, row)
        expect(second.page.locator(note)).to_have_value("theirs, and mine")
    else:
        second.page.locator(note).fill("theirs again")
        second.page.locator(note).blur()
        expect(second.page.locator(message)).to_contain_text("it is now 'theirs, and mine'; save again to replace it.")
        expect(second.page.locator(note)).to_have_value("theirs again")
    # A view of one name: the second is told that it stands in place of the first.
    for lab, place in ((first, ""), (second, ", in place of the view of this name")):
        lab.page.locator(".lab-summary a", has_text="Views").click()
        lab.page.locator("#lpn-lab-view-name").fill(f"roofs {row}")
        lab.page.locator("#lpn-lab-views a.button").click()
        saved = f"Saved in views.json, beside the data, on the computer that runs this page{place}."
        expect(lab.page.locator("#lpn-lab-views .dim", has_text="Saved in")).to_have_text(saved)
