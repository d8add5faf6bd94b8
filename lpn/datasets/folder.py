"""A folder of pictures without a layout: it can be described but not evaluated, as places are unknown."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from lpn.core.files import printable
from lpn.datasets.base import Dataset, PictureRow, files_below


class Folder(Dataset):
    """Pictures below a folder, each a place of its own.

    Args:
        whole: the folder of the data set that the root is a part of, such as one place of its pictures.
    """

    kind = "folder"
    title = "a plain folder of pictures"
    folders = ("",)
    expected = "a data set with queries and a gallery, since this is a folder of pictures"

    def __init__(self, root: Path, whole: Path | None = None) -> None:
        super().__init__(root)
        self.whole = whole

    def rows(self) -> Iterator[PictureRow]:
        for index, file in enumerate(files_below(self.root)):
            yield PictureRow("pictures", file, index, file.relative_to(self.root).with_suffix("").as_posix())

    def why_no_task(self) -> str:
        if self.whole is not None:
            inside = self.root.resolve().relative_to(self.whole.resolve()).as_posix()
            return (
                f"is the part {printable(inside)} of a data set, and has no queries and gallery of its own; give "
                f"{printable(str(self.whole))}"
            )
        return (
            "is a folder of pictures, and nothing says which of them show the same place; name the pairs in a pairs.csv (columns "
            "satellite,drone,split), or make folders of a number for each place: train/drone/<number>/* and "
            "train/satellite/<number>/* to train on, test/query_drone/<number>/* and test/gallery_satellite/<number>/* to test "
            "with"
        )
