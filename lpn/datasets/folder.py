"""A folder of pictures without a layout: it can be described but not evaluated, as places are unknown."""

from __future__ import annotations

from collections.abc import Iterator

from lpn.datasets.base import Dataset, PictureRow, files_below


class Folder(Dataset):
    """Pictures below a folder, each a place of its own."""

    kind = "folder"
    title = "a plain folder of pictures"
    folders = ("",)
    expected = "a data set with queries and a gallery, since this is a folder of pictures"

    def rows(self) -> Iterator[PictureRow]:
        for index, file in enumerate(files_below(self.root)):
            yield PictureRow("pictures", file, index, file.relative_to(self.root).with_suffix("").as_posix())

    def why_no_task(self) -> str:
        return (
            "is a folder of pictures, and nothing says which of them show the same place; name the pairs in a pairs.csv (columns "
            "satellite,drone,split), or make folders of a number for each place: train/drone/<number>/* and "
            "train/satellite/<number>/* to train on, test/query_drone/<number>/* and test/gallery_satellite/<number>/* to test "
            "with"
        )
