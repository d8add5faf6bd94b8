"""A lens's coefficients of distortion, and photos without it.

The model is Brown's (1971) in OpenCV's form: a ray (x, y, 1) of the camera is seen at f (x', y') + c with

    x' = x (1 + k1 r^2 + k2 r^4 + k3 r^6) + 2 p1 x y + p2 (r^2 + 2 x^2)
    y' = y (1 + k1 r^2 + k2 r^4 + k3 r^6) + p1 (r^2 + 2 y^2) + 2 p2 x y,    r^2 = x^2 + y^2
"""

from __future__ import annotations

import contextlib
import math
import re
from dataclasses import astuple, dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from lpn.core.arrays import Float64Array, UInt8Array
from lpn.core.errors import DataError
from lpn.core.files import first_few, printable
from lpn.core.homography import middle_pixel
from lpn.flight.files.values import read_limited

# Limits: focal lengths in widths of the picture (170 to 3 degrees of view), the optical centre's distance from the middle, and
# the coefficients of distortion.
_FOCALS, _OFF_CENTRE, _MOST = (0.04, 20.0), 0.25, 100.0
# Limits of a camera's file.
_MOST_BYTES, _MOST_BRACKETS = 1_000_000, 1000
# A number or list of numbers in a block list; OpenCV's parser wants its dash farther right than the key.
_DASHED = re.compile(r"^( *-)(?= [-.\d'\"\[])", re.MULTILINE)
# The end of that parser's message: the line's number, and the error there.
_DAMAGE = re.compile(r".*\((\d+)\): (.+)'", re.DOTALL)


@dataclass(frozen=True)
class Lens:
    """A lens, by OpenCV's model with five coefficients.

    Attributes:
        focal_x, focal_y: focal lengths in widths of the picture.
        centre_x, centre_y: the optical centre from the picture's middle, to the right and down, in widths of the picture.
        k1, k2, p1, p2, k3: coefficients of distortion.

    Raises:
        ValueError: if no lens has such numbers; the message names them.
    """

    focal_x: float
    focal_y: float
    centre_x: float
    centre_y: float
    k1: float = 0.0
    k2: float = 0.0
    p1: float = 0.0
    p2: float = 0.0
    k3: float = 0.0

    def __post_init__(self) -> None:
        focals, centre = (self.focal_x, self.focal_y), (self.centre_x, self.centre_y)
        if not all(_FOCALS[0] <= focal <= _FOCALS[1] for focal in focals) or not 0.9 < focals[0] / focals[1] < 1.1:
            raise ValueError(f"focal lengths of {focals[0]:.3g} and {focals[1]:.3g} widths of the picture")
        if not all(abs(value) <= _OFF_CENTRE for value in centre):
            raise ValueError(
                f"an optical centre that is {max(map(abs, centre)):.3g} widths of the picture off its middle"
            )
        if not all(abs(value) <= _MOST for value in self.coefficients):
            raise ValueError("impossible coefficients")
        # Pixels farther from the middle show rays farther from the axis. The coefficients of another lens break this order.
        reach = 0.5 * math.hypot(1.0, 1.0) / min(focals)
        radii = np.linspace(0, reach, 200)
        seen = radii * (1 + self.k1 * radii**2 + self.k2 * radii**4 + self.k3 * radii**6)
        folded = np.flatnonzero(np.diff(seen) <= 0)
        if len(folded) and seen[folded[0]] < 0.5 / max(focals):
            raise ValueError("a distortion that folds the picture")

    @property
    def coefficients(self) -> Float64Array:
        """Coefficients of distortion in OpenCV's order, (5,)."""
        return np.array([self.k1, self.k2, self.p1, self.p2, self.k3])

    @property
    def fov(self) -> float:
        """The horizontal field of view of an undistorted picture in degrees."""
        return 2 * math.degrees(math.atan(0.5 / self.focal_x))

    def undistorted(self, photo: UInt8Array) -> UInt8Array:
        """Return a photo (H, W, 3) as taken by a pinhole of the same focal length, with the optical centre in the middle."""
        height, width = photo.shape[:2]
        x, y = middle_pixel(width, height)
        pinhole = np.array([[self.focal_x * width, 0, x], [0, self.focal_x * width, y], [0, 0, 1]])
        camera = pinhole.copy()
        camera[1, 1] = self.focal_y * width
        camera[:2, 2] += self.centre_x * width, self.centre_y * width
        maps = cv2.initUndistortRectifyMap(camera, self.coefficients, np.eye(3), pinhole, (width, height), cv2.CV_32FC1)
        # Repeated border pixels have no edge that a matcher could use.
        return np.asarray(cv2.remap(photo, *maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE), np.uint8)

    def text(self) -> str:
        """Return the nine numbers separated by blanks, the format of flight.csv."""
        return " ".join(f"{value:.9g}" for value in astuple(self))


def lens_of_text(text: str, width: float = 1.0) -> Lens:
    """Parse nine numbers: `Lens.text`, or DJI's XMP property DewarpData, "date;fx,fy,cx,cy,k1,k2,p1,p2,k3".

    DewarpData has focal lengths and the optical centre, counted from the photo's middle, in pixels (Mavic 3M manual, page 90).

    Args:
        width: of the photo as it was taken, in the text's unit.

    Raises:
        ValueError: if the text is no lens; the message describes it.
    """
    numbers = [float(word) for word in text.rpartition(";")[2].replace(",", " ").split()]
    if len(numbers) != 9:
        raise ValueError(f"{len(numbers)} numbers where 9 are expected")
    return Lens(*(number / width for number in numbers[:4]), *numbers[4:])


def read_camera(file: Path) -> tuple[Lens, float]:
    """Read a camera's file: the lens, and the proportions (height over width) of its pictures.

    The file is YAML or JSON of OpenCV or ROS (`camera_matrix`, `distortion_coefficients`), or OpenDroneMap's cameras.json
    (`focal_x`), with the size of the pictures.

    Raises:
        DataError: if it cannot be read, has another model than a pinhole with Brown's distortion, or impossible numbers.
    """
    head = ""
    try:
        text = read_limited(file, _MOST_BYTES, "a camera's file").decode("utf-8-sig", "replace").strip()
        # OpenCV's parser overflows the stack with nested brackets.
        if text.count("[") + text.count("{") > _MOST_BRACKETS:
            raise ValueError("too many brackets")
        # OpenCV before 5 asks for its own first line.
        head = "" if text.startswith(("%", "{")) else "%YAML:1.0\n---\n"
        # Nodes are valid only as long as their storage, so it has a name.
        text = head + _DASHED.sub(r" \1", text.removeprefix("---"))
        storage = cv2.FileStorage(text, cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
        return _camera(_content(storage.root()))
    except (cv2.error, SystemError, LookupError, TypeError, AttributeError, ArithmeticError, ValueError) as error:
        found = f"{'lacks' if isinstance(error, KeyError) else 'has'} {printable(str(error))[:120]}"
        if isinstance(error, ZeroDivisionError):
            found = "has a width of 0"
        elif damage := _DAMAGE.match(str(error.__cause__ or error)):
            line = int(damage[1]) - len(head.splitlines())
            found = f"has no readable line {line} ({printable(damage[2])[:80]})"
        elif not isinstance(error, KeyError | ValueError):
            found = "has other contents"
        raise DataError(
            f"{printable(str(file))} {found}; expected YAML or JSON by OpenCV, ROS, or ODM: the size of its "
            "pictures with camera_matrix and distortion_coefficients, or focal_x and k1, of a pinhole with k1, k2, p1, p2, k3."
        ) from error


def _content(node: cv2.FileNode) -> Any:
    """Return a node as a dict, list, text, or number, which may be quoted."""
    if node.isMap():
        names = node.keys()
        return {name: _content(node.getNode(name)) for name in names}
    if node.isSeq():
        return [_content(node.at(i)) for i in range(node.size())]
    if not node.isString():
        return node.real()
    with contextlib.suppress(ValueError):
        return float(node.string())
    return node.string()


def _camera(content: dict[str, Any]) -> tuple[Lens, float]:
    if "camera_matrix" in content:
        width, height = content["image_width"], content["image_height"]
        model = content.get("distortion_model", "plumb_bob")
        matrix, coefficients = (_numbers(content.get(key, [])) for key in ("camera_matrix", "distortion_coefficients"))
        if len(matrix) != 9:
            raise ValueError(f"{len(matrix)} numbers in camera_matrix and not 9")
        fx, _, cx, _, fy, cy, *_ = matrix
        centre = (cx - (width - 1) / 2) / width, (cy - (height - 1) / 2) / width
        fx, fy = fx / width, fy / width
    else:
        cameras = {name: camera for name, camera in content.items() if isinstance(camera, dict)} or {"": content}
        if len(cameras) > 1:
            raise ValueError(
                f"{len(cameras)} cameras ({first_few(list(cameras), 3)}) where one is expected, that of these photos"
            )
        (camera,) = cameras.values()
        width, height = camera["width"], camera["height"]
        model = camera.get("projection_type", "brown")
        # OpenSfM's unit is the longer side, and its origin is the picture's middle.
        scale = max(width, height) / width
        fx, fy = (scale * camera["focal" if "focal" in camera else name] for name in ("focal_x", "focal_y"))
        centre = scale * camera.get("c_x", 0.0), scale * camera.get("c_y", 0.0)
        coefficients = [camera.get(name, 0.0) for name in ("k1", "k2", "p1", "p2", "k3")]
    if model not in ("plumb_bob", "brown", "perspective", "none"):
        raise ValueError(f"the model {model}")
    if any(coefficients[5:]):
        raise ValueError(f"{len(coefficients)} coefficients of distortion")
    return Lens(fx, fy, *centre, *coefficients[:5]), height / width


def _numbers(values: Any) -> list[float]:
    """Return the numbers of a list, a list of rows, or a matrix in "data", row by row."""
    numbers: list[float] = np.array(values["data"] if isinstance(values, dict) else values, np.float64).ravel().tolist()
    return numbers
