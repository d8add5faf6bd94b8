"""Development of rendered light into a photograph: haze, exposure, colour, blur, sensor noise."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from lpn.core.arrays import AnyArray, Float32Array, Float64Array
from tools.world.architecture import Reflectance
from tools.world.cameras import Pose
from tools.world.paint import Season


@dataclass(frozen=True)
class Look:
    """The conditions of one day and the settings of one camera.

    Attributes:
        sun: elevation above the horizon and bearing clockwise from north, in degrees.
        exposure: factor of the light.
        balance: gain of red, green, blue.
        contrast: slope of the tone curve around middle grey; 1 is neutral.
        saturation: 1 is neutral, 0 is grey.
        haze: fraction of the light replaced by haze over 500 m.
        veil: displayed colour of the haze, 0 to 1.
        blur: deviation in pixels.
        noise: deviation of the displayed sensor noise.
        traffic: seed of the vehicles.
    """

    season: Season
    sun: tuple[float, float]
    exposure: float
    balance: Reflectance
    contrast: float
    saturation: float
    haze: float
    veil: Reflectance
    blur: float
    noise: float
    traffic: int


_SUMMER = ((0.052, 0.085, 0.022), (0.07, 0.105, 0.026), (0.04, 0.07, 0.02), (0.085, 0.115, 0.03), (0.06, 0.085, 0.03))
_LATE = ((0.06, 0.085, 0.02), (0.10, 0.10, 0.025), (0.05, 0.07, 0.022), (0.14, 0.10, 0.025), (0.08, 0.09, 0.03))
_SPRING = ((0.06, 0.105, 0.025), (0.05, 0.085, 0.025), (0.04, 0.07, 0.022), (0.08, 0.12, 0.03), (0.05, 0.08, 0.03))
_DRY = ((0.07, 0.085, 0.03), (0.08, 0.09, 0.032), (0.05, 0.06, 0.022), (0.10, 0.095, 0.04), (0.075, 0.08, 0.033))

DRONE = Look(
    Season((0.095, 0.15, 0.04), (0.23, 0.20, 0.09), 0.25, _SUMMER), (46.0, 228.0), 1.6, (1.01, 1.0, 1.03), 1.24, 1.0, 0.15,
    (0.62, 0.69, 0.80), 0.45, 0.010, 1,
)  # fmt: skip
SATELLITES = (
    Look(Season((0.085, 0.115, 0.04), (0.22, 0.18, 0.10), 0.45, _LATE), (38.0, 152.0), 1.6, (1.02, 1.0, 0.97), 1.3, 0.92,
         0.05, (0.5, 0.55, 0.6), 0.7, 0.014, 2),
    Look(Season((0.08, 0.125, 0.04), (0.2, 0.18, 0.09), 0.2, _SPRING), (52.0, 165.0), 1.6, (0.94, 1.0, 1.16), 1.2, 1.0, 0.07,
         (0.55, 0.62, 0.75), 0.6, 0.012, 3),
    Look(Season((0.10, 0.105, 0.05), (0.25, 0.2, 0.12), 0.7, _DRY), (39.0, 140.0), 1.6, (1.04, 1.0, 0.94), 1.22, 0.8, 0.05,
         (0.5, 0.5, 0.5), 0.7, 0.018, 4),
)  # fmt: skip

_AUTUMN = ((0.11, 0.095, 0.02), (0.17, 0.09, 0.02), (0.05, 0.07, 0.022), (0.20, 0.10, 0.02), (0.13, 0.11, 0.03))
# The day of a flight, in autumn, and that of its map, in spring.
FLIGHT = replace(
    DRONE, season=Season((0.11, 0.12, 0.045), (0.25, 0.20, 0.09), 0.55, _AUTUMN), sun=(34.0, 190.0), exposure=1.75,
    balance=(1.05, 1.0, 0.95), haze=0.05, traffic=8,
)  # fmt: skip
FLIGHT_MAP = replace(SATELLITES[1], sun=(55.0, 140.0), traffic=9)


def drone_look(seed: int, district: int) -> Look:
    """Vary the drone's day for a district."""
    return _varied(DRONE, np.random.default_rng([seed, 41, district]))


def satellite_look(seed: int, district: int) -> Look:
    """Draw the satellite's day for a district, a variation of one of a few."""
    rng = np.random.default_rng([seed, 42, district])
    return _varied(SATELLITES[int(rng.integers(len(SATELLITES)))], rng)


def flight_look(seed: int) -> Look:
    """Vary the autumn day of a rendered flight."""
    return _varied(FLIGHT, np.random.default_rng([seed, 44]))


def map_look(seed: int) -> Look:
    """Vary the spring day of a rendered flight's map."""
    return _varied(FLIGHT_MAP, np.random.default_rng([seed, 45]))


def any_camera(look: Look, rng: np.random.Generator) -> Look:
    """Draw the camera and the air of one picture of a day: exposure, colours, tone, haze, sharpness, and noise."""
    return replace(
        look,
        exposure=float(look.exposure * np.exp(rng.uniform(-0.35, 0.3))),
        balance=_colour(np.array(look.balance) * rng.normal(1, 0.06, 3)),
        contrast=float(look.contrast * rng.uniform(0.75, 1.2)),
        saturation=float(rng.uniform(0.45, 1.25)),
        haze=float(rng.uniform(0, 0.3)),
        veil=_colour(rng.uniform(0.45, 0.65) * np.array([1, 1, 1]) + rng.uniform(0, 0.15) * np.array([0, 0.5, 1])),
        blur=float(rng.uniform(0, 1.1)),
        noise=float(rng.uniform(0, 0.03)),
    )


def _colour(values: Float64Array) -> Reflectance:
    red, green, blue = values.tolist()
    return red, green, blue


def _varied(look: Look, rng: np.random.Generator) -> Look:
    elevation, bearing = look.sun
    balance = _colour(np.array(look.balance) * rng.normal(1, (0.015, 0.01, 0.045)))
    return replace(
        look,
        season=replace(look.season, dryness=float(look.season.dryness * rng.uniform(0.5, 1.6))),
        sun=(float(elevation + rng.uniform(-7, 9)), float(bearing + rng.uniform(-25, 25))),
        exposure=float(look.exposure * rng.uniform(0.86, 1.14)),
        balance=balance,
        contrast=float(look.contrast * rng.uniform(0.93, 1.06)),
        saturation=float(look.saturation * rng.uniform(0.85, 1.1)),
        haze=float(look.haze * rng.uniform(0.6, 1.5)),
    )


def develop(light: Float32Array, look: Look, rng: np.random.Generator, pose: Pose | None = None) -> NDArray[np.uint8]:
    """Develop linear light into a picture (h, w, 3) uint8; `pose` gives the depth of the haze, which is uniform without it."""
    value = light * np.float32(look.exposure) * np.array(look.balance, np.float32)
    # A film-like shoulder keeps white roofs from burning out.
    value = value * (1 + value / 4.5) / (1 + value)
    developed = srgb_of(value)
    grey = developed @ np.array([0.3, 0.59, 0.11], np.float32)
    developed = grey[..., None] + look.saturation * (developed - grey[..., None])
    developed = 0.42 + look.contrast * (developed - 0.42)
    depth = np.float32(look.haze) if pose is None else 1 - (1 - look.haze) ** (_distance(pose, light.shape[0]) / 500)
    developed = developed + np.expand_dims(depth, -1) * (np.array(look.veil, np.float32) - developed)
    if look.blur:
        developed = cv2.GaussianBlur(developed, (0, 0), look.blur)
    noise = rng.normal(0, look.noise, developed.shape) * 0.6 + rng.normal(0, look.noise, (*developed.shape[:2], 1))
    return np.asarray((np.clip(developed + noise, 0, 1) * 255 + 0.5).astype(np.uint8))


def srgb_of(value: AnyArray) -> AnyArray:
    """Convert linear light from 0 to 1 to sRGB."""
    return np.asarray(np.where(value < 0.0031308, 12.92 * value, 1.055 * np.maximum(value, 1e-6) ** (1 / 2.4) - 0.055))


def linear_of(value: AnyArray) -> AnyArray:
    """Convert sRGB from 0 to 1 to linear light."""
    return np.asarray(np.where(value < 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4))


def _distance(pose: Pose, pixels: int) -> Float32Array:
    """Estimate the distance (pixels, pixels) of level ground in metres."""
    at = (np.arange(pixels) + 0.5) / pixels * 2 - 1
    slope = np.tan(np.radians(pose.fov / 2))
    right, up, forward = pose.axes()
    rays = forward + slope * (at[None, :, None] * right - at[:, None, None] * up)
    down = np.maximum(-rays[..., 2], 0.08)
    return np.asarray((pose.z / down * np.linalg.norm(rays, axis=-1)).astype(np.float32))
