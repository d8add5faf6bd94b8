"""Files of AnyVisLoc and OrthoLoC: photos with exact poses as arrays in `.npz` files, over maps with heights.

AnyVisLoc  Scene_01/L01_0001.npz ... beside L01_reference.json, which names two maps and their heights
           (UAV-AVL/Benchmark at ec73927: README.md, avl_data.py, avl_utils.py)
OrthoLoC   L01_R0000.npz, L01_xDOP0000.npz, L01_xDOPDSM0000.npz, each with a map of its own
           (deepscenario/OrthoLoC at d931732: README.md, ortholoc/dataset/OrthoLoC.py)

Both have metres of a place that they do not tell. Here that place is a point of the Atlantic on the equator, where degrees
of latitude and longitude are metres times a constant to 1 cm within 10 km.
"""

from __future__ import annotations

import re
import zipfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import msgspec
import numpy as np

from lpn.core.arrays import DAMAGED_ARRAY, AnyArray, Float64Array
from lpn.core.errors import DataError
from lpn.core.files import first_few, printable

SampleLayout = Literal["AnyVisLoc", "OrthoLoC"]
ORIGIN = (0.0, -30.0)
# Metres of a degree of latitude and of longitude on the WGS 84 ellipsoid at the equator.
METRES = (110574.2758, 111319.4908)
PLACE_NOTE = f"{{}} does not tell its place on Earth, so its metres are laid about {ORIGIN[0]:g}, {ORIGIN[1]:g}, in the Atlantic."

_REFERENCE = re.compile(r"L\d\d_reference\.json")
_SAMPLES: dict[SampleLayout, re.Pattern[str]] = {
    "AnyVisLoc": re.compile(r"L\d\d_\d{4}\.npz"),
    "OrthoLoC": re.compile(r"L\d+_(R|xDOP|xDSM|xDOPDSM)\d+\.npz"),
}
# Arrays by which a sample of any name is recognised.
_KEYS: dict[SampleLayout, frozenset[str]] = {
    "AnyVisLoc": frozenset(("image", "K", "xyz", "euler_deg")),
    "OrthoLoC": frozenset(("image_query", "image_dop", "dsm", "extrinsics", "intrinsics")),
}
# A data set has its samples so many levels below its folder at most (full/test_inPlace), among so many folders at most.
_LEVELS, _MOST_FOLDERS = 2, 2000


@dataclass(frozen=True)
class SampleFolder:
    """A folder that holds samples.

    Attributes:
        layout: of the samples.
        folder: where they lie.
        samples: the files in the order of their names.
    """

    layout: SampleLayout
    folder: Path
    samples: tuple[Path, ...]


class ReferenceMap(msgspec.Struct, frozen=True):
    """A map of AnyVisLoc's `Lxx_reference.json` with its heights.

    Attributes:
        map_path, dsm_path: relative to the file.
        map_resolution, dsm_resolution: metres of a pixel, along columns and rows.
        map_origin_local: of the middle of the map's first pixel, in metres to the right and down.
        dsm_origin_local: of the middle of the first height, from there.
    """

    map_path: str
    dsm_path: str
    map_resolution: tuple[float, float]
    dsm_resolution: tuple[float, float]
    map_origin_local: tuple[float, float] = (0.0, 0.0)
    dsm_origin_local: tuple[float, float] = (0.0, 0.0)


class _ReferenceFile(msgspec.Struct, frozen=True):
    modes: dict[str, ReferenceMap]


def layout_of(path: Path) -> SampleLayout | None:
    """Return the layout of an `.npz` file by the names of its arrays; None for another file."""
    if path.suffix.lower() != ".npz" or not path.is_file():
        return None
    try:
        with zipfile.ZipFile(path) as archive:
            names = {name.removesuffix(".npy") for name in archive.namelist()}
    except (OSError, zipfile.BadZipFile):
        return next((layout for layout, pattern in _SAMPLES.items() if pattern.fullmatch(path.name)), None)
    return next((layout for layout, keys in _KEYS.items() if keys <= names), None)


def sample_folders(root: Path) -> list[SampleFolder]:
    """Return the folders of samples at a path and up to two levels below, recognised by the names of their files."""
    found: list[SampleFolder] = []
    level = [root] if root.is_dir() else []
    for _ in range(_LEVELS + 1):
        below: list[Path] = []
        for folder in level[:_MOST_FOLDERS]:
            try:
                entries = sorted(folder.iterdir())
            except OSError:
                continue
            names = [entry.name for entry in entries]
            below += [entry for entry in entries if not entry.name.startswith(".") and entry.is_dir()]
            referenced = any(_REFERENCE.fullmatch(name) for name in names)
            for layout, pattern in _SAMPLES.items():
                samples = tuple(entry for entry in entries if pattern.fullmatch(entry.name))
                # Names of four digits are common; the reference tells that these are AnyVisLoc's.
                if (
                    (samples or referenced)
                    if layout == "AnyVisLoc" and referenced
                    else samples and layout == "OrthoLoC"
                ):
                    found.append(SampleFolder(layout, folder, samples))
        level = below
    return found


def references(scene: Path) -> dict[str, ReferenceMap]:
    """Return the maps of a scene of AnyVisLoc by name, aerial and satellite; none where no `Lxx_reference.json` is there.

    Raises:
        DataError: if that file is damaged.
    """
    files = sorted(path for path in scene.iterdir() if _REFERENCE.fullmatch(path.name)) if scene.is_dir() else []
    if not files:
        return {}
    try:
        modes = msgspec.json.decode(files[0].read_bytes(), type=_ReferenceFile).modes
    except (OSError, msgspec.MsgspecError, UnicodeDecodeError) as error:
        raise DataError(
            f"{printable(str(files[0]))} is not what AnyVisLoc has there ({printable(str(error))[:200]}); expected modes with "
            "map_path, dsm_path, map_resolution, and dsm_resolution, so download it again."
        ) from error
    for name, one in modes.items():
        numbers = [*one.map_resolution, *one.dsm_resolution, *one.map_origin_local, *one.dsm_origin_local]
        if not np.isfinite(numbers).all() or min(numbers[:4]) <= 0:
            raise DataError(
                f"{printable(str(files[0]))} has resolutions or origins of {printable(name)} that are impossible; expected "
                "metres above 0, so download it again."
            )
    return modes


def reference_of_map(picture: Path) -> ReferenceMap | None:
    """Return what a scene of AnyVisLoc says about one of its maps; None for another picture."""
    known = references(picture.parent).values()
    return next((one for one in known if (picture.parent / one.map_path).resolve() == picture.resolve()), None)


def grid_matrix(resolution: Sequence[float], first: Sequence[float]) -> Float64Array:
    """Return the matrix, (2, 3), from columns and rows to longitude and latitude.

    Args:
        resolution: metres of a pixel along columns and rows.
        first: metres to the right and down of the middle of the first pixel.
    """
    left, top = (start - step / 2 for start, step in zip(first, resolution, strict=True))
    east, north = METRES[1], METRES[0]
    return np.array(
        [
            [resolution[0] / east, 0.0, ORIGIN[1] + left / east],
            [0.0, -resolution[1] / north, ORIGIN[0] - top / north],
        ]
    )


def degrees(east: float, north: float) -> tuple[float, float]:
    """Return the latitude and longitude that stand for metres of a scene."""
    return ORIGIN[0] + north / METRES[0], ORIGIN[1] + east / METRES[1]


def read_arrays(path: Path, names: Sequence[str], optional: Sequence[str] = ()) -> dict[str, AnyArray]:
    """Read arrays of an `.npz` file; nothing in it is unpickled.

    Args:
        optional: names that need not be there.

    Raises:
        DataError: if the file is damaged, or lacks an array, or holds it as Python objects.
    """
    file = printable(str(path))
    try:
        with path.open("rb") as opened, np.load(opened, allow_pickle=False) as data:
            present: list[str] = list(data.files)
            if missing := [name for name in names if name not in present]:
                raise DataError(
                    f"{file} has no array {first_few(missing, 3)}, and has {first_few([printable(n) for n in present], 6)}; "
                    "expected a sample of AnyVisLoc or OrthoLoC as it was released."
                )
            return {name: np.asarray(data[name]) for name in (*names, *(n for n in optional if n in present))}
    except (*DAMAGED_ARRAY, AttributeError) as error:
        raise DataError(f"{file} cannot be read ({printable(str(error))[:150]}); download the sample again.") from error


def read_heights(file: Path) -> AnyArray:
    """Open the heights of a map of AnyVisLoc, (H, W) numbers in metres, which are read when they are used.

    Raises:
        DataError: if the file is missing or damaged, or holds no such array.
    """
    name, again = printable(str(file)), "expected the heights of the map, (H, W) numbers, so download it again"
    try:
        heights = np.lib.format.open_memmap(file, mode="r")
    except DAMAGED_ARRAY as error:
        raise DataError(f"{name} cannot be read ({printable(str(error))[:150]}); {again}.") from error
    if heights.ndim not in (2, 3) or heights.size == 0 or heights.dtype.kind not in "fiu":
        raise DataError(f"{name} holds an array of the shape {heights.shape} and the type {heights.dtype}; {again}.")
    return heights[:, :, 0] if heights.ndim == 3 else heights


def matrix_of(arrays: dict[str, AnyArray], name: str, path: Path, *shapes: tuple[int, ...]) -> Float64Array:
    """Return an array as finite numbers of one of these shapes.

    Raises:
        DataError: if it is none.
    """
    array: Any = arrays[name]
    if array.shape not in shapes or array.dtype.kind not in "fiu" or not np.isfinite(array).all():
        expected = " or ".join(" x ".join(map(str, shape)) or "one number" for shape in shapes)
        raise DataError(
            f"The array {name} of {printable(str(path))} has the shape {array.shape} and the type {array.dtype}; expected "
            f"{expected} finite numbers."
        )
    return np.asarray(array, np.float64)
