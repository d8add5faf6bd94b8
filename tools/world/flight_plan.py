"""The plan of a rendered flight: the pose of each picture, and the tags of its file.

The first 60 % of the pictures fly a lawnmower over a district of the test split, half of its legs at each of two heights. The
others fly a free path around the same middle, one a second, from the upper height down to the lower one. Wind blows: the aircraft
points into it by the crab angle, and its speed over ground changes with direction and gusts.

Tags have the errors of a consumer drone, see `TAG_ERRORS`. Truth and tags depend only on the seed and the number of pictures.
"""

from __future__ import annotations

import csv
import io
import math
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Literal

import numpy as np

from lpn.core.arrays import Float64Array
from lpn.flight.files import cameras
from tools.world.cameras import Site
from tools.world.city import City

# Metres above the point of take-off.
HEIGHTS = (80.0, 120.0)
# The camera: 24 mm on 35 mm film, pictures of 4:3.
EQUIVALENT = 24.0
FOV = cameras.fov_of_equivalent(EQUIVALENT)
# Seconds since 1970 of the first picture: an October day, shortly after noon at the site.
START = datetime(2026, 10, 14, 14, 20, tzinfo=UTC).timestamp()
# Metres of the map around the flight's middle: all pictures of all seeds lie inside.
MAP_SIDE = 720.0
_LAWN = (360.0, 300.0)  # length of a leg, and from the first leg to the last, in metres
_AIRSPEED, _WIND = 10.0, (2.0, 4.0)  # metres a second
_GUSTS = (0.5, 8.0)  # deviation in metres a second, and time constant in seconds
_TURN_SECONDS, _TRANSIT_SECONDS = 9.0, 25.0
_FREE_REACH = 200.0  # metres
_STEEPEST, _FLATTEST = -90.0, -79.0  # degrees, of the gimbal on the free path
_LAWN_SHARE = 0.6  # of the pictures, which the lawnmower takes


@dataclass(frozen=True)
class TagErrors:
    """Errors of the tags, as one standard deviation unless noted.

    Attributes:
        offset: metres, each of east and north, constant.
        drift, drift_seconds: metres, each of east and north: a first-order Gauss-Markov process with this time constant.
        noise: metres, each of east and north, independent in each picture.
        lag: seconds by which positions are late; not random.
        height_drift, height_seconds: metres above take-off (a barometer): a Gauss-Markov process.
        altitude: metres above the sea, constant.
        compass, yaw: degrees of heading: constant, and independent in each picture.
        tilt: degrees of pitch and of roll, independent in each picture; files tell a roll of 0.
    """

    offset: float = 0.8
    drift: float = 1.2
    drift_seconds: float = 90.0
    noise: float = 0.25
    lag: float = 0.2
    height_drift: float = 0.4
    height_seconds: float = 120.0
    altitude: float = 3.0
    compass: float = 1.0
    yaw: float = 0.3
    tilt: float = 0.4


TAG_ERRORS = TagErrors()


@dataclass(frozen=True)
class AerialPose:
    """A camera of a flight: metres east, north, and up in the plan, and angles in degrees as in `lpn.flight.files.Frame`."""

    x: float
    y: float
    z: float
    heading: float
    pitch: float
    roll: float
    fov: float = FOV

    def axes(self) -> Float64Array:
        """Unit vectors (3, 3): right, up, and forward of the picture, as rows; x east, y north, z up."""
        turned = cameras.rotation(self.heading, self.pitch, self.roll)
        return np.stack([turned[:, 1], turned[:, 0], turned[:, 2]])[:, [1, 0, 2]] * (1.0, 1.0, -1.0)


@dataclass(frozen=True)
class Tag:
    """The values of a picture's tags before rounding.

    Attributes:
        takeoff_height: metres above the point of take-off.
        altitude: metres above the sea.
        gimbal: yaw, pitch, and roll in degrees.
        aircraft: yaw, pitch, and roll in degrees.
        speed: metres a second east, north, and up.
    """

    latitude: float
    longitude: float
    takeoff_height: float
    altitude: float
    gimbal: tuple[float, float, float]
    aircraft: tuple[float, float, float]
    speed: tuple[float, float, float]


@dataclass(frozen=True)
class FlightPicture:
    """A picture of the flight.

    Attributes:
        name: of the photo's file.
        path: the part of the flight.
        time: seconds since 1970 in UTC.
        pose: the truth.
        tag: what the files tell.
    """

    name: str
    path: Literal["lawnmower", "free"]
    time: float
    pose: AerialPose
    tag: Tag


@dataclass(frozen=True)
class FlightPlan:
    """All pictures of a flight.

    Attributes:
        x, y: middle of the flight and of its map, where the drone took off, in metres of the plan.
        ground: height of the ground there.
    """

    x: float
    y: float
    ground: float
    pictures: tuple[FlightPicture, ...]

    def truth_csv(self, city: City, site: Site) -> bytes:
        """Encode truth.csv: where each camera was, and where the ground in the middle of its picture lies.

        `lpn flight photos truth.csv` takes file, latitude, and longitude from it, and no other column.
        """
        text = io.StringIO()
        table = csv.writer(text, lineterminator="\n")
        table.writerow(
            ["file", "part", "second", "latitude", "longitude", "x", "y", "z", "true_ground_height",
             "true_takeoff_height", "true_heading", "true_pitch", "true_roll", "true_fov", "middle_latitude", "middle_longitude"]
        )  # fmt: skip
        for picture in self.pictures:
            pose = picture.pose
            place, middle = site.degrees(pose.x, pose.y), site.degrees(*picture_middle(city, pose))
            table.writerow(
                [picture.name, picture.path, f"{picture.time - START:.3f}", *(f"{v:.9f}" for v in place),
                 *(f"{v:.4f}" for v in (pose.x, pose.y, pose.z, pose.z - city.height(pose.x, pose.y), pose.z - self.ground,
                                        pose.heading, pose.pitch, pose.roll, pose.fov)), *(f"{v:.9f}" for v in middle)]
            )  # fmt: skip
        return text.getvalue().encode()


def picture_middle(city: City, pose: AerialPose) -> tuple[float, float]:
    """Return the point (x, y) of the terrain in the middle of a picture; buildings are left out."""
    forward = pose.axes()[2]
    x, y = pose.x, pose.y
    for _ in range(20):  # the ground's slope is small
        along = (pose.z - city.height(x, y)) / -forward[2]
        x, y = pose.x + along * forward[0], pose.y + along * forward[1]
    return float(x), float(y)


def plan_flight(city: City, site: Site, frames: int) -> FlightPlan:
    """Plan a flight of `frames` pictures over the district of the test split that has most targets."""
    x, y = _middle(city)
    ground = city.height(x, y)
    rng = np.random.default_rng([city.seed, 71, frames])
    blowing, strength = rng.uniform(0, 2 * np.pi), rng.uniform(*_WIND)
    steady = strength * np.array([np.sin(blowing), np.cos(blowing)])
    mown = max(1, round(_LAWN_SHARE * frames))
    lawn, free = np.arange(frames) < mown, np.arange(frames) - mown
    one, other = _lawnmower(rng, mown, steady), _free_path(rng, frames - mown, steady)
    times = np.concatenate([one.times, one.times[-1] + _TRANSIT_SECONDS + other.times])
    places, heights, courses, speeds = (
        np.concatenate([getattr(one, name), getattr(other, name)])
        for name in ("places", "heights", "courses", "speeds")
    )
    wind = steady + np.stack([gauss_markov(rng, times, *_GUSTS) for _ in range(2)], axis=1)
    crab = np.degrees(np.arcsin(np.clip(_across(wind, courses) / _AIRSPEED, -0.8, 0.8)))
    nose = (courses + crab) % 360
    pan = np.where(lawn, 0.0, 18 * np.sin(free / 9 + rng.uniform(0, 6)))
    pitch = np.where(
        lawn, -90.0, _STEEPEST + (_FLATTEST - _STEEPEST) * 0.5 * (1 - np.cos(free / 7 + rng.uniform(-0.5, 0.5)))
    )
    yaw = (nose + pan + rng.normal(0, 0.5, frames)) % 360
    e = TAG_ERRORS
    # The gimbal tells `pitch` and `yaw`; the camera's own angles differ by its errors.
    pitch = np.minimum(pitch + rng.normal(0, 0.15, frames), -0.1)
    heading = yaw + rng.normal(0, e.compass) + rng.normal(0, e.yaw, frames)
    tilt = rng.normal(0, e.tilt, (2, frames))
    drift = np.stack([gauss_markov(rng, times, e.drift, e.drift_seconds) for _ in range(2)], axis=1)
    velocity = speeds[:, None] * np.stack([np.sin(np.radians(courses)), np.cos(np.radians(courses))], axis=1)
    logged = places + rng.normal(0, e.offset, 2) + drift + rng.normal(0, e.noise, (frames, 2)) - e.lag * velocity
    risen = heights + gauss_markov(rng, times, e.height_drift, e.height_seconds)
    altitude = ground + rng.normal(0, e.altitude)
    lean = rng.normal(0, (1.2, 1.6), (frames, 2)) + np.stack([-0.7 * speeds, 0.9 * _across(wind, courses)], axis=1)
    climb = np.gradient(heights, times) * ~lawn if frames > 1 else np.zeros(frames)
    pictures = []
    for i in range(frames):
        pose = AerialPose(
            float(x + places[i, 0]), float(y + places[i, 1]), float(ground + heights[i]), float(heading[i] % 360),
            float(pitch[i] + tilt[0, i]), float(tilt[1, i]),
        )  # fmt: skip
        latitude, longitude = site.degrees(x + logged[i, 0], y + logged[i, 1])
        tag = Tag(
            float(latitude), float(longitude), float(risen[i]), float(altitude + risen[i]), (float(yaw[i]), float(pitch[i]), 0.0),
            (float(nose[i]), float(lean[i, 0]), float(lean[i, 1])),
            (float(velocity[i, 0]), float(velocity[i, 1]), float(climb[i])),
        )  # fmt: skip
        pictures.append(
            FlightPicture(
                f"LPN_{i + 1:04d}.JPG", "lawnmower" if lawn[i] else "free", START + float(times[i]), pose, tag
            )
        )
    return FlightPlan(x, y, ground, tuple(pictures))


def _middle(city: City) -> tuple[float, float]:
    """Return the middle of the square around the targets of the test district that has most."""
    places: dict[int, list[tuple[float, float]]] = {}
    for target in city.targets:
        building = city.buildings[target.building]
        if target.split == "test":
            places.setdefault(building.district, []).append((building.x, building.y))
    most = np.array(max(places.values(), key=len))
    x, y = ((most.min(axis=0) + most.max(axis=0)) / 2).tolist()
    return x, y


@dataclass(frozen=True)
class _Track:
    """Positions of pictures, (n,) each.

    Attributes:
        times: seconds from the first picture.
        places: (n, 2) metres east and north of the middle.
        heights: metres above take-off.
        courses: degrees clockwise from north.
        speeds: metres a second over ground.
    """

    times: Float64Array
    places: Float64Array
    heights: Float64Array
    courses: Float64Array
    speeds: Float64Array


def _lawnmower(rng: np.random.Generator, count: int, wind: Float64Array) -> _Track:
    """Return parallel legs there and back, half of them at each height; the first picture of a leg follows a turn."""
    legs = 6 if count >= 30 else 2
    leg = np.sort(np.arange(count) % legs)
    first = np.concatenate([[False], np.diff(leg) > 0])
    along = np.concatenate([np.linspace(-0.5, 0.5, n) if n > 1 else np.zeros(n) for n in np.bincount(leg)]) * _LAWN[0]
    way, aside = 1 - 2 * (leg % 2), (leg / (legs - 1) - 0.5) * _LAWN[1]
    turn = rng.uniform(0, np.pi)
    ahead, left = np.array([np.cos(turn), np.sin(turn)]), np.array([-np.sin(turn), np.cos(turn)])
    places = (way * along)[:, None] * ahead + aside[:, None] * left + rng.normal(0, 0.5, (count, 2))
    courses = np.degrees(np.arctan2(way * ahead[0], way * ahead[1])) % 360
    speeds = np.array([_ground_speed(wind, course) for course in courses]) + rng.normal(0, 0.3, count)
    steps = np.linalg.norm(np.diff(places, axis=0), axis=1) / speeds[1:] + _TURN_SECONDS * first[1:]
    times = np.concatenate([[0.0], np.cumsum(steps)])
    heights = np.where(leg < legs // 2, *HEIGHTS) + gauss_markov(rng, times, 0.3, 20.0)
    return _Track(times, places, heights, courses, speeds)


def _free_path(rng: np.random.Generator, count: int, wind: Float64Array) -> _Track:
    """Return places one second apart on a smooth curve, from the upper height down to the lower one."""
    around = np.linspace(0, 4 * np.pi, 8000) + rng.uniform(0, 2 * np.pi)
    phases = rng.uniform(0, 2 * np.pi, 2)
    reach = _FREE_REACH * (0.62 + 0.24 * np.sin(2 * around + phases[0]) + 0.14 * np.sin(1.5 * around + phases[1]))
    curve = np.stack([reach * np.cos(around), reach * np.sin(around)], axis=1)
    steps = np.diff(curve, axis=0)
    lengths = np.concatenate([[0.0], np.cumsum(np.linalg.norm(steps, axis=1))])
    bearings = np.degrees(np.arctan2(steps[:, 0], steps[:, 1])) % 360
    places, courses, speeds = np.zeros((count, 2)), np.zeros(count), np.zeros(count)
    flown = 0.0
    for i in range(count):
        at = flown % lengths[-1]
        courses[i] = bearings[min(int(np.searchsorted(lengths, at, side="right")) - 1, len(bearings) - 1)]
        speeds[i] = _ground_speed(wind, courses[i]) * (0.85 + 0.15 * math.sin(i / 6))
        places[i] = [np.interp(at, lengths, curve[:, axis]) for axis in range(2)]
        flown += speeds[i]
    times = np.arange(count, dtype=np.float64)
    share = times / max(count - 1, 1)
    lower, upper = HEIGHTS
    heights = upper + (lower - upper) * share**2 * (3 - 2 * share)
    return _Track(times, places, heights + gauss_markov(rng, times, 0.3, 20.0), courses, speeds)


def _ground_speed(wind: Float64Array, course: float) -> float:
    """Return the speed over ground along a course; metres a second."""
    ahead = np.array([math.sin(math.radians(course)), math.cos(math.radians(course))])
    along = float(wind @ ahead)
    across_squared = float(wind @ wind) - along**2
    return math.sqrt(_AIRSPEED**2 - across_squared) + along


def _across(wind: Float64Array, courses: Float64Array) -> Float64Array:
    """Return the wind (n,) from the right of courses in degrees; metres a second."""
    at = np.radians(courses)
    return np.asarray(-(wind[:, 0] * np.cos(at) - wind[:, 1] * np.sin(at)))


def gauss_markov(rng: np.random.Generator, times: Float64Array, deviation: float, seconds: float) -> Float64Array:
    """Return a first-order Gauss-Markov process (n,) at ascending times."""
    draws = rng.normal(0, 1, len(times))
    values = np.zeros(len(times))
    for i, draw in enumerate(draws):
        kept = math.exp(-(times[i] - times[i - 1]) / seconds) if i else 0.0
        values[i] = (kept * values[i - 1] if i else 0.0) + math.sqrt(1 - kept**2) * deviation * draw
    return values
