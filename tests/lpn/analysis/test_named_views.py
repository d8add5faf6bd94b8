from __future__ import annotations

import dataclasses
import os
from pathlib import Path

import pytest

from lpn.analysis import named_views
from lpn.analysis.named_views import LONGEST_NAME, MOST, ChosenQueries, NamedView, read_views, remove_view, save_view
from lpn.core.errors import DataError, InputError, OutputError

VIEW = NamedView(
    "dark \u201croofs\u201d", "t", "failed", "rank > 5", "00", (ChosenQueries("k", "l", ("a/1.jpg", "b.jpg")),)
)


def test_views_are_kept_by_task_and_name(tmp_path: Path) -> None:
    file = tmp_path / "views.json"
    assert read_views(file) == ()
    other = NamedView(VIEW.name, "s")
    save_view(file, VIEW)
    assert save_view(file, other) == read_views(file) == (other, VIEW)
    changed = NamedView(VIEW.name, "t", descending=True)
    assert save_view(file, changed) == (other, changed)
    assert remove_view(file, "t", "no such view") == (other, changed)
    assert remove_view(file, "t", VIEW.name) == read_views(file) == (other,)
    assert list(tmp_path.iterdir()) == [file]


@pytest.mark.parametrize("name", ["", "  ", "a" * (LONGEST_NAME + 1), "a\x00"])
def test_a_name_that_nobody_could_read_is_refused(tmp_path: Path, name: str) -> None:
    with pytest.raises(InputError, match="expected 1 to 60"):
        save_view(tmp_path / "views.json", NamedView(name, "t"))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("text", ["", "{", "[]", '{"views": 3}', '{"views": [{"name": 1}]}', '{"views": [], "x": 1}'])
def test_a_damaged_file_is_said_and_not_changed(tmp_path: Path, text: str) -> None:
    file = tmp_path / "views.json"
    file.write_text(text)
    for act in (lambda: read_views(file), lambda: save_view(file, VIEW)):
        with pytest.raises(DataError, match="correct it, or move it away"):
            act()
    assert file.read_text() == text


def test_no_file_is_saved_that_could_not_be_read_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = tmp_path / "views.json"
    save_view(file, VIEW)
    small = dataclasses.replace(named_views._FORMAT, max_bytes=file.stat().st_size + 50)
    monkeypatch.setattr(named_views, "_FORMAT", small)
    with pytest.raises(InputError, match="remove a view, or choose fewer queries"):
        save_view(file, NamedView("other", "t"))
    assert read_views(file) == (VIEW,)


def test_there_are_not_too_many_and_a_folder_must_be_writable(tmp_path: Path) -> None:
    file = tmp_path / "views.json"
    views = ",".join(f'{{"name":"v{i:03d}","task":"t"}}' for i in range(MOST))
    file.write_text(f'{{"views":[{views}]}}')
    with pytest.raises(InputError, match="100 views already"):
        save_view(file, VIEW)
    assert len(save_view(file, NamedView("v001", "t"))) == MOST
    if os.getuid():
        tmp_path.chmod(0o500)
        with pytest.raises(OutputError):
            save_view(file, NamedView("v001", "t"))
        tmp_path.chmod(0o700)
