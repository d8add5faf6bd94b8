"""CVACT (Liu & Li 2019): pairs of a tile and a panorama in Canberra, listed in a MATLAB file.

    ACT_data.mat    panoIds, and the 1-based rows trainSet.trainInd, valSet.valInd, valSetAll.valInd
    [ANU_data_small/]streetview/<id>_grdView.jpg, [ANU_data_small/]satview_polish/<id>_satView_polish.jpg

Some copies hold .png files. The test split is CVACT_val (valSet). The label of a pair is its row.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from lpn.core.arrays import Int64Array
from lpn.core.errors import DataError
from lpn.datasets import matlab
from lpn.datasets.base import Dataset, PictureRow, sizes

NAME = "ACT_data.mat"
_FOLDERS = ("", "ANU_data_small/", "ANU_data_test/")
_FILES = {"satellite": "satview_polish/{}_satView_polish", "street": "streetview/{}_grdView"}


class CVACT(Dataset):
    """A folder in CVACT's layout. Incomplete pairs are left out.

    Raises:
        DataError: if ACT_data.mat is malformed, or no pair is complete.
        ModuleNotFoundError: if scipy is not installed.
    """

    kind = "CVACT"
    marks = ((NAME,),)
    expected = f"their files in streetview and satview_polish, here or below ANU_data_small, for the pairs in {NAME}"
    panoramas = True
    published_sizes = sizes(
        train={"satellite": (35_532, 35_532), "street": (35_532, 35_532)},
        test={"satellite": (8_884, 8_884), "street": (8_884, 8_884)},
    )

    def rows(self) -> Iterator[PictureRow]:
        ids, rows = _read(self.root / NAME)
        for split, indices in rows.items():
            for row in indices.tolist():
                name = ids[row - 1]
                files = {view: self._find(file.format(name)) for view, file in _FILES.items()}
                pair = (PictureRow(f"{split}/{view}", file, row, name) for view, file in files.items())
                yield from self.together(*pair)

    def _find(self, file: str) -> str:
        """Return the path of a picture in any of the published folders; if it is missing, a path without a folder."""
        files = (f"{folder}{file}{suffix}" for folder in _FOLDERS for suffix in (".jpg", ".png"))
        return next((path for path in map(self.files.find, files) if path is not None), f"{file}.jpg")


def _read(path: Path) -> tuple[list[str], dict[str, Int64Array]]:
    """Return the ids of all panoramas, and the 1-based rows of the training and test pairs."""
    expected = "a MATLAB 5 file with panoIds, trainSet.trainInd, and valSet.valInd"
    values = matlab.load(path, ["panoIds", "trainSet", "valSet"], expected, simplify=True)
    try:
        ids = [str(name).strip() for name in np.atleast_1d(values["panoIds"]).reshape(-1)]
        raw = {"train": values["trainSet"]["trainInd"], "test": values["valSet"]["valInd"]}
        rows = {split: np.atleast_1d(np.asarray(indices)).reshape(-1) for split, indices in raw.items()}
    except (KeyError, TypeError, IndexError, ValueError) as error:
        raise DataError(f"{NAME} has other variables inside than CVACT's; expected {expected}.") from error
    for split, indices in rows.items():
        if indices.dtype.kind not in "iuf" or not np.isin(indices, np.arange(1, len(ids) + 1)).all():
            raise DataError(f"{NAME} has {split} rows that are not whole numbers from 1 to {len(ids)}, its panoIds.")
    return ids, {split: indices.astype(np.int64) for split, indices in rows.items()}
