from __future__ import annotations

import dataclasses
from pathlib import Path

import msgspec
import pytest

from explorer.cli import StoryList
from explorer.stories import library
from explorer.stories.story import MOST_STEPS, Step, Story
from lpn.core.demo import DEMO, DEMO_FLIGHT, DEMO_PLACE
from lpn.core.errors import DataError, InputError, OutputError

ONE = Story("Ünë <b>", (Step("query=a", 'Say "hi"\nto all', "noted"),))
OTHER = Story("Other", (Step("query=b"),))
_SHIPPED = {story.name: len(story.steps) for story in library.read_stories(DEMO / "stories.json")}


def write(folder: Path, *stories: Story) -> None:
    """Write stories as a person does, by an editor."""
    (folder / "stories.json").write_bytes(msgspec.json.encode(stories))


def test_what_is_kept_is_read_back_and_can_be_read_by_people(tmp_path: Path) -> None:
    assert library.read_all(tmp_path) == library.Stories({})
    assert library.keep(tmp_path, ONE.steps[0], ONE.name) == ONE
    library.keep(tmp_path, OTHER.steps[0], OTHER.name)
    assert library.read_all(tmp_path) == library.Stories({ONE.name: ONE, "Other": OTHER})
    text = (tmp_path / "stories.json").read_text("utf-8")
    assert '    "name": "Ünë <b>",\n' in text
    assert library.place(tmp_path) == "stories.json, beside the data, on the computer that runs this page"


def test_a_step_is_added_to_its_story_as_the_file_has_it_now(tmp_path: Path) -> None:
    library.keep(tmp_path, OTHER.steps[0], None)
    edited = Story("Story 1", (Step("query=b", "An edited caption"),))
    write(tmp_path, edited, ONE)
    assert library.keep(tmp_path, Step("query=c"), "Story 1").steps == (*edited.steps, Step("query=c"))
    assert list(library.read_all(tmp_path).by_name) == ["Story 1", ONE.name]


def test_a_step_follows_its_story_to_the_name_that_a_person_gave_it(tmp_path: Path) -> None:
    begun = library.keep(tmp_path, Step("query=b"), None).steps
    renamed = Story("Mine", (Step("query=b", "An edited caption"), Step("query=d")))
    write(tmp_path, ONE, renamed)
    kept = library.keep(tmp_path, Step("query=c"), "Story 1", begun=begun)
    assert kept == Story("Mine", (*renamed.steps, Step("query=c")))
    assert list(library.read_all(tmp_path).by_name) == [ONE.name, "Mine"]
    assert library.keep(tmp_path, Step("query=c"), None, begun=kept.steps).name == "Story 1", "another one is begun"


@pytest.mark.parametrize("stories", [(OTHER, Story("Twin", OTHER.steps)), (ONE,), (Story("Empty"),)])
def test_a_story_that_no_other_or_several_may_be_is_begun_again(tmp_path: Path, stories: tuple[Story, ...]) -> None:
    write(tmp_path, *stories)
    kept = library.keep(tmp_path, Step("query=c"), "Story 1", begun=OTHER.steps)
    assert library.read_stories(tmp_path / "stories.json") == [*stories, kept]
    assert kept == Story("Story 1", (Step("query=c"),))


def test_a_new_story_takes_no_name_of_another(tmp_path: Path) -> None:
    write(tmp_path, Story("Story 1", ONE.steps))
    assert library.keep(tmp_path, Step("query=c"), None, ["Story 2", "Tour"]).name == "Story 3"
    assert library.read_all(tmp_path).by_name["Story 1"].steps == ONE.steps


def test_a_full_story_is_not_changed(tmp_path: Path) -> None:
    write(tmp_path, Story("Full", ONE.steps * MOST_STEPS))
    before = (tmp_path / "stories.json").read_bytes()
    with pytest.raises(InputError, match="begin another one"):
        library.keep(tmp_path, Step("query=c"), "Full")
    assert (tmp_path / "stories.json").read_bytes() == before


@pytest.mark.parametrize(
    ("content", "found"),
    [
        (b"[{", "truncated"),
        (b'{"name": "x"}', "array"),
        (b'[{"name": "x", "steps": [{"caption": "c"}]}]', "missing required field `shows`"),
        (b'[{"name": "x", "steps": [], "colour": 1}]', "unknown field `colour`"),
        (b'[{"name": ""}]', "length"),
        (b'[{"name": "x"}, {"name": "x"}]', "two stories named 'x'"),
        (b'[{"name": "\xff"}]', "not a file of stories"),
        (b"[" * 100_000, "not a file of stories"),
    ],
)
def test_a_damaged_file_is_one_sentence_and_is_not_overwritten(tmp_path: Path, content: bytes, found: str) -> None:
    (tmp_path / "stories.json").write_bytes(content)
    with pytest.raises(DataError, match=r"stories\.json .*; ") as raised:
        library.keep(tmp_path, ONE.steps[0], ONE.name)
    assert found in str(raised.value)
    stories = library.read_all(tmp_path)
    assert (stories.by_name, stories.errors) == ({}, (str(raised.value),))
    assert (tmp_path / "stories.json").read_bytes() == content


def test_no_file_is_saved_that_could_not_be_read_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    library.keep(tmp_path, ONE.steps[0], ONE.name)
    small = dataclasses.replace(library._FORMAT, max_bytes=(tmp_path / "stories.json").stat().st_size + 50)
    monkeypatch.setattr(library, "_FORMAT", small)
    with pytest.raises(InputError, match="delete another story first"):
        library.keep(tmp_path, ONE.steps[0], "Two")
    stories = library.read_all(tmp_path)
    assert (stories.by_name, stories.errors) == ({ONE.name: ONE}, ())


def test_a_place_that_cannot_be_written_is_one_sentence(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match=r"stories\.json cannot be written"):
        library.keep(tmp_path / "file", ONE.steps[0], ONE.name)


def test_stories_of_the_demo_are_saved_in_the_user_s_folder(tmp_path: Path) -> None:
    shipped = (DEMO / "stories.json").read_bytes()
    names = list(library.read_all(DEMO).by_name)
    shown = library.read_all(DEMO).by_name[names[0]]
    library.keep(DEMO, Step("query=c"), names[0])
    library.keep(DEMO, ONE.steps[0], ONE.name)
    assert (DEMO / "stories.json").read_bytes() == shipped
    changed = Story(names[0], (Step("query=c"),))
    assert library.read_stories(tmp_path / "home" / "lpn-explorer" / "demo" / "stories.json") == [changed, ONE]
    stories = library.read_all(DEMO).by_name
    assert list(stories) == [*names, ONE.name]
    assert stories[names[0]] == changed != shown, "the user's own replaces the shipped one"


def test_the_command_lists_the_stories(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write(tmp_path, ONE, Story("Empty"))
    StoryList(source=tmp_path).run()
    assert capsys.readouterr().out == "Ünë <b>  (1 steps)\nEmpty  (0 steps)\n"
    (tmp_path / "stories.json").write_text("[")
    StoryList(source=tmp_path).run()
    assert "is not a file of stories" in capsys.readouterr().err
    with pytest.raises(InputError, match=r"There is no folder .*missing'; give that of a data set or flight"):
        StoryList(source=tmp_path / "missing").run()


def test_the_command_lists_the_stories_of_all_that_ships(capsys: pytest.CaptureFixture[str]) -> None:
    library.keep(DEMO_PLACE[1], ONE.steps[0], None)
    library.keep(DEMO_FLIGHT[1], ONE.steps[0], None)
    StoryList().run()
    *city, place, flight = capsys.readouterr().out.splitlines()
    assert city == [f"{name}  ({n} steps, a computer-generated city)" for name, n in _SHIPPED.items()]
    assert place == "Story 1  (1 steps, a real flight)"
    assert flight == "Story 1  (1 steps, a computer-generated flight)"


def test_the_command_says_in_one_line_that_there_is_no_story(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    StoryList(source=tmp_path).run()
    said = capsys.readouterr().out
    assert said == "There is no story yet. S on the page of lpn explore keeps what is shown as the step of one.\n"


def test_the_command_says_once_what_hinders_all(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def homeless(*_: object) -> Path:
        raise OutputError("There is no home.")

    monkeypatch.setattr(library, "own_file", homeless)
    StoryList().run()
    said = capsys.readouterr()
    assert (said.err, len(said.out.splitlines())) == ("lpn: There is no home.\n", len(_SHIPPED))
