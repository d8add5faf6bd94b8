"""The check of AnyVisLoc's scenes and OrthoLoC's samples by `lpn doctor`."""

from __future__ import annotations

import zipfile
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from lpn.core import posed_samples
from lpn.core.errors import DataError
from lpn.core.files import printable
from lpn.core.posed_samples import SampleFolder
from lpn.flights.posed_samples import read_photo


@dataclass(frozen=True)
class SampleReport:
    """The samples and scenes in folders.

    Attributes:
        layout: of the samples.
        folder: that holds them.
        samples: their number.
        problems: a sentence for each that cannot be read, and for each file that is missing.
    """

    layout: str
    folder: str
    samples: int
    problems: tuple[str, ...]

    @property
    def lines(self) -> list[str]:
        """Lines for the console."""
        ready = (
            f"{self.samples - len(self.problems):,} of {self.samples:,} can be used"
            if self.problems
            else "all can be used"
        )
        photos = "1 photo" if self.samples == 1 else f"{self.samples:,} photos"
        return [f"{self.layout}, {self.folder}: {photos} with exact poses, {ready}", *self.problems]

    def to_dict(self) -> dict[str, Any]:
        """Return the report for JSON."""
        return asdict(self)


def check_samples(
    folders: Sequence[SampleFolder], quick: bool, on_progress: Callable[[int, int], None] = lambda *_: None
) -> list[SampleReport]:
    """Read every sample of folders, or the names of its arrays alone if it shall be quick.

    Args:
        on_progress: called with the number of samples that were read, and of all.
    """
    total, done, reports = sum(len(one.samples) for one in folders), 0, []
    for one in folders:
        problems = _problems_of_scene(one.folder) if one.layout == "AnyVisLoc" else []
        for sample in one.samples:
            try:
                if not zipfile.is_zipfile(sample) or posed_samples.layout_of(sample) != one.layout:
                    raise DataError(
                        f"{printable(str(sample))} lacks arrays of {one.layout}, or is damaged; download it again."
                    )
                if not quick:
                    read_photo(sample, one.layout)
            except DataError as error:
                problems.append(str(error))
            done += 1
            on_progress(done, total)
        reports.append(SampleReport(one.layout, str(one.folder), len(one.samples), tuple(problems)))
    return reports


def _problems_of_scene(scene: Path) -> list[str]:
    """Return a sentence for each map of a scene whose files are missing or damaged."""
    try:
        modes = posed_samples.references(scene)
    except DataError as error:
        return [str(error)]
    problems = []
    for name, one in modes.items():
        if not (scene / one.map_path).is_file():
            problems.append(f"The {printable(name)} map {printable(str(scene / one.map_path))} is missing.")
        try:
            posed_samples.read_heights(scene / one.dsm_path)
        except DataError as error:
            problems.append(str(error))
    return problems
