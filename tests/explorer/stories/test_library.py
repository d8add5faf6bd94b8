from __future__ import annotations

import dataclasses
from pathlib import Path

import pytest

from explorer.stories import library
from explorer.stories.story import Step, Story, StoryDraft
from lpn.core.demo import DEMO
from lpn.core.errors import DataError, InputError, OutputError

ONE = Story("Ünë <b>", (Step("query=a", 'Say "hi"\nto all', "noted"),))
OTHER = Story("Other", (Step("query=b"),))


def test_what_is_saved_is_read_back_and_can_be_read_by_people(tmp_path: Path) -> None:
    assert library.read_all(tmp_path) == library.Stories({})
    saved = library.save(tmp_path, StoryDraft(ONE))
    library.save(tmp_path, StoryDraft(OTHER))
    assert saved == StoryDraft(ONE, ONE)
    assert library.read_all(tmp_path) == library.Stories({ONE.name: ONE, "Other": OTHER})
    text = (tmp_path / "stories.json").read_text("utf-8")
    assert '    "name": "Ünë <b>",\n' in text
    assert library.place(tmp_path) == "stories.json, beside the data, on the computer that runs this page"


def test_a_saved_story_takes_the_place_of_the_one_that_was_opened(tmp_path: Path) -> None:
    library.save(tmp_path, StoryDraft(ONE))
    library.save(tmp_path, StoryDraft(OTHER))
    renamed = Story("Renamed", ONE.steps)
    assert library.save(tmp_path, StoryDraft(renamed, ONE)).opened == renamed
    assert list(library.read_all(tmp_path).by_name) == ["Renamed", "Other"]
    assert library.save(tmp_path, StoryDraft(Story("Renamed"), renamed)).opened is None
    assert list(library.read_all(tmp_path).by_name) == ["Other"]


def test_nobody_s_story_is_overwritten_unseen(tmp_path: Path) -> None:
    library.save(tmp_path, StoryDraft(ONE))
    library.save(tmp_path, StoryDraft(OTHER))
    before = (tmp_path / "stories.json").read_bytes()
    with pytest.raises(InputError, match="another story named 'Other'"):
        library.save(tmp_path, StoryDraft(Story("Other", ONE.steps)))
    with pytest.raises(InputError, match="another story named 'Other'"):
        library.save(tmp_path, StoryDraft(Story("Other", ONE.steps), ONE))
    theirs = Story(ONE.name, ())
    with pytest.raises(InputError, match="changed by somebody else"):
        library.save(tmp_path, StoryDraft(Story(ONE.name, OTHER.steps), theirs))
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
        library.save(tmp_path, StoryDraft(ONE))
    assert found in str(raised.value)
    stories = library.read_all(tmp_path)
    assert (stories.by_name, stories.errors) == ({}, (str(raised.value),))
    assert (tmp_path / "stories.json").read_bytes() == content


def test_no_file_is_saved_that_could_not_be_read_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    library.save(tmp_path, StoryDraft(ONE))
    small = dataclasses.replace(library._FORMAT, max_bytes=(tmp_path / "stories.json").stat().st_size + 50)
    monkeypatch.setattr(library, "_FORMAT", small)
    with pytest.raises(InputError, match="delete another story first"):
        library.save(tmp_path, StoryDraft(Story("Two", ONE.steps)))
    stories = library.read_all(tmp_path)
    assert (stories.by_name, stories.errors) == ({ONE.name: ONE}, ())


def test_a_place_that_cannot_be_written_is_one_sentence(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match=r"stories\.json cannot be written"):
        library.save(tmp_path / "file", StoryDraft(ONE))


def test_stories_of_the_demo_are_saved_in_the_user_s_folder(tmp_path: Path) -> None:
    shipped = (DEMO / "stories.json").read_bytes()
    names = list(library.read_all(DEMO).by_name)
    opened = library.read_all(DEMO).by_name[names[0]]
    changed = Story(opened.name, opened.steps[:1])
    library.save(DEMO, StoryDraft(changed, opened))
    library.save(DEMO, StoryDraft(ONE))
    assert (DEMO / "stories.json").read_bytes() == shipped
    assert library.read_stories(tmp_path / "home" / "lpn-explorer" / "demo" / "stories.json") == [changed, ONE]
    stories = library.read_all(DEMO).by_name
    assert list(stories) == [*names, ONE.name]
    assert stories[names[0]] == changed, "the user's own replaces the shipped one"
