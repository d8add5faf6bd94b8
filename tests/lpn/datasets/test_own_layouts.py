"""The layouts of this package, each found in its file, and those that another package brings."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from pathlib import Path

import pytest

from lpn.core.errors import DataError
from lpn.datasets import Dataset, PictureRow, known_layouts, layouts, open_dataset
from lpn.doctor.dataset_check import check_dataset
from tests.lpn.models.test_own_models import install
from tools.fixtures import layouts as drawn
from tools.fixtures import small_worlds

PLOTS = """
from lpn.datasets import Dataset, PictureRow

class Plots(Dataset):
    kind = "Plots"
    marks = (("plots.txt",),)

    def rows(self):
        for number, name in enumerate((self.root / "plots.txt").read_text().split()):
            tile = PictureRow("test/gallery_satellite", f"tiles/{name}.png", number, name)
            photo = PictureRow("test/query_drone", f"photos/{name}.png", number, name, true=[tile.file])
            yield from self.together(tile, photo)

class NoKind(Dataset):
    marks = Plots.marks

class NoLayout:
    pass
"""


@pytest.fixture
def plots(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A package with a layout and three that cannot be used on the path, and a data set of that layout."""
    points = ("plots = own:Plots", "absent = own:Absent", "other = own:NoLayout", "bare = own:NoKind")
    install(tmp_path, monkeypatch, PLOTS, "lpn.datasets", *points)
    root = tmp_path / "data" / "mine"
    for name in ("a", "b"):
        small_worlds.write(root / "tiles" / f"{name}.png", drawn.small(1))
        small_worlds.write(root / "photos" / f"{name}.png", drawn.small(2))
    (root / "plots.txt").write_text("a\nb\nc\n")
    known_layouts.cache_clear()
    yield root
    known_layouts.cache_clear()


def test_another_package_brings_a_layout(plots: Path, caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.WARNING):
        dataset = open_dataset(plots)
    assert (dataset.kind, dataset.tasks()) == ("Plots", ["drone-to-satellite"])
    assert [picture.path for picture in dataset.queries("drone")] == [plots / "photos/a.png", plots / "photos/b.png"]
    assert [of.good.tolist() for of in dataset.truth("drone-to-satellite") or ()] == [[0], [1]]
    assert [line.getMessage() for line in caplog.records] == [
        "The layout absent is left out, as own:Absent cannot be loaded (module 'own' has no attribute 'Absent').",
        "The layout other is left out, as own:NoLayout cannot be loaded (it is no subclass of lpn.datasets.Dataset with a "
        "kind, such as kind = 'Plots').",
        "The layout bare is left out, as own:NoKind cannot be loaded (it is no subclass of lpn.datasets.Dataset with a "
        "kind, such as kind = 'Plots').",
        "Left out of mine: 2 listed files, tiles/c.png (is not there), photos/c.png (is not there).",
    ]
    report = check_dataset(dataset)
    assert (report.title, len(report.left_out)) == ("in Plots's layout", 2)
    (plots / "photos" / "low").mkdir()
    for path in (plots / "photos" / "low", plots.parent):
        with pytest.raises(DataError, match=f"give {plots}"):
            open_dataset(path)


def test_a_list_of_another_name_is_refused(tmp_path: Path) -> None:
    class Misspelt(Dataset):
        kind = "Misspelt"

        def rows(self) -> list[PictureRow]:
            return [PictureRow("test/galery_satellite", "a.png", 0, "a")]

    with pytest.raises(DataError, match=r"Misspelt lists 'test/galery_satellite'; .* one of .*test/gallery_satellite"):
        Misspelt(tmp_path)


def test_every_file_of_layouts_holds_one_that_can_be_told() -> None:
    files = {file.stem for file in Path(*layouts.__path__).glob("*.py")} - {"__init__"}
    known = known_layouts()
    assert {layout.__module__.rpartition(".")[2] for layout in known} == files
    assert len({layout.kind for layout in known}) == len(known)
