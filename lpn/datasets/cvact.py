"""CVACT (Liu & Li 2019): pairs of a tile and a panorama in Canberra, listed in a MATLAB file.

    ACT_data.mat    panoIds, and the 1-based rows trainSet.trainInd, valSet.valInd, valSetAll.valInd
    [ANU_data_small/]streetview/<id>_grdView.jpg, [ANU_data_small/]satview_polish/<id>_satView_polish.jpg

Some copies hold .png files. The test split is CVACT_val (valSet). The label of a pair is its row.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from lpn.core.arrays import Int64Array
from lpn.core.errors import DataError
from lpn.core.files import printable
from lpn.datasets import matlab
from lpn.datasets.base import LeftOut, ListedDataset, Picture, Size, warn_left_out
from lpn.datasets.listed_paths import FilesBelow

NAME = "ACT_data.mat"
FULL = {
    "train/satellite": Size(35_532, 35_532),
    "train/street": Size(35_532, 35_532),
    "test/satellite": Size(8_884, 8_884),
    "test/street": Size(8_884, 8_884),
}
_FOLDERS = ("", "ANU_data_small/", "ANU_data_test/")
_FILES = {"satellite": "satview_polish/{}_satView_polish", "street": "streetview/{}_grdView"}
_ID = re.compile(r"[A-Za-z0-9_-]{1,64}")


class CVACT(ListedDataset):
    """A folder in CVACT's layout. Incomplete pairs are left out and logged once.

    Raises:
        DataError: if ACT_data.mat is malformed, or no pair is complete.
        ModuleNotFoundError: if scipy is not installed.
    """

    kind = "CVACT"
    panoramas = True

    def __init__(self, root: Path) -> None:
        ids, rows = _read(root / NAME)
        there, left_out = FilesBelow(root), []
        pictures: dict[str, dict[str, list[Picture]]] = {}
        for split, indices in rows.items():
            of_split: dict[str, list[Picture]] = {view: [] for view in _FILES}
            for row in indices.tolist():
                paths = {view: _find(there, view, ids[row - 1]) for view in _FILES}
                left_out += [
                    LeftOut(f"{_FILES[view].format(ids[row - 1])}.jpg", "is not there")
                    for view, file in paths.items()
                    if file is None
                ]
                for view, file in paths.items():
                    if file is not None and None not in paths.values():
                        name = printable(ids[row - 1])
                        of_split[view].append(Picture(root / file, row, name, panorama=view == "street"))
            pictures[split] = of_split
        if not any(pictures[split]["street"] for split in pictures):
            raise DataError(
                f"{root.name} has none of the pairs that {NAME} lists; expected their files in streetview and satview_polish, "
                "or in these folders below ANU_data_small."
            )
        super().__init__(root, pictures["train"], pictures["test"], pictures["test"], f"a valSet in {NAME}")
        self.left_out = left_out
        self.published_sizes = FULL
        warn_left_out(
            self.root.name, self.left_out, f"files named in {NAME} cannot be used", "their pairs are left out"
        )


def _find(there: FilesBelow, view: str, name: str) -> str | None:
    """Return the path of a pair's picture below the root."""
    files = (f"{folder}{_FILES[view].format(name)}{suffix}" for folder in _FOLDERS for suffix in (".jpg", ".png"))
    return next((path for file in files if (path := there.find(file)) is not None), None)


def _read(path: Path) -> tuple[list[str], dict[str, Int64Array]]:
    """Return the ids of all panoramas, and the 1-based rows of the training and test pairs."""
    expected = "a MATLAB 5 file with panoIds, trainSet.trainInd, and valSet.valInd"
    values = matlab.load(path, ["panoIds", "trainSet", "valSet"], expected)
    try:
        ids = [str(name).strip() for name in np.atleast_1d(values["panoIds"]).reshape(-1)]
        raw = {"train": values["trainSet"]["trainInd"], "test": values["valSet"]["valInd"]}
        rows = {split: np.atleast_1d(np.asarray(indices)).reshape(-1) for split, indices in raw.items()}
    except (KeyError, TypeError, IndexError, ValueError) as error:
        raise DataError(f"{NAME} has other variables inside than CVACT's; expected {expected}.") from error
    for name in ids:
        if not _ID.fullmatch(name):
            raise DataError(f"{NAME} has the panoId {printable(name)!r}; expected letters, digits, - and _ only.")
    for split, indices in rows.items():
        whole = indices.dtype.kind in "iu" or (indices.dtype.kind == "f" and bool((indices == np.floor(indices)).all()))
        if not whole or (len(indices) and (indices.min() < 1 or indices.max() > len(ids))):
            raise DataError(f"{NAME} has {split} rows that are not whole numbers from 1 to {len(ids)}, its panoIds.")
        if len(np.unique(indices)) < len(indices):
            raise DataError(f"{NAME} lists a {split} row twice; expected each pair once.")
    return ids, {split: indices.astype(np.int64) for split, indices in rows.items()}
