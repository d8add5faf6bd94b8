"""Tiny data sets of drawn pictures in the layouts of CVUSA, CVACT, Oxford5k, Paris6k, and pairs.csv."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.io import savemat

from lpn.core.images import Picture
from tests import worlds


def small(seed: int) -> Picture:
    """A drawn place, small enough to be quick."""
    return worlds.place(seed)[::2, ::2]


def cvusa(root: Path, train: int = 4, test: int = 3) -> Path:
    """Pairs numbered from 1, the annotation's column filled in train and empty in val, as in the release."""
    (root / "splits").mkdir(parents=True)
    for split, numbers in (("train", range(1, train + 1)), ("val", range(train + 1, train + test + 1))):
        lines = []
        for number in numbers:
            tile, panorama = f"bingmap/19/{number:07d}.jpg", f"streetview/panos/{number:07d}.jpg"
            worlds.write(root / tile, small(number))
            worlds.write(root / panorama, small(100 + number)[:24])
            note = f"streetview/annotations/{number:07d}.png" if split == "train" else ""
            lines.append(f"{tile},{panorama},{note}\n")
        (root / "splits" / f"{split}-19zl.csv").write_text("".join(lines))
    return root


def cvact(root: Path, inner: str = "", count: int = 7) -> Path:
    """Row 1 is of no split, 2 to 4 are to train on, 5 and 7 to test with, 5 to 7 valSetAll."""
    ids = [f"_{letter}AbCdEfGhIjKlMnOpQr-{row}" for row, letter in enumerate("abcdefg"[:count], 1)]
    for row, name in enumerate(ids, 1):
        worlds.write(root / inner / "streetview" / f"{name}_grdView.jpg", small(row)[:24])
        worlds.write(root / inner / "satview_polish" / f"{name}_satView_polish.jpg", small(row))
    save_act(root, ids, [2, 3, 4], [5, 7])
    return root


def save_act(root: Path, ids: list[str], train: list[int], val: list[int]) -> None:
    """ACT_data.mat: a character matrix of ids, and structs of column vectors."""
    column = {name: np.array(rows, np.float64)[:, None] for name, rows in (("train", train), ("val", val))}
    savemat(
        root / "ACT_data.mat",
        {
            "panoIds": np.array(ids),
            "utm": np.array([[693_000.0 + row, 6_090_000.0] for row in range(len(ids))]),
            "trainSet": {"trainInd": column["train"]},
            "valSet": {"valInd": column["val"]},
            "valSetAll": {"valInd": column["val"]},
        },
    )


def oxford(root: Path) -> Path:
    """Two landmarks with two queries each, and two pictures of neither, flat, as Oxford5k is unpacked."""
    names = ["all_souls_000001", "all_souls_000002", "all_souls_000003", "bodleian_000001", "bodleian_000002"]
    for seed, name in enumerate([*names, "oxford_000007", "oxford_000009"]):
        worlds.write(root / "oxbuild_images" / f"{name}.jpg", small(seed))
    truth = {
        "all_souls_1": ("oxc1_all_souls_000001 3.5 4.1 40.5 41", names[:2], names[2:3], ["oxford_000009"]),
        "all_souls_2": ("oxc1_all_souls_000002 0 0 20 20", names[:2], names[2:3], []),
        "bodleian_1": ("oxc1_bodleian_000001 1 1 30 30", names[3:5], [], ["oxford_000007", "all_souls_000003"]),
        "bodleian_2": ("oxc1_bodleian_000002 1 1 30 30", names[3:5], [], []),
    }
    for name, (query, *lists) in truth.items():
        ground_truth(root / "gt_files_170407", name, query, *lists)
    return root


def ground_truth(folder: Path, name: str, query: str, good: list[str], ok: list[str], junk: list[str]) -> None:
    """The four files of one query."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / f"{name}_query.txt").write_text(f"{query}\n")
    for kind, names in (("good", good), ("ok", ok), ("junk", junk)):
        (folder / f"{name}_{kind}.txt").write_text("".join(f"{picture}\n" for picture in names))


def paris(root: Path) -> Path:
    """One landmark in sub-folders, with a web server's answer in place of one picture, as in the archive."""
    names = ["paris_louvre_000001", "paris_louvre_000002", "paris_louvre_000136"]
    for seed, name in enumerate(names):
        worlds.write(root / "paris" / "louvre" / f"{name}.jpg", small(seed))
    (root / "paris" / "louvre" / "paris_louvre_000136.jpg").write_text("<html><title>302 Found</title></html>")
    worlds.write(root / "paris" / "eiffel" / "paris_eiffel_000004.jpg", small(9))
    ground_truth(
        *(root / "paris_120310", "louvre_1", "paris_louvre_000001 1 1 30 30"),
        *(names[:1], names[1:], ["paris_eiffel_000004"]),
    )
    return root


def pairs(root: Path, text: str) -> Path:
    """A pairs.csv, and a picture for every .jpg it names unless "absent" is in its name."""
    root.mkdir(parents=True, exist_ok=True)
    (root / "pairs.csv").write_text(text)
    for seed, name in enumerate(
        sorted({cell.strip() for cell in text.replace("\n", ",").split(",") if ".jpg" in cell})
    ):
        if "absent" not in name and not name.startswith(("..", "/")):
            worlds.write(root / name, small(seed))
    return root
