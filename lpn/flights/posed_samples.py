"""Flights of AnyVisLoc's scenes and OrthoLoC's samples: pictures out of `.npz` files, with their exact poses.

A picture is drawn as a pinhole camera without distortion and with its principal point in the middle would show it, which is the
camera of `lpn.locate`. `poses.csv` in the flight's folder keeps the exact poses, against which `lpn locate` prints errors.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from lpn.core import posed_samples
from lpn.core.arrays import AnyArray, Float64Array, UInt8Array
from lpn.core.csv_cells import csv_bytes
from lpn.core.errors import DataError, InputError
from lpn.core.files import first_few, printable, write_atomic
from lpn.core.images import SUFFIXES
from lpn.core.numbers import wrap_degrees
from lpn.core.posed_samples import SampleLayout
from lpn.datasets.base import files_below
from lpn.datasets.rendered import POSE_COLUMNS, POSES
from lpn.flights.base import Flight, Frame
from lpn.flights.cameras import angles_of_view, fov_of_sensor
from lpn.flights.videos import SUFFIXES as VIDEOS

# Pixels by which a picture's camera may differ from the plain one without being drawn anew.
_PLAIN = 0.05
# Degrees by which a matrix may differ from the angles beside it.
_SAME = 3.0
# The camera's axes as OpenCV has them, and as OpenGL has them.
_AXES = (np.diag([1.0, 1.0, 1.0]), np.diag([1.0, -1.0, -1.0]))


@dataclass(frozen=True)
class PosedPhoto:
    """A photo with its exact pose.

    Attributes:
        picture: RGB (H, W, 3), of a plain camera.
        focal: in pixels.
        east, north, up: of the camera in metres of its scene; up is NaN where the layout calls heights unreliable.
        heading, pitch: degrees, as in `Frame`.
        roll: degrees; None where the file does not tell it.
        height: in metres above the scene's mean height, which the released protocol of AnyVisLoc gives; else None.
        drawn: whether the picture was drawn anew.
    """

    picture: UInt8Array
    focal: float
    east: float
    north: float
    up: float
    heading: float
    pitch: float
    roll: float | None
    height: float | None
    drawn: bool


def read_photo(path: Path, layout: SampleLayout) -> PosedPhoto:
    """Read the photo of a sample.

    Raises:
        DataError: if the file is damaged, or is no such sample.
    """
    return _of_anyvisloc(path) if layout == "AnyVisLoc" else _of_ortholoc(path)


def flight_of_samples(files: Sequence[Path], name: str, pictures: Path, of_others: Sequence[str] = ()) -> Flight | None:
    """Write the pictures of samples, and return their flight.

    Args:
        files: a scene of AnyVisLoc, some of its samples, or one sample of OrthoLoC.
        pictures: folder to write the pictures to; `poses.csv` is written beside it.
        of_others: options that were given and apply to other files than samples.

    Returns:
        None if the files are none of these.

    Raises:
        DataError: if no sample can be read; a note names those that are left out.
        InputError: if the files are of several layouts or scenes, several samples of OrthoLoC, or samples and others, or for
            `of_others`.
    """
    found: list[tuple[SampleLayout, Path]] = []
    others: list[Path] = []
    beside: list[Path] = []
    for path in files:
        if path.is_dir():
            below = [one for one in posed_samples.sample_folders(path) if one.samples]
            others += [] if below else [path]
            found += [(one.layout, sample) for one in below for sample in one.samples]
            beside += _pictures_beside(path) if below else []
        elif (layout := posed_samples.layout_of(path)) is not None:
            found.append((layout, path))
        elif path.suffix.lower() == ".npz" and path.exists():
            raise DataError(
                f"{printable(str(path))} is no sample of AnyVisLoc or OrthoLoC; expected one with the arrays of their releases."
            )
        else:
            others.append(path)
    if not found:
        return None
    if others:
        raise InputError(
            f"{printable(str(others[0]))} holds no sample of {found[0][0]}, which other files are; make one flight of each."
        )
    if of_others:
        raise InputError(
            f"Samples of {found[0][0]} have neither videos nor subtitles, and their own cameras, so {' and '.join(of_others)} "
            "would not be used; leave it out."
        )
    # A sample that is named twice, or by its folder and itself, is one photo.
    found = list({path.resolve(): (layout, path) for layout, path in found}.values())
    _check_one_map(found)
    frames: list[Frame] = []
    rows: list[list[object]] = [list(POSE_COLUMNS)]
    drawn, unsure = 0, 0
    broken: list[DataError] = []
    for layout, path in found:
        try:
            photo = read_photo(path, layout)
        except DataError as error:
            broken.append(error)
            continue
        file = pictures / f"{path.stem}.png"
        write_atomic(file, cv2.imencode(".png", cv2.cvtColor(photo.picture, cv2.COLOR_RGB2BGR))[1].tobytes())
        latitude, longitude = posed_samples.degrees(photo.east, photo.north)
        told = layout == "AnyVisLoc"
        height, width = photo.picture.shape[:2]
        frames.append(
            Frame(
                path.stem,
                file,
                width,
                height,
                latitude=latitude,
                longitude=longitude,
                height_above_takeoff=photo.height,
                altitude=None if math.isnan(photo.up) else photo.up,
                heading=photo.heading if told else None,
                heading_source="gimbal" if told else None,
                pitch=photo.pitch if told else None,
                roll=photo.roll if told else None,
                fov=fov_of_sensor(width, photo.focal),
            )
        )
        values = (
            latitude,
            longitude,
            photo.up,
            photo.heading,
            photo.pitch,
            math.nan if photo.roll is None else photo.roll,
        )
        rows.append([file.name, *(repr(float(value)) for value in values)])
        drawn += photo.drawn
        unsure += photo.roll is None
    if not frames:
        raise broken[0]
    write_atomic(pictures.parent / POSES, csv_bytes(rows))
    notes = _notes(found[0][0], len(frames), drawn, unsure)
    if broken:
        notes.append(f"{len(broken)} of {len(found)} samples are left out, the first because: {broken[0]}")
    if beside:
        listed = first_few([printable(file.name) for file in beside], 3)
        notes.append(f"Pictures or videos beside the samples are left out: {listed}; make a flight of their own.")
    return Flight(name, tuple(frames), tuple(notes))


def _pictures_beside(folder: Path) -> list[Path]:
    """Return the pictures and videos below a folder of samples that are no maps of theirs."""
    files = files_below(folder, (*SUFFIXES, *VIDEOS))
    maps = {
        (scene / one.map_path).resolve()
        for scene in {file.parent for file in files}
        for one in posed_samples.references(scene).values()
    }
    return [file for file in files if file.resolve() not in maps]


def _notes(layout: SampleLayout, frames: int, drawn: int, unsure: int) -> list[str]:
    notes = [posed_samples.PLACE_NOTE.format(layout)]
    if layout == "AnyVisLoc":
        notes.append(
            "Positions, headings, pitches, and heights are the exact ones, as the released protocol gives them (pose_priori yp); "
            "heights are above the scene's mean height."
        )
    else:
        notes.append(
            "Positions are the exact ones and serve as the truth; heading, pitch, and height are left unknown, as the released "
            "protocol gives none. The field of view is the exact one."
        )
    if drawn:
        notes.append(
            f"{drawn} of {frames} pictures were drawn anew without distortion and with the principal point in the middle."
        )
    if unsure:
        notes.append(
            f"{unsure} of {frames} poses have a matrix that contradicts the angles beside it; the angles are taken, and the roll "
            "is unknown."
        )
    return notes


def _check_one_map(found: Sequence[tuple[SampleLayout, Path]]) -> None:
    """Raise InputError unless all samples lie over one map."""
    layouts = Counter(layout for layout, _ in found)
    if len(layouts) > 1:
        raise InputError("The files are of AnyVisLoc and of OrthoLoC; make one flight of each.")
    if layouts["OrthoLoC"] > 1:
        raise InputError(f"Each of these {len(found)} samples of OrthoLoC has a map of its own; give one of them.")
    scenes = sorted({path.parent for _, path in found})
    if len(scenes) > 1:
        listed = first_few([printable(scene.name) for scene in scenes], 3)
        raise InputError(
            f"The files are of {len(scenes)} scenes ({listed}), each with maps of its own; give one of them."
        )


def _of_ortholoc(path: Path) -> PosedPhoto:
    arrays = posed_samples.read_arrays(path, ("image_query", "extrinsics", "intrinsics"))
    pose = posed_samples.matrix_of(arrays, "extrinsics", path, (3, 4), (4, 4))[:3]
    camera = posed_samples.matrix_of(arrays, "intrinsics", path, (3, 3))
    turn = _rotation(pose[:, :3], "extrinsics", path)
    east, north, up = (-turn.T @ pose[:, 3]).tolist()
    heading, pitch, roll = angles_of_view(turn)
    picture, focal, drawn = _plain(_picture(arrays, "image_query", path), camera, np.zeros(5), path)
    return PosedPhoto(picture, focal, east, north, up, heading, pitch, roll, None, drawn)


def _of_anyvisloc(path: Path) -> PosedPhoto:
    arrays = posed_samples.read_arrays(path, ("image", "K", "dist", "pose_c2w", "xyz", "euler_deg"), ("image_relpath",))
    camera = posed_samples.matrix_of(arrays, "K", path, (3, 3))
    distortion = posed_samples.matrix_of(arrays, "dist", path, (5,), (1, 5), (5, 1)).ravel()
    x, y, z = posed_samples.matrix_of(arrays, "xyz", path, (3,)).tolist()
    euler = posed_samples.matrix_of(arrays, "euler_deg", path, (3,))
    pose = posed_samples.matrix_of(arrays, "pose_c2w", path, (4, 4), (3, 4))
    # The released code counts the pitch from straight down, and looks towards the yaw; y grows to the south.
    heading, pitch = float(euler[2]) % 360.0, float(euler[1]) - 90.0
    exact = _agreeing(pose[:3, :3], heading, pitch)
    roll = None
    if exact is not None:
        heading, pitch, roll = exact
    if not arrays["image"].size and "image_relpath" in arrays:
        raise DataError(
            f"{printable(str(path))} has its picture in another file, {printable(str(arrays['image_relpath']))}; expected it in "
            "the array image, as in the complete release."
        )
    picture, focal, drawn = _plain(_picture(arrays, "image", path), camera, distortion, path)
    return PosedPhoto(picture, focal, x, -y, math.nan, heading, pitch, roll, z if z > 0 else None, drawn)


def _agreeing(turn: Float64Array, heading: float, pitch: float) -> tuple[float, float, float] | None:
    """Return heading, pitch, and roll of a camera-to-world matrix, (3, 3), in the reading that agrees with known angles.

    The world's y may grow to the south or to the north, which the determinant tells, and axes be those of OpenCV or OpenGL.
    """
    if not np.allclose(turn @ turn.T, np.eye(3), atol=1e-3):
        return None
    world = np.diag([1.0, np.sign(np.linalg.det(turn)), 1.0])
    for axes in _AXES:
        read = angles_of_view((world @ turn @ axes).T)
        if abs(read[1] - pitch) < _SAME and abs(wrap_degrees(read[0] - heading)) < _SAME:
            return read
    return None


def _rotation(matrix: Float64Array, name: str, path: Path) -> Float64Array:
    if not np.allclose(matrix @ matrix.T, np.eye(3), atol=1e-3) or np.linalg.det(matrix) < 0:
        raise DataError(f"The array {name} of {printable(str(path))} holds no rotation; download the sample again.")
    return matrix


def _picture(arrays: dict[str, AnyArray], name: str, path: Path) -> UInt8Array:
    picture = arrays[name]
    if picture.dtype != np.uint8 or picture.ndim != 3 or picture.shape[2] != 3 or min(picture.shape) < 3:
        raise DataError(
            f"The array {name} of {printable(str(path))} has the shape {picture.shape} and the type {picture.dtype}; expected a "
            "picture (H, W, 3) of 8-bit numbers."
        )
    return np.ascontiguousarray(picture, np.uint8)


def _plain(
    picture: UInt8Array, camera: Float64Array, distortion: Float64Array, path: Path
) -> tuple[UInt8Array, float, bool]:
    """Return a picture as a plain camera shows it, its focal length in pixels, and whether it was drawn anew."""
    height, width = picture.shape[:2]
    focal = float(camera[0, 0])
    if not 0.1 * width < focal < 100 * width or abs(camera[1, 1] / focal - 1) > 0.2:
        raise DataError(
            f"{printable(str(path))} has focal lengths of {camera[0, 0]:g} and {camera[1, 1]:g} pixels for a picture of "
            f"{width} pixels; expected its own camera's."
        )
    plain = np.array([[focal, 0.0, (width - 1) / 2], [0.0, focal, (height - 1) / 2], [0.0, 0.0, 1.0]])
    corners = np.array([[[0.0, 0.0]], [[width - 1.0, 0.0]], [[0.0, height - 1.0]], [[width - 1.0, height - 1.0]]])
    moved = cv2.undistortPoints(corners, camera, distortion, P=plain)
    if np.abs(moved - corners).max() <= _PLAIN:
        return picture, focal, False
    return np.asarray(cv2.undistort(picture, camera, distortion, newCameraMatrix=plain), np.uint8), focal, True
