from __future__ import annotations

import logging
from pathlib import Path

import pytest

from lpn.core.errors import DataError
from lpn.datasets import open_dataset
from lpn.datasets.layouts.landmarks import CORRUPT
from tools.fixtures import layouts, small_worlds


def test_oxford_is_read_with_its_boxes_and_true_matches(tmp_path: Path) -> None:
    dataset = open_dataset(layouts.oxford(tmp_path))
    assert (dataset.kind, dataset.panoramas, dataset.tasks()) == ("Oxford5k", False, ["street-to-street"])
    queries, gallery = dataset.queries("street"), dataset.gallery("street")
    assert [(q.name, q.label, q.path.stem) for q in queries] == [
        ("all_souls_1", 0, "all_souls_000001"),
        ("all_souls_2", 0, "all_souls_000002"),
        ("bodleian_1", 1, "bodleian_000001"),
        ("bodleian_2", 1, "bodleian_000002"),
    ]
    assert queries[0].box == (3.5, 4.1, 40.5, 41.0)
    assert all(picture.box is None for picture in gallery)
    names = [picture.name for picture in gallery]
    assert names == sorted(names)
    assert len(names) == 7
    truth = dataset.truth("street-to-street")
    assert truth is not None
    good, junk = ([[names[i] for i in getattr(of, kind)] for of in truth[::2]] for kind in ("good", "junk"))
    assert good == [[f"all_souls_00000{i}" for i in (1, 2, 3)], ["bodleian_000001", "bodleian_000002"]]
    assert junk == [["oxford_000009"], ["all_souls_000003", "oxford_000007"]]
    assert truth[1].junk.tolist() == []
    assert {of.good.dtype.name for of in truth} | {of.junk.dtype.name for of in truth} == {"int64"}
    assert dataset.truth("street-to-satellite") is None


def test_labels_are_landmarks_or_pictures_of_their_own(tmp_path: Path) -> None:
    labels = {p.path.stem: p.label for p in open_dataset(layouts.oxford(tmp_path)).gallery("street")}
    assert [labels[name] for name in ("all_souls_000003", "bodleian_000002")] == [0, 1]
    others = [labels["oxford_000007"], labels["oxford_000009"]]
    assert min(others) >= 2
    assert len(set(others)) == 2


def test_broken_pictures_of_paris_are_left_out_and_named(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.WARNING):
        dataset = open_dataset(layouts.paris(tmp_path))
    assert dataset.kind == "Paris6k"
    names = [picture.name for picture in dataset.gallery("street")]
    assert names == ["paris_eiffel_000004", "paris_louvre_000001", "paris_louvre_000002"]
    truth = dataset.truth("street-to-street")
    assert truth is not None
    assert (truth[0].good.tolist(), truth[0].junk.tolist()) == ([1, 2], [0])
    (left_out,) = dataset.left_out
    assert (left_out.file, left_out.published) == ("paris/louvre/paris_louvre_000136.jpg", True)
    assert len(caplog.messages) == 1
    assert "paris_louvre_000136.jpg (is not a picture that can be read)" in caplog.text
    assert len(CORRUPT) == 20


def test_pictures_named_and_not_there_are_left_out(tmp_path: Path) -> None:
    layouts.oxford(tmp_path)
    for name in ("all_souls_000002", "oxford_000007"):
        (tmp_path / "oxbuild_images" / f"{name}.jpg").unlink()
    dataset = open_dataset(tmp_path)
    assert [query.name for query in dataset.queries("street")] == ["all_souls_1", "bodleian_1", "bodleian_2"]
    truth = dataset.truth("street-to-street")
    assert truth is not None
    assert len(truth) == 3
    assert [len(of.good) for of in truth] == [2, 2, 2]
    assert sorted(item.file for item in dataset.left_out) == ["all_souls_000002.jpg", "oxford_000007.jpg"]


@pytest.mark.parametrize(
    ("name", "text", "said"),
    [
        ("all_souls_1_query.txt", "oxc1_all_souls_000001 1 2 3\n", "expected one line: a picture's name and its box"),
        ("all_souls_1_query.txt", "oxc1_all_souls_000001 1 2 nan 9\n", "expected one line"),
        ("all_souls_1_query.txt", "oxc1_all_souls_000001 9 2 3 9\n", "expected one line"),
        ("all_souls_1_query.txt", "", "says 'nothing' in 0 lines"),
        ("bodleian_1_ok.txt", None, r"bodleian_1_ok\.txt cannot be read \(No such file"),
    ],
)
def test_wrong_ground_truth_is_named(name: str, text: str | None, said: str, tmp_path: Path) -> None:
    file = layouts.oxford(tmp_path) / "gt_files_170407" / name
    if text is None:
        file.unlink()
    else:
        file.write_text(text)
    with pytest.raises(DataError, match=said):
        open_dataset(tmp_path)


def test_two_pictures_of_one_name_are_refused(tmp_path: Path) -> None:
    layouts.oxford(tmp_path)
    small_worlds.write(tmp_path / "small" / "bodleian_000001.jpg", layouts.small(1))
    with pytest.raises(DataError, match=r"two pictures of one name, oxbuild_images/bodleian_000001\.jpg and small/"):
        open_dataset(tmp_path)


def test_ground_truth_without_pictures_is_refused(tmp_path: Path) -> None:
    layouts.ground_truth(tmp_path, "x_1", "x_000001 1 1 3 3", [], [], [])
    with pytest.raises(DataError, match=r"the first file left out is x_000001\.jpg"):
        open_dataset(tmp_path)
