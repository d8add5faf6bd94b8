"""Stories as a person keeps, changes, and saves them, and the commands that do so while their panel is closed."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing
from importlib.util import find_spec
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest

from explorer.app import App
from explorer.opening import open_model
from explorer.screen.panels.stories import story as files
from explorer.screen.panels.stories.story import Step, Story
from explorer.workspace import LazyWorkspace, Workspace
from lpn.core.demo import DEMO, DEMO_MODEL
from lpn.core.errors import DataError, InputError, OutputError
from tests.explorer.conftest import Tab, get

ONE = Story("Ünë <b>", (Step("query=a", 'Say "hi"\nto all', "noted"),))
DEMO_CITY: Any = SimpleNamespace(root=DEMO, model_name=DEMO_MODEL.name, stories=None)


@pytest.fixture
def file(workspace: Workspace, tmp_path: Path) -> Iterator[Path]:
    """The file in which the page keeps stories."""
    workspace.stories = tmp_path / "own.json"
    yield workspace.stories
    workspace.stories = None


def panel(tab: Tab, holds: Any) -> dict[str, Any]:
    """Return the panel's message once it fulfils a condition."""
    of = tab.until(lambda last: "panel" in last and holds(last["panel"]["message"]))
    return cast("dict[str, Any]", of["panel"]["message"])


def downloaded(app: App, tab: Tab) -> tuple[str, str]:
    """Return the name and the text of the file that the browser saves."""
    last = tab.until(lambda last: "download" in last)
    status, headers, body = get(app, "/" + last["download"]["address"])
    assert (status, headers["Content-Type"]) == (200, "application/octet-stream")
    return last["download"]["name"], body.decode()


def test_s_keeps_what_is_shown_with_its_headline_while_no_panel_is_open(tab: Tab, file: Path) -> None:
    result = tab.open("?query=0004&angle=30&theme=light&find=00&weights=1,0,1,1")
    tab.act("stories.keep")
    assert "Step 1 of Story 1" in tab.until(lambda last: "note" in last)["note"]
    tab.set(panel="stories")
    tab.act("stories.keep")
    tab.until(lambda last: "Step 2" in last["note"])
    (kept,) = files.read_stories(file)
    said = result["headline"]
    assert kept.steps[0].shows == kept.steps[1].shows, "neither theme, nor search, nor the panel of stories"
    assert kept.steps[0].caption.endswith(f", {said['title']}. {said['reason']}")
    tab.act("open", search=kept.steps[0].shows)
    again = tab.until(lambda last: last["state"]["panel"] == "")["state"]
    assert (again["query"], again["angle"], again["weights"]) == (2, 30, [1, 0, 1, 1])
    assert again["theme"] == "light", "the page keeps its theme"


def test_a_photo_of_one_s_own_is_no_step(tab: Tab, file: Path, workspace: Workspace) -> None:
    tab.open()
    photo = workspace.tasks["drone-to-satellite"].queries[1].path.read_bytes()
    tab.act("upload", name="own.jpg", size=len(photo))
    tab.socket.send(photo)
    tab.until(lambda last: last["state"]["own"])
    tab.act("stories.keep")
    tab.error("your own photo exists in this tab alone")
    assert not file.exists()


def test_the_panel_changes_the_steps_of_a_story_as_the_file_has_it(tab: Tab, file: Path) -> None:
    steps = (Step("query=0003", "a"), Step("query=0005", "b", "n"), Step("query=0002&angle=15", "c"))
    for made in (Story("Mine", steps), Story("Other")):
        files.change(file, made, lambda one: one)
    tab.open("?panel=stories&story=Mine")
    shown = panel(tab, lambda message: message["story"] == "Mine")
    assert [(step["shows"], step["caption"]) for step in shown["steps"]] == [(one.shows, one.caption) for one in steps]
    assert all(step["picture"] for step in shown["steps"])
    tab.act("stories.step", story="Mine", at=2, shows=steps[2].shows, to=1, caption="c")
    panel(tab, lambda message: [step["caption"] for step in message["steps"]] == ["a", "c", "b"])
    tab.act("stories.step", story="Mine", at=0, shows=steps[0].shows, to=0, caption="A", notes="N")
    panel(tab, lambda message: message["steps"][0]["caption"] == "A")
    tab.act("stories.step", story="Mine", at=2, shows=steps[2].shows)
    tab.error("changed meanwhile")  # the third step is another one
    tab.act("stories.step", story="Mine", at=1, shows=steps[2].shows)
    panel(tab, lambda message: len(message["steps"]) == 2)
    tab.act("stories.rename", story="Mine", name="Other")
    tab.error("There is a story 'Other' already")
    tab.act("stories.rename", story="Mine", name=" Yours ")
    panel(tab, lambda message: message["story"] == "Yours")
    assert files.read_stories(file)[0] == Story("Yours", (Step("query=0003", "A", "N"), steps[1]))
    tab.act("stories.delete", story="Yours")
    panel(tab, lambda message: message["names"] == ["Other"])
    assert files.read_stories(file) == [Story("Other")]


def test_a_saved_story_shows_each_step_and_needs_nothing_else(app: App, tab: Tab, file: Path) -> None:
    steps = (
        Step("query=0003&scoring=plain", "<script>alert(1)</script>", "not for the audience"),
        Step("query=0005&angle=40&weights=1,0,1,1", "caf\x1b"),
    )
    files.change(file, Story('A <b>"story"</b>', steps), lambda one: one)
    tab.open("?panel=stories")
    tab.act("stories.export", story='A <b>"story"</b>')
    name, page = downloaded(app, tab)
    assert name == "A--b--story---b-.html"
    assert page.count('<section class="case') == 2
    assert "alert(1)" in page
    assert "<script" not in page
    assert "not for the audience" not in page
    assert "\x1b" not in page
    assert "turned by 40°" in page
    files.change(file, Story("Old", (Step("query=gone"),)), lambda one: one)
    tab.act("stories.export", story="Old")
    tab.error("Step 1 cannot be shown: query")


def test_a_step_of_another_place_leads_back_there(workspace: Workspace, model_file: Path, tmp_path: Path) -> None:
    def opened() -> Workspace:
        return open_model(workspace.root, model_file)

    others = {"second": LazyWorkspace("a second place", opened)}
    app = App(opened(), "127.0.0.1", 0, None, "places", others, stories=tmp_path / "own.json")
    with closing(app):
        tab = Tab(app)
        tab.open("?theme=light")
        tab.set(place="second")
        tab.result(place="second")
        tab.set(query=3)
        tab.result(query=3)
        assert tab.last["state"]["address"].startswith("show=second&"), "a reloaded page stays there"
        tab.act("stories.keep")
        tab.until(lambda last: "note" in last)
        tab.set(place="data")
        tab.result(place="data")
        ((step,),) = (story.steps for story in files.read_stories(tmp_path / "own.json"))
        tab.act("open", search=step.shows)
        assert tab.result(place="second", query=3)["state"]["theme"] == "light"
        tab.act("open", search="query=0002")
        assert tab.result(query=0)["state"]["place"] == "second", "an address without a place stays there"
        tab.socket.close()


def test_commands_save_reports_of_what_is_shown(app: App, tab: Tab, workspace: Workspace) -> None:
    result = tab.open("?query=0005")
    assert {one["name"] for one in tab.last["page"]["commands"]} >= {"report.answer", "report.worst", "stories.keep"}
    assert "report" not in {one["name"] for one in tab.last["page"]["panels"]}, "it has nothing to open"
    tab.act("report.answer")
    name, page = downloaded(app, tab)
    assert name == "0005.html"
    assert result["headline"]["reason"].rstrip(".") in page
    del tab.last["download"]
    tab.set(find="report")  # the words by which a person finds the command
    tab.act("report.worst")
    name, page = downloaded(app, tab)
    ranking = workspace.rankings["drone-to-satellite"]
    missed = [workspace.tasks["drone-to-satellite"].query_names[query] for query in ranking.failed.nonzero()[0]]
    assert page.count('<section class="case') == len(missed)
    assert all(f"Missed: {one}</h2>" in page for one in missed)
    if find_spec("matplotlib"):
        del tab.last["download"]
        tab.act("report.figure")
        assert tab.until(lambda last: "download" in last)["download"]["name"] == "0005.pdf"


@pytest.mark.parametrize(
    ("content", "found"),
    [
        (b"[{", "truncated"),
        (b'[{"name": "x", "steps": [{"caption": "c"}]}]', "missing required field `shows`"),
        (b'[{"name": "x", "steps": [], "colour": 1}]', "unknown field `colour`"),
        (b'[{"name": ""}]', "length"),
        (b'[{"name": "x"}, {"name": "x"}]', "two stories named 'x'"),
        (b'[{"name": "\xff"}]', "not a file of stories"),
        (b"[" * 100_000, "not a file of stories"),
    ],
)
def test_a_damaged_file_is_one_sentence_and_is_not_overwritten(tmp_path: Path, content: bytes, found: str) -> None:
    file = tmp_path / "stories.json"
    file.write_bytes(content)
    with pytest.raises(DataError, match=r"stories\.json .*; ") as raised:
        files.change(file, ONE, lambda one: one)
    assert found in str(raised.value)
    beside: Any = SimpleNamespace(root=tmp_path, model_name="x", stories=None)
    assert files.stories_of(beside) == files.Stories({}, set(), str(raised.value))
    assert file.read_bytes() == content


def test_what_a_story_cannot_hold_leaves_the_file_as_it_is(tmp_path: Path) -> None:
    file = tmp_path / "stories.json"
    full = Story("Full", ONE.steps * 60)
    files.change(file, full, lambda one: one)
    before = file.read_bytes()
    assert files.read_stories(file) == [full], "it is read back"
    with pytest.raises(InputError, match="begin another one"):
        files.change(file, full, lambda now: Story(now.name, (*now.steps, ONE.steps[0])))
    with pytest.raises(InputError, match="shorten it"):
        files.change(file, ONE, lambda now: Story(now.name, (Step("", "x" * 401),)))
    with pytest.raises(OutputError, match="cannot be written"):
        files.change(file / "under", ONE, lambda one: one)
    assert file.read_bytes() == before


def test_what_is_changed_of_the_demo_is_kept_in_the_user_s_folder(tmp_path: Path) -> None:
    shipped = files.stories_of(DEMO_CITY)
    assert (list(shipped.by_name), shipped.own) == (["A first look", "Found", "A twin", "Not found"], set())
    own = files.own_stories(DEMO_CITY)
    assert own == tmp_path / "home" / "lpn-explorer" / "demo" / "stories.json"
    changed = files.change(own, shipped.by_name["Found"], lambda now: Story(now.name, now.steps[:1]))
    files.change(own, ONE, lambda one: one)
    now = files.stories_of(DEMO_CITY)
    assert list(now.by_name) == [*shipped.by_name, ONE.name]
    assert now.by_name["Found"] == changed != shipped.by_name["Found"]
    files.change(own, Story("Found"), lambda _: None)
    assert files.stories_of(DEMO_CITY).by_name["Found"] == shipped.by_name["Found"]
    other: Any = SimpleNamespace(root=DEMO, model_name="mine.onnx", stories=None)
    assert list(files.stories_of(other).by_name) == [ONE.name], "captions are of the demo's own model"
