"""The colours of the ground: vegetation, pavement, markings, and wear, as linear reflectance."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lpn.core.arrays import Float32Array, Float64Array
from tools.world.architecture import Reflectance
from tools.world.canvas import Canvas
from tools.world.city import City, Patch, Street
from tools.world.geometry import rectangle, turned, within
from tools.world.plot import parking_rows
from tools.world.streets import beside


@dataclass(frozen=True)
class Season:
    """The appearance of plants and ground on one day.

    Attributes:
        grass, dry: reflectance of watered and of dry grass.
        dryness: fraction of dry grass, 0 to 1.
        leaves: reflectances of leaves.
    """

    grass: Reflectance
    dry: Reflectance
    dryness: float
    leaves: tuple[Reflectance, ...]


ASPHALT: Reflectance = (0.125, 0.125, 0.13)
PAVING: Reflectance = (0.33, 0.315, 0.285)
LINE: Reflectance = (0.62, 0.62, 0.60)
_GROUND: dict[str, tuple[Reflectance, float, float]] = {  # colour, grain, blotch
    "paved": ((0.29, 0.275, 0.25), 0.06, 0.14),
    "asphalt": ((0.15, 0.148, 0.145), 0.06, 0.2),
    "gravel": ((0.34, 0.29, 0.22), 0.12, 0.12),
    "concrete": ((0.36, 0.35, 0.32), 0.07, 0.14),
    "dirt": ((0.25, 0.185, 0.12), 0.16, 0.22),
    "plaza": ((0.38, 0.34, 0.29), 0.08, 0.1),
    "playground": ((0.17, 0.17, 0.17), 0.06, 0.1),
    "parking": ((0.14, 0.14, 0.14), 0.08, 0.18),
    "water": ((0.045, 0.065, 0.05), 0.0, 0.1),
    "pool": ((0.12, 0.42, 0.52), 0.0, 0.05),
}
_COURTS: tuple[Reflectance, ...] = ((0.10, 0.2, 0.12), (0.3, 0.12, 0.07), (0.09, 0.16, 0.27), (0.13, 0.13, 0.13))
_FIELDS: tuple[Reflectance, ...] = (
    (0.24, 0.2, 0.09), (0.09, 0.14, 0.04), (0.2, 0.15, 0.1), (0.14, 0.17, 0.05), (0.3, 0.26, 0.14),
)  # fmt: skip


def ground(
    city: City, west: float, north: float, size: float, scale: float, season: Season
) -> tuple[Float32Array, Float32Array]:
    """Paint the ground of a square window: colour (h, w, 3) and fraction of water (h, w), `scale` metres a pixel."""
    canvas = Canvas(west, north, size, size, scale)
    window = np.array([[west, north - size], [west + size, north - size], [west + size, north], [west, north]])

    def seen(points: Float64Array, reach: float = 10.0) -> bool:
        return bool(((points.max(axis=0) > window[0] - reach) & (points.min(axis=0) < window[2] + reach)).all())

    _grass(canvas, window, season, 0.5, 1.0)
    for block in city.blocks:
        if seen(block.polygon):
            _surface(canvas, block.polygon, block.surface, season, (block.polygon[0].sum() * 0.37) % 1.0)
    for path in city.paths:
        if seen(path.line):
            colour, grain, blotch = _GROUND.get(path.surface, _GROUND["gravel"])
            canvas.line(path.line, path.width + 0.8, colour, 0.2, 0.35, 0.2)
            canvas.line(path.line, path.width, colour, grain, 0.92, blotch)
    for patch in city.patches:
        if seen(patch.polygon):
            _patch(canvas, patch, season)
    for building in city.buildings:
        ring = city.footprint(building)
        if seen(ring):
            canvas.fill(_grown(ring, 1.3), (0.24, 0.22, 0.18), 0.15, 0.3, 0.45, soft=0.5)
    _streets(canvas, [street for street in city.streets if seen(street.line)], season)
    _river(canvas, city, window)
    return np.clip(canvas.colour, 0.005, 0.85), np.clip(canvas.water, 0, 1)


def _scaled(colour: Reflectance, factor: float) -> Reflectance:
    red, green, blue = (factor * value for value in colour)
    return red, green, blue


def _grown(ring: Float64Array, by: float) -> Float64Array:
    middle = (ring.max(axis=0) + ring.min(axis=0)) / 2
    extent = np.ptp(ring, axis=0)
    return np.asarray(middle + (ring - middle) * (1 + 2 * by / extent.max()))


def _grass(canvas: Canvas, polygon: Float64Array, season: Season, shade: float, worn: float) -> None:
    green, dry = np.array(season.grass), np.array(season.dry)
    share = np.clip(season.dryness * (0.5 + shade) * worn, 0, 1)
    base = tuple((green + (dry - green) * share).tolist())
    canvas.fill(polygon, base, 0.13, 0.13)
    # Dry and bare places come in blotches.
    if (where := canvas.mask(polygon, 0)) is None:
        return
    rows, columns, mask = where
    blotches = np.clip(0.5 * canvas.field(9, rows, columns) + 0.5 * canvas.field(2, rows, columns) - 0.5, 0, 1)
    most = np.float32(min(0.8, 0.25 + 0.55 * season.dryness * worn))
    weight = (mask.astype(np.float32) / 255 * blotches * most)[..., None]
    canvas.colour[rows, columns] += weight * (np.array(season.dry, np.float32) - canvas.colour[rows, columns])


def _surface(canvas: Canvas, polygon: Float64Array, surface: str, season: Season, shade: float) -> None:
    if surface in ("lawn", "meadow", "garden", "wood", "field"):
        _grass(canvas, polygon, season, shade, {"lawn": 0.8, "meadow": 1.3}.get(surface, 1.1))
        if surface == "wood":
            canvas.fill(polygon, (0.09, 0.075, 0.04), 0.2, 0.3, 0.6)
    else:
        colour, grain, blotch = _GROUND[surface]
        canvas.fill(polygon, _scaled(colour, 0.8 + 0.4 * shade), grain, blotch)
        _stains(canvas, polygon)


def _stains(canvas: Canvas, polygon: Float64Array, count: float = 0.004) -> None:
    """Paint repairs, oil, and dirt on hard ground."""
    low, high = polygon.min(axis=0), polygon.max(axis=0)
    rng = np.random.default_rng(int(abs(low.sum()) * 10))
    for _ in range(rng.poisson(count * float(np.prod(high - low)))):
        place = rng.uniform(low, high)
        if within(place[None], polygon, 1.0)[0]:
            length, width = rng.uniform(0.8, 6), rng.uniform(0.6, 2.5)
            ring = rectangle(place[0], place[1], length, width, rng.uniform(0, 3))
            dark = rng.random() < 0.6
            canvas.fill(ring, (0.08, 0.08, 0.08) if dark else (0.4, 0.39, 0.36), 0.1, 0.1, rng.uniform(0.15, 0.5),
                        soft=0.0 if rng.random() < 0.5 else 0.8)  # fmt: skip


def _patch(canvas: Canvas, patch: Patch, season: Season) -> None:
    middle = patch.polygon.mean(axis=0)

    def local(points: list[tuple[float, float]]) -> Float64Array:
        return np.asarray(turned(np.array(points), patch.angle) + middle)

    def marked(points: list[tuple[float, float]], width: float = 0.14, strength: float = 0.85) -> None:
        canvas.line(local(points), width, LINE, 0.05, strength)

    def box(x0: float, y0: float, x1: float, y1: float) -> list[tuple[float, float]]:
        return [(x0, y0), (x1, y0), (x1, y1), (x0, y1)]

    def ring(length: float, width: float) -> None:
        x, y = length / 2, width / 2
        marked([*box(-x, -y, x, y), (-x, -y)])

    def circle(x: float, y: float, radius: float) -> None:
        around = np.linspace(0, 2 * np.pi, 40)
        marked([(x + radius * float(np.cos(t)), y + radius * float(np.sin(t))) for t in around])

    length, width = patch.length, patch.width
    if patch.surface == "pitch":
        if patch.shade < 0.75:
            _grass(canvas, patch.polygon, season, 0.0, 0.4)
        else:
            canvas.fill(patch.polygon, (0.04, 0.13, 0.05), 0.03, 0.04)
        stripes = 12
        for i in range(0, stripes, 2):
            x = -length / 2 + i * length / stripes
            band = local(box(x, -width / 2, x + length / stripes, width / 2))
            canvas.fill(band, (0.13, 0.21, 0.06), 0.1, 0.1, 0.3)
        ring(length - 5, width - 5)
        marked([(0, -width / 2 + 2.5), (0, width / 2 - 2.5)])
        circle(0, 0, width * 0.13)
        for side in (-1, 1):
            x = side * (length / 2 - 2.5)
            for deep, wide in ((0.15, 0.55), (0.05, 0.25)):
                marked(box(x, -wide * width / 2, x - side * deep * length, wide * width / 2))
            canvas.fill(local(box(x - side * 7, -4, x, 4)), season.dry, 0.2, 0.2, 0.5, soft=1.0)
    elif patch.surface == "track":
        _track(canvas, patch, season)
    elif patch.surface == "court":
        canvas.fill(patch.polygon, (0.12, 0.2, 0.13) if patch.shade < 0.5 else (0.25, 0.11, 0.07), 0.03, 0.06)
        canvas.fill(local(box(-12, -5.5, 12, 5.5)), _COURTS[int(patch.shade * 3.99)], 0.03, 0.06)
        ring(23.8, 11)
        ring(23.8, 8.2)
        marked([(0, -6), (0, 6)])
        marked([(-6.4, 0), (6.4, 0)])
    elif patch.surface == "parking":
        colour, grain, blotch = _GROUND["parking"]
        canvas.fill(_grown(patch.polygon, 0.4), PAVING, 0.06, 0.1)
        canvas.fill(patch.polygon, _scaled(colour, 0.7 + 0.8 * patch.shade), grain, blotch)
        _stains(canvas, patch.polygon, 0.006)
        for y in parking_rows(width):
            for x in np.arange(-length / 2 + 0.15, length / 2, 2.5):
                marked([(float(x), y - 2.5), (float(x), y + 2.5)], 0.13, 0.75)
                canvas.fill(local(box(x + 0.7, y - 1.4, x + 1.8, y + 1.6)), (0.05, 0.05, 0.05), 0, 0.3, 0.22, soft=0.4)
    elif patch.surface == "field":
        colour = _FIELDS[int(patch.shade * 4.99)]
        canvas.fill(patch.polygon, colour, 0.15, 0.16)
        reach = max(length, width)
        for y in np.arange(-reach / 2, reach / 2, 3.0):
            line = local([(-reach / 2, float(y)), (reach / 2, float(y))])
            canvas.line(_clipped(line, patch.polygon), 1.1, _scaled(colour, 0.75), 0.1, 0.35)
    elif patch.surface == "water":
        canvas.fill(_grown(patch.polygon, 2.0), (0.2, 0.17, 0.1), 0.2, 0.2, soft=0.6)
        canvas.fill(patch.polygon, _GROUND["water"][0], 0, 0.1, water=1.0)
    elif patch.surface == "pool":
        canvas.fill(_grown(patch.polygon, 1.4), PAVING, 0.06, 0.05)
        canvas.fill(patch.polygon, _GROUND["pool"][0], 0, 0.05)
    elif patch.surface == "playground":
        canvas.fill(patch.polygon, _GROUND["playground"][0], 0.06, 0.1)
        for i, colour in enumerate(((0.3, 0.1, 0.06), (0.5, 0.36, 0.1), (0.1, 0.2, 0.35))):
            canvas.fill(local(box(-12 + 8 * i, -5, -6 + 8 * i, 3)), colour, 0.05, 0.1, 0.8)
    else:
        _surface(canvas, patch.polygon, patch.surface, season, patch.shade)
        if patch.surface == "plaza":
            for scale in (0.4, 0.7):
                shape = middle + (patch.polygon - middle) * scale
                canvas.line(np.concatenate([shape, shape[:1]]), 0.6, (0.24, 0.21, 0.18), 0.05, 0.7)
        if patch.surface == "garden":
            bed = middle + (patch.polygon - middle) * (0.9, 0.55)
            canvas.fill(bed, (0.14, 0.13, 0.06), 0.25, 0.3, 0.3 + 0.4 * patch.shade)


def _clipped(line: Float64Array, polygon: Float64Array) -> Float64Array:
    places = line[0] + (line[1] - line[0]) * np.linspace(0, 1, 120)[:, None]
    inside = places[within(places, polygon, 0.3)]
    return np.asarray(inside[[0, -1]] if len(inside) else places[:1])


def _track(canvas: Canvas, patch: Patch, season: Season) -> None:
    middle = patch.polygon.mean(axis=0)

    def oval(radius: float, straight: float) -> Float64Array:
        around = np.linspace(-np.pi / 2, np.pi / 2, 20)
        right = np.stack([np.cos(around) * radius + straight / 2, np.sin(around) * radius], axis=1)
        return np.asarray(turned(np.concatenate([right, -right]), patch.angle) + middle)

    straight = patch.length - patch.width
    red: Reflectance = (0.33, 0.12, 0.08) if patch.shade < 0.75 else (0.12, 0.18, 0.3)
    canvas.fill(oval(patch.width / 2, straight), red, 0.04, 0.06)
    for lane in range(7):
        shape = oval(patch.width / 2 - 1.2 * lane - 0.3, straight)
        canvas.line(np.concatenate([shape, shape[:1]]), 0.1, LINE, 0, 0.6)
    _grass(canvas, oval(patch.width / 2 - 8.8, straight), season, 0.1, 0.5)


def _streets(canvas: Canvas, streets: list[Street], season: Season) -> None:
    for street in streets:
        rng = np.random.default_rng(int(abs(street.line[0].sum()) * 10) + 1)
        tone = rng.uniform(0.6, 1.15)
        canvas.line(street.line, street.width + 2 * street.pavement, _scaled(PAVING, tone), 0.08, 1.0, 0.16)
        if street.pavement > 1.5 and rng.random() < 0.4:  # a verge between kerb and pavement
            for side in (-1, 1):
                canvas.line(beside(street.line, side * (street.width / 2 + street.pavement * 0.3)), street.pavement * 0.5,
                            season.grass, 0.15, 0.85, 0.25)  # fmt: skip
    for street in streets:
        canvas.line(street.line, street.width + 0.35, (0.36, 0.35, 0.33), 0.05, 0.7)
    for street in streets:
        rng = np.random.default_rng(int(abs(street.line[0].sum()) * 10))
        factor = rng.uniform(0.8, 1.8)
        canvas.line(street.line, street.width, _scaled(ASPHALT, factor), 0.07, 1.0, 0.14)
    for street in streets:
        rng = np.random.default_rng(int(abs(street.line[-1].sum()) * 10))
        offsets = (-5.3, -1.9, 1.9, 5.3) if street.kind == "arterial" else (-1.6, 1.6)
        for offset in offsets:  # wheels darken the lanes
            for wheel in (-0.75, 0.75):
                canvas.line(beside(street.line, offset + wheel), 0.5, (0.07, 0.07, 0.07), 0.1, 0.2)
        for _ in range(rng.poisson(len(street.line) / 4)):  # patches and trenches
            i = int(rng.integers(len(street.line) - 1))
            off = rng.uniform(-0.35, 0.35) * street.width
            piece = beside(street.line[i : i + 2], off)
            canvas.line(piece, rng.uniform(0.8, 3), (0.075, 0.075, 0.078), 0.05, rng.uniform(0.3, 0.8))
    for street in streets:
        line = street.line
        if street.kind == "arterial":
            for offset in (0.12, -0.12):
                canvas.line(beside(line, offset), 0.15, LINE, 0.1, 0.8)
            for offset in (-3.6, 3.6):
                _dashes(canvas, beside(line, offset), 3.0, 9.0)
        elif street.kind == "local":
            _dashes(canvas, line, 2.0, 6.0)
        _crossings(canvas, street)


def _dashes(canvas: Canvas, line: Float64Array, mark: float, pitch: float) -> None:
    lengths = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))])
    for start in np.arange(9, lengths[-1] - 9, pitch):
        ends = np.array([start, start + mark])
        canvas.line(np.stack([np.interp(ends, lengths, line[:, k]) for k in (0, 1)], axis=1), 0.13, LINE, 0.1, 0.7)


def _crossings(canvas: Canvas, street: Street) -> None:
    """Paint zebra stripes and a stop line at the ends of a street."""
    for line in (street.line, street.line[::-1]):
        along = (line[1] - line[0]) / np.linalg.norm(line[1] - line[0])
        across = np.array([-along[1], along[0]])
        foot = line[0] + along * 11.5
        if street.kind == "lane":
            continue
        for offset in np.arange(-street.width / 2 + 0.6, street.width / 2 - 0.3, 1.0):
            stripe = np.stack([foot + across * offset, foot + across * offset + along * 2.6])
            canvas.line(stripe, 0.45, LINE, 0.1, 0.8)
        stop = np.stack([foot + along * 4 - across * 0.2, foot + along * 4 - across * (street.width / 2 - 0.3)])
        canvas.line(stop, 0.35, LINE, 0.1, 0.8)


def _river(canvas: Canvas, city: City, window: Float64Array) -> None:
    river = city.terrain.river
    near = river.line[(river.line[:, 1] > window[0, 1] - 60) & (river.line[:, 1] < window[2, 1] + 60)]
    if len(near) < 2 or near[:, 0].min() > window[1, 0] + river.width or near[:, 0].max() < window[0, 0] - river.width:
        return
    for width, colour, water in (
        (river.width + 7.0, (0.3, 0.28, 0.25), 0.0),
        (river.width + 1.0, (0.17, 0.15, 0.12), 0.0),
        (river.width - 0.5, (0.04, 0.055, 0.045), 1.0),
    ):
        ring = np.concatenate([beside(near, width / 2), beside(near, -width / 2)[::-1]])
        canvas.fill(ring, colour, 0.06, 0.12, water=water)
