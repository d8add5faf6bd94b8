"""The folder that should have been given as a data set's: above, below, or unpacked from an archive.

Nothing here opens a data set. Each function tells what a person most likely gave instead of its folder.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

from lpn.core.errors import DataError
from lpn.core.files import first_few, printable
from lpn.core.images import SUFFIXES
from lpn.datasets.base import hidden_name

# Folders right below a data set's, in any layout; the drone pictures of SUES-200 have a name of the user's.
_PARTS = frozenset(
    (
        *(
            "train",
            "test",
            "Training",
            "Testing",
            "satellite-view",
            "bingmap",
            "streetview",
            "splits",
            "splits__corrected",
        ),
        *("satview_polish", "ANU_data_small", "ANU_data_test", "drone", "satellite", "ground"),
        *("Chicago", "NewYork", "SanFrancisco", "Seattle"),
        *("Index", "images"),
    )
)
# The deepest list of a split is three folders below (Testing/150/query_drone).
_LEVELS = 3
# A search for a data set below looks into so many folders at most.
_MOST_FOLDERS = 2000
# The folders of a data set whose lists are files of their own, and these files.
_LISTED = {
    ("bingmap", "streetview"): "CVUSA's pictures and no splits/train-19zl.csv or splits/val-19zl.csv",
    ("satview_polish", "streetview"): "CVACT's pictures and no ACT_data.mat",
}
_TRAIN_SETS = ("satellite", "drone", "street", "google")
_TEST_LISTS = tuple(f"{role}_{view}" for role in ("query", "gallery") for view in ("drone", "satellite", "street"))
# What a file is by its ending, and what to do with it.
_ARCHIVE = "an archive", "unpack it first, and give the folder that it makes"
_VIDEO = (
    "of a flight",
    "read its frames with lpn flight {} --out FLIGHT, and give FLIGHT to lpn locate or lpn explore flight",
)
_MODEL = "a file of a model", "give it with --model, and a data set's folder with --data"
_ENDINGS = {
    **dict.fromkeys((".zip", ".tar", ".tgz", ".gz", ".7z", ".rar"), _ARCHIVE),
    **dict.fromkeys((".mp4", ".mov", ".srt"), _VIDEO),
    **dict.fromkeys((".pth", ".pt", ".ckpt", ".safetensors", ".onnx"), _MODEL),
}

Marked = Callable[[Path], object | None]


def no_folder(root: Path) -> DataError:
    """Return the error about a path that is no folder: an archive, a video, a model, another file, or nothing."""
    shown = printable(str(root))
    if root.is_file() and (told := _ENDINGS.get(root.suffix.lower())) is not None:
        return DataError(f"{shown} is {told[0]}; {told[1].format(shown)}.")
    if root.exists():
        return DataError(
            f"{shown} is a file; expected a data set's folder, so give --data {printable(str(root.parent))}."
        )
    return DataError(f"There is no data set folder at {shown}; check the path.")


def files_alone(root: Path) -> DataError | None:
    """Return the error about a folder of archives or videos without pictures; None for another folder."""
    told = {name: _ENDINGS.get(Path(name).suffix.lower()) for name in sorted(_names(root)) if not hidden_name(name)}
    first = next((of for of in told.values() if of is not None), None)
    if first is None:
        return None
    shown, listed = printable(str(root)), first_few([printable(name) for name, of in told.items() if of == first], 2)
    return DataError(f"{shown} holds {listed}, {first[0]}; {first[1].format(shown)}.")


def below(root: Path, marked: Marked) -> DataError | None:
    """Return the error about a folder around data sets, at any of three levels; it names the folder to give.

    Args:
        marked: recognises the layout of a folder, else returns None.
    """
    level, looked = [root], 0
    for _ in range(_LEVELS):
        level = [folder / name for folder in level for name in _folders(folder)][: _MOST_FOLDERS - looked]
        looked += len(level)
        if inner := [folder for folder in level if _recognised(folder, marked)]:
            listed = first_few([printable(folder.relative_to(root).as_posix()) for folder in inner], 5)
            return DataError(
                f"{printable(str(root))} holds data sets in folders of its own: {listed}; give --data "
                f"{printable(str(inner[0]))}."
            )
    return None


def above(root: Path, marked: Marked) -> Path | None:
    """Return the folder of the data set that a folder is a part of, such as University-Release of University-Release/test."""
    whole = root.resolve()
    for depth, folder in enumerate(whole.parents[: _LEVELS + 1], 1):
        first = whole.parts[-depth]
        part = first in _PARTS or ("drone" in first.lower() and (folder / "satellite-view").is_dir())
        if part and _recognised(folder, marked):
            near = os.path.relpath(folder)
            return folder if root.is_absolute() or near.startswith("..") else Path(near)
    return None


def part_of(root: Path, folder: Path) -> DataError:
    """Return the error about a folder that is a part of the data set in another one."""
    inside = root.resolve().relative_to(folder.resolve()).as_posix()
    return DataError(
        f"{printable(str(root))} is the part {printable(inside)} of a data set; give --data {printable(str(folder))}."
    )


def misplaced(root: Path) -> DataError | None:
    """Return the error about a folder that holds the lists of one split, splits in another case, or pictures without lists."""
    folders = _folders(root)
    for name in folders:
        lower = name.lower()
        if name != lower and lower in ("train", "test") and _lists_of(root / name) == lower:
            return DataError(f"{printable(str(root))} has the folder {name}; expected {lower}, so rename it.")
    for needed, listing in _LISTED.items():
        if set(needed) <= set(folders):
            return DataError(
                f"{printable(str(root))} has {listing}; its authors give such a list with the pictures, so put it there."
            )
    split = _lists_of(root)
    if split is None:
        return None
    held = [name for name in folders if name in (*_TRAIN_SETS, *_TEST_LISTS)]
    lists, name = first_few(held, 3), printable(str(root))
    if root.name.lower() == split:
        return DataError(f"{name} holds {lists}; rename it to {split}, and give --data {printable(str(root.parent))}.")
    query = next((view for view in ("drone", "street") if view in held), None)
    if split == "train" and query is not None and "satellite" in held:
        return DataError(
            f"{name} holds {lists}, and nothing says whether to train on them or to test with them; to train, move them into "
            f"{name}/train; to test, rename {query} to {name}/test/query_{query} and satellite to {name}/test/gallery_satellite. "
            f"Then give --data {name}."
        )
    return DataError(
        f"{name} holds {lists}, which belong into a folder {split}; move them into {name}/{split}, and give --data {name}."
    )


def holds_pictures(root: Path) -> bool:
    """Return whether pictures lie right in a folder."""
    return any(not hidden_name(name) and name.lower().endswith(SUFFIXES) for name in _names(root))


def _recognised(folder: Path, marked: Marked) -> bool:
    """Return whether a folder has a layout; a folder named train or test is not enough, as others have one, too."""
    try:
        if marked(folder) is None:
            return False
    except OSError:  # a folder that this user may not read
        return False
    names = set(_folders(folder))
    splits = names & {"train", "test"}
    if not splits or names & (_PARTS - {"train", "test"}):
        return True
    return any(_lists_of(folder / split) or _folders(folder / split)[:1] == ["150"] for split in splits)


def _lists_of(folder: Path) -> str | None:
    """Return the split, train or test, whose lists a folder holds; None if it holds neither's."""
    names = _folders(folder)
    if any(name in _TEST_LISTS for name in names):
        return "test"
    sets = [name for name in names if name in _TRAIN_SETS]
    numbered = [name for name in sets if any(place.isdecimal() for place in _folders(folder / name))]
    return "train" if len(numbered) > 1 else None


def _folders(folder: Path) -> list[str]:
    """Return the names of the folders in a folder, sorted, without those that systems add."""
    try:
        with os.scandir(folder) as entries:
            return sorted(entry.name for entry in entries if not hidden_name(entry.name) and entry.is_dir())
    except OSError:
        return []


def _names(folder: Path) -> list[str]:
    try:
        return os.listdir(folder)  # noqa: PTH208 (names are enough)
    except OSError:
        return []
