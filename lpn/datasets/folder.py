"""A folder of pictures without a layout: it can be described but not evaluated, as places are unknown."""

from __future__ import annotations

from pathlib import Path

from lpn.core.files import printable
from lpn.datasets.base import LeftOut, ListedDataset, Picture, unread_below


class Folder(ListedDataset):
    """Pictures below a folder, each a place of its own.

    Args:
        files: the pictures, below the root.
        whole: the folder of the data set that the root is a part of, such as one place of its pictures.
    """

    kind = "folder"

    def __init__(self, root: Path, files: list[Path], whole: Path | None = None) -> None:
        super().__init__(root, {}, {}, {}, "a data set with queries and a gallery, since this is a folder of pictures")
        self.whole = whole
        self.pictures = [
            Picture(file, index, printable(file.relative_to(root).with_suffix("").as_posix()))
            for index, file in enumerate(files)
        ]

    def unread(self) -> list[LeftOut]:
        return unread_below(self.root)

    def why_no_task(self) -> str:
        if self.whole is not None:
            inside = self.root.resolve().relative_to(self.whole.resolve()).as_posix()
            return (
                f"is the part {printable(inside)} of a data set, and has no queries and gallery of its own; give --data "
                f"{printable(str(self.whole))}"
            )
        return (
            "is a folder of pictures, and nothing says which of them show the same place; name the pairs in a pairs.csv (columns "
            "satellite,drone,split), or make folders of a number for each place: train/drone/<number>/* and "
            "train/satellite/<number>/* to train on, test/query_drone/<number>/* and test/gallery_satellite/<number>/* to test "
            "with"
        )

    def lists(self) -> dict[str, list[Picture]]:
        return {"pictures": list(self.pictures)}
