"""The six-degree pose of a registered photo's camera, from its matches and the map's heights: PnP with MAGSAC, refined.

A map point is (east, north, height) in metres. OpenCV's camera looks along +z, with x to the picture's right and y downward. A
map point p in the camera's axes is R (p - c), where c is the camera's place.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property

import cv2
import msgspec
import numpy as np

from lpn.core.arrays import BoolArray, Float64Array
from lpn.core.homography import apply_homography, inverse
from lpn.core.numbers import wrap_degrees
from lpn.flight.files import Frame
from lpn.flight.files.cameras import angles_of_view, rotation
from lpn.flight.locate.camera_place import frame_tilt_error
from lpn.flight.locate.levelled import PhotoView
from lpn.flight.locate.matchers import Complex
from lpn.flight.locate.registration import Registration, is_turned_over
from lpn.flight.maps import Map

# Minima of a pose's matches, and of the cells of a grid over the photo that hold some; and cells on a side of the grid.
_LEAST_MATCHES, _LEAST_CELLS, _GRID = 12, 6, 5
# The density of matches that agree must be this many times the density just beyond the threshold.
_OVER_CHANCE = 2.0
# Largest 1-sigma error of a pose as a share of its height above ground.
_WORST = 0.25
# The flat model ignores relief, which moves groups of matches alike. On the rendered flight, over houses and trees, the errors
# are _RELIEF times the prediction by the inliers' scatter. Heights are off by _RELIEF_METRES, as they also refer to roofs.
_RELIEF, _RELIEF_METRES = 8.0, 6.0
_ITERATIONS = 30
# Residuals below this many pixels are finer than the sampling of pictures.
_FINEST = 0.3
# The limit of a squared residual in variances (GRIC's lambda 3 times its codimension).
_CUT = 4.0
# Reach of the second round of matching around the first pose's predictions, as a share of the picture's width.
_REACH = 0.02
# Ground within this many widths of the picture's middle, by the plane's model, may be in the picture.
_SEEN = 1.0
# Sigmas by which a pose's tilt may differ from the tilt in the photo's file.
_SIGMAS = 3.0
# 1-sigma error of a match in pixels of the compared pictures.
_MATCH_ERROR = 1.0


class CameraPose(msgspec.Struct, frozen=True):
    """The place and orientation of a photo's camera.

    Attributes:
        east, north: metres in the map's frame.
        altitude: metres above the datum of the map's elevation; above the ground if that counts as flat.
        height: metres above the elevation below the camera, which may be a roof; None if unknown.
        heading, pitch, roll: degrees, as in `lpn.flight.files.Frame`.
        fov: horizontal field of view in degrees.
        flat: whether the ground counts as flat, because the map has no elevation.
        inliers: number of matches that agree with it.
        covariance: of east, north, altitude in metres, and heading, pitch, roll in degrees, 36 numbers by rows.
    """

    east: float
    north: float
    altitude: float
    height: float | None
    heading: float
    pitch: float
    roll: float
    fov: float
    flat: bool
    inliers: int
    covariance: list[float]

    @property
    def sigmas(self) -> Float64Array:
        """The 1-sigma errors of east, north, altitude in metres, and heading, pitch, roll in degrees, (6,)."""
        return np.sqrt(np.diag(np.array(self.covariance).reshape(6, 6)))

    @property
    def radius(self) -> float:
        """The 1-sigma radius in metres: the root mean square of the 1-sigma errors east and north."""
        return float(np.sqrt((self.sigmas[:2] ** 2).mean()))

    @property
    def tilt(self) -> tuple[float, float]:
        """The degrees between optical axis and straight down, and their 1-sigma error by the covariance of pitch and roll."""
        north, east, down = rotation(self.heading, self.pitch, self.roll)[:, 2].tolist()
        away = math.hypot(north, east)
        degrees = math.degrees(math.atan2(away, down))
        # The tilt's cosine is cos(pitch + 90) cos(roll), so its derivatives are exact; at 0 degrees pitch and roll count alike.
        pitch, roll = math.radians(self.pitch + 90), math.radians(self.roll)
        slopes = np.array([math.sin(pitch) * math.cos(roll), math.cos(pitch) * math.sin(roll)])
        slopes = slopes / away if away > 1e-9 else np.full(2, math.sqrt(0.5))
        covariance = np.array(self.covariance).reshape(6, 6)[4:, 4:]
        return degrees, math.sqrt(float(slopes @ covariance @ slopes))

    @property
    def sentence(self) -> str:
        """A line about the pose, with its errors."""
        sigmas = self.sigmas
        above = "above flat ground" if self.flat else "above the datum"
        ground = "" if self.flat or self.height is None else f", {self.height:.1f} m above ground"
        return (
            f"The camera was {self.altitude:.1f} m {above}{ground} (± {sigmas[2]:.1f}), heading {self.heading:.1f}° "
            f"(± {sigmas[3]:.1f}), pitch {self.pitch:.1f}° (± {sigmas[4]:.1f}), roll {self.roll:.1f}° (± {sigmas[5]:.1f})."
        )


@dataclass(frozen=True, eq=False)
class PoseMatches:
    """The matches by which a pose is solved, in coordinates about their middle.

    Attributes:
        pixels: of the photo, (M, 2).
        points: of the map with heights, (M, 3) metres.
        size: width and height of the photo in pixels.
        plane: the registration's homography from pixels to metres, (3, 3).
        plane_parameters: 8 for a homography, 4 for a similarity, or 6 for a similarity as the special case of a pose of known
            tilt.
        noise: expected 1-sigma error of a match in pixels.
        middle: the origin of the trial cameras' coordinates, (3,).
    """

    pixels: Float64Array
    points: Float64Array
    size: tuple[int, int]
    plane: Float64Array
    plane_parameters: int
    noise: float
    middle: Float64Array = field(default_factory=lambda: np.zeros(3))

    @cached_property
    def threshold(self) -> float:
        """Pixels within which a match agrees with a pose."""
        return max(3 * self.noise, 0.004 * self.size[0], 1.5)

    @cached_property
    def centred(self) -> Float64Array:
        """The points about the middle, (M, 3)."""
        return self.points - self.middle

    def solved(self, fov: float) -> _Camera | None:
        """Return the camera of a field of view in degrees by random samples of the matches, refined; None without one."""
        parameters = cv2.UsacParams()
        parameters.threshold = self.threshold
        parameters.confidence = 0.999
        parameters.maxIterations = 2000
        parameters.score = cv2.SCORE_METHOD_MAGSAC
        parameters.loMethod = cv2.LOCAL_OPTIM_SIGMA
        parameters.randomGeneratorState = 0
        start = _Camera(np.zeros(3), np.zeros(3), self.size[0] / 2 / math.tan(math.radians(fov) / 2))
        points, pixels = (np.ascontiguousarray(values) for values in (self.centred, self.pixels))
        intrinsics = start.intrinsics(self.size)
        try:
            found, _, turn, shift, _ = cv2.solvePnPRansac(points, pixels, intrinsics, np.zeros(4), params=parameters)
        except cv2.error:
            return None
        if not found or not (np.isfinite(turn).all() and np.isfinite(shift).all()):
            return None
        turn, shift = (np.asarray(values, np.float64).ravel() for values in (turn, shift))
        return self._refined(_Camera(turn, shift, start.focal))

    def agreeing(self, camera: _Camera, thresholds: float = 1.0) -> BoolArray:
        """Return a mask of the matches that agree with a camera, (M,)."""
        return np.asarray(self._residuals(camera) < thresholds * self.threshold)

    def cells(self, which: BoolArray | slice = np.s_[:]) -> int:
        """Count the cells of a grid over the photo that hold at least one of these matches."""
        cells = np.floor((self.pixels[which] + 0.5) / self.size * _GRID).astype(np.int64).clip(0, _GRID - 1)
        return len(np.unique(cells[:, 0] * _GRID + cells[:, 1]))

    def explained_by(self, camera: _Camera, clearly: bool) -> bool:
        """Tell by GRIC whether a pose explains the matches as well as the plane's model, or, if `clearly`, better."""
        flat = np.linalg.norm(apply_homography(inverse(self.plane), self.points[:, :2]) - self.pixels, axis=1)
        cells = self.cells()
        share, worth = min(cells / len(flat), 1.0), math.log(4 * cells)

        def gric(values: Float64Array, count: int) -> float:
            return share * float(np.minimum((values / (self.threshold / 3)) ** 2, _CUT).sum()) + count * worth

        margin = -worth if clearly else worth
        return gric(self._residuals(camera), 6) <= gric(flat, self.plane_parameters) + margin

    def covariance(self, camera: _Camera, inliers: BoolArray) -> Float64Array:
        """Return the covariance of place and angles, (6, 6), see `CameraPose`; NaN if the matches do not determine them."""
        off, jacobian = (values[np.repeat(inliers, 2)] for values in self._linearised(camera))
        variance = max(float(off @ off) / max(len(off) - 6, 1), (_FINEST / 2) ** 2)
        count = int(inliers.sum())
        try:
            inner = np.linalg.inv(jacobian.T @ jacobian / variance * (min(self.cells(inliers), count) / max(count, 1)))
        except np.linalg.LinAlgError:
            return np.full((6, 6), np.nan)

        def outer(values: Float64Array) -> Float64Array:
            moved = _Camera(values[:3], values[3:], camera.focal)
            return np.array([*moved.place, *angles_of_view(moved.matrix)])

        at = np.concatenate([camera.turn, camera.shift])
        start = outer(at)
        slopes = np.empty((6, 6))
        for i, step in enumerate([1e-5] * 3 + [1e-3] * 3):
            change = outer(at + step * np.eye(6)[i]) - start
            change[3] = wrap_degrees(change[3])
            slopes[:, i] = change / step
        return np.asarray(slopes @ inner @ slopes.T)

    def _refined(self, camera: _Camera) -> _Camera:
        """Fit a camera to its inliers by Levenberg's method."""
        damping = 1e-3

        def judged(candidate: _Camera) -> tuple[float, Float64Array, Float64Array]:
            off, jacobian = self._linearised(candidate)
            squares = (off.reshape(-1, 2) ** 2).sum(axis=1) / self.threshold**2
            # Geman and McClure's cost has no step at the threshold.
            weighted = jacobian * np.repeat(1 / (1 + squares) ** 2, 2)[:, None]
            return float((squares / (1 + squares)).sum()), weighted.T @ jacobian, weighted.T @ off

        cost, normal, slope = judged(camera)
        for _ in range(_ITERATIONS):
            step = np.linalg.lstsq(normal + damping * np.diag(np.diag(normal)), slope, rcond=None)[0]
            moved = _Camera(camera.turn + step[:3], camera.shift + step[3:], camera.focal)
            tried = judged(moved)
            if np.isfinite(tried[0]) and tried[0] < cost:
                done = cost - tried[0] < 1e-7 * cost
                camera, (cost, normal, slope), damping = moved, tried, damping / 5
                if done:
                    break
            else:
                damping *= 10
                if damping > 1e8:
                    break
        return camera

    def _linearised(self, camera: _Camera) -> tuple[Float64Array, Float64Array]:
        """Return pixels minus projections, (2 M,), and the Jacobian by turn and shift, (2 M, 6)."""
        intrinsics = camera.intrinsics(self.size)
        projected, jacobian = cv2.projectPoints(self.centred, camera.turn, camera.shift, intrinsics, np.zeros(4))
        return (self.pixels - projected.reshape(-1, 2)).ravel(), np.asarray(jacobian[:, :6], np.float64)

    def _residuals(self, camera: _Camera) -> Float64Array:
        """Return the pixels from each match to its projection, (M,); infinite behind the camera."""
        off = np.linalg.norm(camera.project(self.centred, self.size) - self.pixels, axis=1)
        return np.where(np.isnan(off), np.inf, off)


@dataclass(frozen=True, eq=False)
class _Camera:
    """A trial camera: OpenCV's rotation vector and translation, (3,) each, and the focal length in pixels."""

    turn: Float64Array
    shift: Float64Array
    focal: float

    @property
    def matrix(self) -> Float64Array:
        return np.asarray(cv2.Rodrigues(self.turn)[0], np.float64)

    @property
    def place(self) -> Float64Array:
        return -self.matrix.T @ self.shift

    def intrinsics(self, size: tuple[int, int]) -> Float64Array:
        return np.array([[self.focal, 0, (size[0] - 1) / 2], [0, self.focal, (size[1] - 1) / 2], [0, 0, 1]])

    def project(self, points: Float64Array, size: tuple[int, int]) -> Float64Array:
        """Return the pixels of points, (N, 2); NaN behind the camera."""
        seen = points @ self.matrix.T + self.shift
        with np.errstate(divide="ignore", invalid="ignore"):
            pixels = seen[:, :2] / seen[:, 2:] * self.focal + (np.array(size) - 1) / 2
        return np.where(seen[:, 2:] > 0, pixels, np.nan)


def photo_pose(basemap: Map, frame: Frame, view: PhotoView, registration: Registration) -> CameraPose | str:
    """Solve the pose of a photo's camera; on flat ground if the map has no elevation.

    Args:
        view: the registered picture.
        registration: of the photo, with its matches; `homography` and `width` are of the photo itself.

    Returns:
        The pose, or a sentence with the reason for none; "" without matches.
    """
    ground, plane, metres = registration.ground, registration.homography, registration.width
    if ground is None or plane is None or metres is None:
        return ""
    if frame.fov is None:
        return "Nothing tells the photo's field of view, so there is no pose of the camera."
    heights = None if basemap.elevation is None else basemap.heights
    noise = _MATCH_ERROR * max(1.0, ground.resolution * view.size[0] / metres)
    # If neither heights nor the photo tell the tilt, noise and relief may pass for a tilt.
    proven = heights is None and (frame.pitch is None or frame.roll is None)
    parameters = 8 if registration.model == "homography" else 4 if proven else 6

    def raised(places: Float64Array) -> Float64Array:
        return np.column_stack([places, np.zeros(len(places)) if heights is None else heights(places)])

    def collected(u: Complex, places: Float64Array) -> PoseMatches:
        points = raised(places)
        known = np.isfinite(points[:, 2])
        return PoseMatches(view.pixels(u)[known], points[known], view.size, plane, parameters, noise)

    def again(predict: Callable[[Float64Array], Float64Array]) -> PoseMatches:
        # The plane's model limits the ground that the photo may show.
        on_plane = np.abs(view.units(apply_homography(inverse(plane), ground.points)))
        near = np.flatnonzero(on_plane < _SEEN)
        predicted = np.full(len(ground.points), np.nan, np.complex128)
        predicted[near] = view.units(predict(raised(ground.points[near])))
        u, chosen = registration.rematch(predicted, _REACH)
        return collected(u, ground.points[chosen])

    best = registration.places[0]
    first = collected(best.u, np.stack([best.m.real, best.m.imag], axis=1))
    solved = solve_pose(first, frame.fov, heights, None if heights is None else again, proven)
    if isinstance(solved, str):
        return solved
    return _contradiction(frame, solved, is_turned_over(registration.turn)) or solved


def _contradiction(frame: Frame, solved: CameraPose, turned: bool) -> str:
    """Return a sentence if pitch or roll contradict the photo's file; "" if they agree within three sigmas."""
    if frame.pitch is None or frame.roll is None:
        return ""
    way = -1 if turned else 1  # the file was turned after the flight
    told = way * (frame.pitch + 90) - 90, way * frame.roll
    limits = [_SIGMAS * math.hypot(frame_tilt_error(frame), float(sigma)) for sigma in solved.sigmas[4:]]
    if abs(solved.pitch - told[0]) <= limits[0] and abs(solved.roll - told[1]) <= limits[1]:
        return ""
    return (
        f"By the matches the camera has a pitch of {solved.pitch:.1f}° and a roll of {solved.roll:.1f}°, but the photo's file "
        f"says {told[0]:.1f}° and {told[1]:.1f}°, so there is no pose."
    )


def solve_pose(
    matches: PoseMatches,
    fov: float,
    heights: Callable[[Float64Array], Float64Array] | None,
    rematch: Callable[[Callable[[Float64Array], Float64Array]], PoseMatches] | None = None,
    proven: bool = False,
) -> CameraPose | str:
    """Solve the pose of a camera from matches of its photo with the map.

    Perspective-n-point by USAC with MAGSAC's score (Barath et al., CVPR 2020) is followed by Levenberg's least squares on the
    inliers. The covariance is (J^T J)^-1 times the inliers' variance. Neighbours err alike, so each cell of a grid over the photo
    counts as one match.

    The pose is compared with the plane's model by GRIC (Torr, "Geometric motion segmentation and model selection", 1998). GRIC
    is the sum of squared residuals over their variance, each at most 4, plus log(4 n) for each parameter, with n such cells. The
    pose is rejected if the plane is better by more than log(4 n).

    Args:
        matches: of the registration.
        fov: horizontal field of view in degrees.
        heights: returns the ground's heights in metres at places (K, 2), NaN where unknown; None if the ground counts as flat.
        rematch: matches again near predicted pixels; its argument maps points (N, 3) to pixels (N, 2).
        proven: True if the pose must be better than the plane by log(4 n).

    Returns:
        The pose, or a sentence with the reason for none.
    """
    if len(matches.points) < _LEAST_MATCHES:
        return "Too few matches have a height for a pose of the camera."
    flat = heights is None
    middle = np.array([*matches.points[:, :2].mean(axis=0), np.median(matches.points[:, 2])])
    matches = replace(matches, middle=middle)
    camera = matches.solved(fov)
    if camera is None:
        return "The matches agree on no pose of the camera."
    inliers = matches.agreeing(camera)
    # Matches of a second round favour the pose that predicted them, so matches of the first round are compared.
    if not matches.explained_by(camera, proven):
        return (
            "On flat ground the matches do not show how far the camera was tilted, so there is no pose."
            if proven
            else "The matches lie on the map as on a plane, and no camera with this field of view explains them as well."
        )
    if rematch is not None:
        predicted = camera
        size = matches.size
        again = replace(rematch(lambda points: predicted.project(points - middle, size)), middle=middle)
        if len(again.points) >= len(matches.points) // 2:
            better = again.solved(fov)
            if better is not None and (agreeing := again.agreeing(better)).sum() >= inliers.sum():
                matches, camera, inliers = again, better, agreeing
    count, cells = int(inliers.sum()), matches.cells(inliers)
    # The ring from one to two thresholds has three times the area inside one threshold.
    ring = int(matches.agreeing(camera, 2.0).sum()) - count
    if count < _OVER_CHANCE * ring / 3:
        return f"The {count} matches that agree on a pose of the camera are hardly more than would agree by chance."
    if count < _LEAST_MATCHES or cells < _LEAST_CELLS:
        return f"Only {count} matches, in {cells} parts of the photo, agree on a pose of the camera."
    place = camera.place + middle
    below = 0.0 if heights is None else float(heights(place[None, :2])[0])
    height = float(place[2] - below) if np.isfinite(below) else None
    above = place[2] - middle[2]
    if above <= 0 or (height is not None and height <= 0):
        return "The pose that the matches agree on lies below the ground."
    covariance = matches.covariance(camera, inliers)
    if flat:
        covariance *= _RELIEF**2
        covariance[2, 2] += _RELIEF_METRES**2
    if not np.isfinite(covariance).all() or np.sqrt(np.diag(covariance)[:3]).max() > _WORST * above:
        return "The matches do not tell the pose: its error would be more than a quarter of the height."
    east, north, altitude = place.tolist()
    angles, values = angles_of_view(camera.matrix), covariance.ravel().tolist()
    return CameraPose(east, north, altitude, height, *angles, fov, flat, count, values)
