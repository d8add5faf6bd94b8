"""The kinds of buildings: each function draws a random architecture of one kind."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from tools.world.architecture import (
    BLUE,
    BRICK,
    BROWN,
    BUFF,
    CONCRETE,
    COPPER,
    DARK,
    GREEN,
    GREY,
    LIGHT,
    RUST,
    SAND,
    STEEL,
    WHITE,
    Architecture,
    BuildingShape,
    Corner,
    Dress,
    RoofItem,
    RoofShape,
    Volume,
    box,
    chimneys,
    classic,
    modern,
    near,
    plant,
    shed,
)
from tools.world.geometry import ellipse


def _joined(
    kind: BuildingShape, outline: tuple[Corner, ...], parts: list[Volume], items: list[RoofItem]
) -> Architecture:
    """Make an architecture, moved so that its footprint's middle is the origin."""
    ring = np.array(outline)
    dx, dy = (-(ring.max(axis=0) + ring.min(axis=0)) / 2).tolist()

    def moved(corners: tuple[Corner, ...]) -> tuple[Corner, ...]:
        return tuple((round(x + dx, 4), round(y + dy, 4)) for x, y in corners)

    return Architecture(
        kind,
        moved(outline),
        tuple(replace(part, outline=moved(part.outline)) for part in parts),
        tuple(replace(item, x=item.x + dx, y=item.y + dy) for item in items),
    )


def _storey(
    rng: np.random.Generator, dress: Dress, wing: tuple[Corner, ...], eaves: float, parts: list[Volume]
) -> list[RoofItem]:
    """Place roof equipment on a wing, around and on a set-back storey if it has one."""
    below = plant(rng, wing, eaves)
    if rng.random() > 0.5:
        return below
    (x0, y0), (x1, y1) = np.array(wing).min(axis=0) + 2.0, np.array(wing).max(axis=0) - 2.0
    share = rng.uniform(0.3, 0.7)
    if x1 - x0 > y1 - y0:
        x0 += rng.uniform(0, 1 - share) * (x1 - x0)
        x1 = x0 + share * (np.array(wing)[:, 0].max() - 2.0 - x0)
    else:
        y0 += rng.uniform(0, 1 - share) * (y1 - y0)
        y1 = y0 + share * (np.array(wing)[:, 1].max() - 2.0 - y0)
    if x1 - x0 < 5 or y1 - y0 < 5:
        return below
    upper = box(float(x0), float(y0), float(x1), float(y1))
    parts.append(dress.part(upper, eaves + dress.storey, base=eaves))
    clear = [
        i for i in below
        if not (x0 - i.length / 2 < i.x < x1 + i.length / 2 and y0 - i.width / 2 < i.y < y1 + i.width / 2)
    ]  # fmt: skip
    return clear + plant(rng, upper, eaves + dress.storey)


def _wings(rng: np.random.Generator, kind: BuildingShape, wings: list[tuple[Corner, ...]], outline: tuple[Corner, ...],
           pitched: bool, storeys: int) -> Architecture:  # fmt: skip
    """Make a building of straight wings: flat with different heights, or pitched with roofs that meet."""
    dress = classic(rng) if pitched else modern(rng)
    eaves = storeys * dress.storey
    parts: list[Volume] = []
    items: list[RoofItem] = []
    depth = min(min(np.ptp(np.array(wing), axis=0)) for wing in wings)
    for i, wing in enumerate(wings):
        height = eaves if pitched or i == 0 else max(dress.storey, eaves + dress.storey * int(rng.integers(-1, 2)))
        if pitched:
            across = float(min(np.ptp(np.array(wing), axis=0)))
            rise = across * 0.42 * min(1.0, depth / across * 1.1)
            parts.append(dress.part(wing, height, "hip" if rng.random() < 0.4 else "gable", rise))
            ring = np.array(wing)
            x, y = ring.mean(axis=0)
            for _ in range(int(rng.integers(1, 4))):
                reach = np.ptp(ring, axis=0) * 0.3
                px, py = x + rng.uniform(-1, 1) * reach[0], y + rng.uniform(-1, 1) * reach[1]
                items.append(RoofItem("box", float(px), float(py), height, 1.0, 1.0, rise + 1.2, near(rng, BRICK)))
        else:
            parts.append(dress.part(wing, height))
            items.extend(_storey(rng, dress, wing, height, parts))
    return _joined(kind, outline, parts, items)


def slab(rng: np.random.Generator, kind: BuildingShape = "slab", storeys: tuple[int, int] = (3, 7)) -> Architecture:
    """A straight block with a flat roof and perhaps a low annexe."""
    dress = modern(rng)
    length, width = rng.uniform(36, 70), rng.uniform(13, 21)
    eaves = int(rng.integers(*storeys)) * dress.storey
    wing = box(0, 0, length, width)
    parts = [dress.part(wing, eaves)]
    items = _storey(rng, dress, wing, eaves, parts)
    if len(parts) == 1 and rng.random() < 0.5:  # a stair tower that breaks the outline of the roof
        x = rng.uniform(0.15, 0.85) * length
        parts.append(dress.part(box(x - 3, width * 0.3, x + 3, width * 0.75), eaves + 3.4, base=eaves))
    return _joined(kind, wing, parts, items)


def lshape(rng: np.random.Generator, pitched: bool = False) -> Architecture:
    """Two wings at a right angle."""
    a, b, t = rng.uniform(38, 66), rng.uniform(30, 52), rng.uniform(12, 19)
    wings = [box(0, 0, a, t), box(0, t if not pitched else 0, t, b)]
    outline = ((0, 0), (a, 0), (a, t), (t, t), (t, b), (0.0, b))
    return _wings(rng, "lshape", wings, outline, pitched, int(rng.integers(2, 6)))


def ushape(rng: np.random.Generator, pitched: bool = False) -> Architecture:
    """Three wings around a yard that is open to the back."""
    a, b, t = rng.uniform(44, 72), rng.uniform(30, 50), rng.uniform(12, 17)
    foot = 0.0 if pitched else t
    wings = [box(0, 0, a, t), box(0, foot, t, b), box(a - t, foot, a, b)]
    outline = ((0, 0), (a, 0), (a, b), (a - t, b), (a - t, t), (t, t), (t, b), (0.0, b))
    return _wings(rng, "ushape", wings, outline, pitched, int(rng.integers(2, 5)))


def tshape(rng: np.random.Generator, pitched: bool = False) -> Architecture:
    """A wing along the street and one behind its middle."""
    a, b, t, s = rng.uniform(42, 68), rng.uniform(32, 52), rng.uniform(12, 18), rng.uniform(12, 22)
    x0, x1 = a / 2 - s / 2, a / 2 + s / 2
    wings = [box(0, 0, a, t), box(x0, t if not pitched else t / 2, x1, b)]
    outline = ((0, 0), (a, 0), (a, t), (x1, t), (x1, b), (x0, b), (x0, t), (0.0, t))
    return _wings(rng, "tshape", wings, outline, pitched, int(rng.integers(2, 6)))


def courtyard(rng: np.random.Generator, pitched: bool = False) -> Architecture:
    """Four wings around a closed yard."""
    a, b, t = rng.uniform(46, 74), rng.uniform(40, 60), rng.uniform(11, 16)
    low, high = (0.0, b) if pitched else (t, b - t)
    wings = [box(0, 0, a, t), box(0, b - t, a, b), box(0, low, t, high), box(a - t, low, a, high)]
    return _wings(rng, "courtyard", wings, box(0, 0, a, b), pitched, int(rng.integers(2, 5)))


def tower(rng: np.random.Generator) -> Architecture:
    """A high block, often on a podium."""
    dress, low = modern(rng), modern(rng)
    a, b = rng.uniform(18, 30), rng.uniform(16, 24)
    eaves = int(rng.integers(8, 17)) * dress.storey
    p, q = a + rng.uniform(8, 22), b + rng.uniform(6, 16)
    x, y = rng.uniform(2, p - a - 2), rng.uniform(2, q - b - 2)
    wing = box(x, y, x + a, y + b)
    parts = [dress.part(wing, eaves), low.part(box(0, 0, p, q), 2 * low.storey)]
    core = box(x + a * 0.3, y + b * 0.3, x + a * 0.75, y + b * 0.75)
    parts.append(dress.part(core, eaves + 4.2, base=eaves))
    on_top = [i for i in plant(rng, wing, eaves) if not (x + a * 0.25 < i.x < x + a * 0.8)]
    around = [
        i for i in plant(rng, box(0, 0, p, q), 2 * low.storey)
        if not (x - 4 < i.x < x + a + 4 and y - 4 < i.y < y + b + 4)
    ]  # fmt: skip
    return _joined("tower", box(0, 0, p, q), parts, on_top + around)


def hall(rng: np.random.Generator) -> Architecture:
    """A wide shed: flat, low gable, saw-tooth, or barrel roof, with strips of skylight."""
    dress = shed(rng)
    a, b = rng.uniform(42, 72), rng.uniform(26, 44)
    eaves = rng.uniform(7, 11)
    roof: RoofShape = ("flat", "gable", "sawtooth", "barrel", "gable", "flat")[rng.integers(6)]
    rise = {"flat": 0.0, "gable": b * 0.09, "sawtooth": 2.6, "barrel": b * 0.13}[roof]
    wing = box(0, 0, a, b)
    parts = [dress.part(wing, eaves, roof, rise)]
    items: list[RoofItem] = []
    if roof == "flat":
        pitch = rng.uniform(6, 10)
        items = [
            RoofItem("skylight", float(x), b / 2, eaves, 1.6, b * 0.72, 0.5, (0.4, 0.46, 0.48))
            for x in np.arange(pitch / 2, a, pitch)
        ]
        items += [i for i in plant(rng, wing, eaves, 0.5) if ((i.x / pitch) % 1 - 0.5) ** 2 > 0.09]
    elif roof == "gable":
        slope = np.arctan2(rise, b / 2)
        for x in np.arange(5, a - 3, rng.uniform(6, 9)):
            for side in (-1, 1):
                y, z = b / 2 + side * b * 0.24, eaves + rise * 0.52 - 0.3 * np.cos(slope)
                items.append(RoofItem("skylight", float(x), y, float(z), 1.3, b * 0.3, 0.35, (0.4, 0.46, 0.48)))
    if rng.random() < 0.6:  # offices at the front
        front = modern(rng)
        w = rng.uniform(0.25, 0.6) * a
        porch = box(a - w, -7.0, a, 0)
        parts.append(front.part(porch, 2 * front.storey))
        items += plant(rng, porch, 2 * front.storey, 0.6)
        outline = ((0, 0), (a - w, 0.0), (a - w, -7.0), (a, -7.0), (a, b), (0.0, b))
        return _joined("hall", outline, parts, items)
    return _joined("hall", wing, parts, items)


def rotunda(rng: np.random.Generator) -> Architecture:
    """A round auditorium, domed, conical, or flat, on a low base."""
    dress = modern(rng)
    across = rng.uniform(24, 38)
    ring = tuple((float(x), float(y)) for x, y in ellipse(0, 0, across, across, 0, 36))
    eaves = rng.uniform(8, 14)
    roof: RoofShape = ("dome", "cone", "flat")[rng.integers(3)]
    if roof != "flat":
        tint = near(rng, (WHITE, LIGHT, COPPER, GREY, STEEL)[rng.integers(5)])
        dress = replace(dress, cover="seams", cover_tint=tint)
    parts = [dress.part(ring, eaves, roof, {"dome": across * 0.16, "cone": across * 0.1, "flat": 0.0}[roof])]
    items = plant(rng, box(-across * 0.3, -across * 0.3, across * 0.3, across * 0.3), eaves) if roof == "flat" else []
    if rng.random() < 0.6:
        inner = tuple((x * 0.55, y * 0.55) for x, y in ring)
        if roof == "flat":
            parts, items = [*parts, dress.part(inner, eaves + 4, "dome", 1.5, base=eaves)], []
    return _joined("round", ring, parts, items)


def terrace(rng: np.random.Generator) -> Architecture:
    """A row of houses under one roof, with chimneys, back additions, and dormers."""
    dress = classic(rng)
    units, width, depth = int(rng.integers(6, 10)), rng.uniform(5.0, 6.6), rng.uniform(8.5, 10.5)
    a, eaves = units * width, int(rng.integers(2, 4)) * 2.9
    wing, rise = box(0, -depth / 2, a, depth / 2), depth * 0.4
    parts = [dress.part(wing, eaves, "gable", rise)]
    items = chimneys(rng, -width / 2, a, eaves + rise, width * int(rng.integers(1, 3)))
    back = rng.uniform(2.8, 4.2)
    for i in range(units):
        x = i * width + (0 if i % 2 else width * 0.42)
        parts.append(dress.part(box(x, depth / 2, x + width * 0.58, depth / 2 + back), eaves * 0.55, "flat"))
    if rng.random() < 0.5:
        for i in range(units):
            x = (i + 0.5) * width
            items.append(RoofItem("skylight", x, -depth * 0.26, eaves + rise * 0.3, 1.0, 1.2, 0.75, (0.2, 0.25, 0.3)))
    return _joined("terrace", box(0, -depth / 2, a, depth / 2 + back), parts, items)


def dormitory(rng: np.random.Generator) -> Architecture:
    """A residential slab, flat or hipped."""
    if rng.random() < 0.65:
        return slab(rng, "dormitory", (3, 6))
    dress = classic(rng)
    a, b = rng.uniform(34, 52), rng.uniform(12, 14.5)
    eaves, rise = int(rng.integers(3, 5)) * 3.0, b * 0.32
    wing = box(0, -b / 2, a, b / 2)
    items = chimneys(rng, 6, a - 6, eaves + rise, rng.uniform(9, 14))
    return _joined("dormitory", wing, [dress.part(wing, eaves, "hip", rise)], items)


def house(rng: np.random.Generator) -> Architecture:
    """A detached house, often with a wing across."""
    dress = classic(rng)
    a, b = rng.uniform(10, 14), rng.uniform(7.5, 9.5)
    eaves, rise = rng.choice([3.0, 5.6]), b * rng.uniform(0.32, 0.5)
    parts = [dress.part(box(0, 0, a, b), eaves, "hip" if rng.random() < 0.4 else "gable", rise)]
    items = [RoofItem("box", a * rng.uniform(0.2, 0.8), b / 2 + 0.6, eaves, 0.9, 0.9, rise + 1.0, near(rng, BRICK))]
    outline: tuple[Corner, ...] = box(0, 0, a, b)
    if rng.random() < 0.6:
        w, out = rng.uniform(5, 6.5), rng.uniform(2, 4)
        x = float(rng.choice([0, a - w]))
        parts.append(dress.part(box(x, -out, x + w, b * 0.6), eaves, "gable", rise * 0.8))
        outline = box(0, -out, a, b)
    if rng.random() < 0.4:
        items.append(RoofItem("skylight", a * 0.5, b * 0.25, eaves + rise * 0.3, 1.0, 1.4, 0.7, (0.2, 0.25, 0.3)))
    return _joined("house", outline, parts, items)


def townhouse(rng: np.random.Generator) -> Architecture:
    """One house of an old street: narrow, high, pitched, walls shared with its neighbours."""
    dress = classic(rng)
    a, b = rng.uniform(7, 14), rng.uniform(11, 13.5)
    eaves, rise = int(rng.integers(2, 5)) * 3.1, b * rng.uniform(0.28, 0.42)
    parts = [dress.part(((0, 0), (a, 0), (a, b), (0.0, b)), eaves, "gable", rise)]
    items = [RoofItem("box", 0.6, b / 2 + rng.uniform(-2, 2), eaves, 0.8, 1.4, rise + 1.0, near(rng, BRICK))]
    items += [
        RoofItem("box", float(x), b * 0.22, eaves + 0.2, 1.3, 2.4, rise * 0.55, near(rng, dress.wall_tint))
        for x in np.arange(1.8, a - 1.2, 3.2)
        if rng.random() < 0.6
    ]
    return _joined("townhouse", box(0, 0, a, b), parts, items)


def church(rng: np.random.Generator) -> Architecture:
    """Nave, transept, and tower."""
    dress = classic(rng)
    a, b, eaves = rng.uniform(32, 44), rng.uniform(11, 14), rng.uniform(10, 13)
    parts = [
        dress.part(box(0, -b / 2, a, b / 2), eaves, "gable", b * 0.6),
        dress.part(box(a * 0.6, -b * 1.05, a * 0.6 + b * 0.85, b * 1.05), eaves, "gable", b * 0.5),
        dress.part(box(-6, -3.5, 1, 3.5), eaves * 2, "cone", rng.uniform(3, 12)),
    ]
    return _joined("church", box(-6, -b * 1.05, a, b * 1.05), parts, [])


def shop(rng: np.random.Generator) -> Architecture:
    """A large low store."""
    dress = Dress("cladding", near(rng, (BUFF, WHITE, CONCRETE, BRICK)[rng.integers(4)]), "membrane",
                  near(rng, (WHITE, LIGHT, SAND)[rng.integers(3)]), 6.0, 6.0)  # fmt: skip
    a, b, eaves = rng.uniform(46, 76), rng.uniform(34, 50), rng.uniform(6, 8)
    wing = box(0, 0, a, b)
    parts = [dress.part(wing, eaves), dress.part(box(a * 0.4, -3, a * 0.6, 0), eaves + 1.5)]
    return _joined("shop", box(0, -3, a, b), parts, plant(rng, wing, eaves, 0.8))


def stand(rng: np.random.Generator) -> Architecture:
    """A grandstand."""
    dress = shed(rng)
    a, b = rng.uniform(50, 80), rng.uniform(11, 16)
    seats = Dress("cladding", near(rng, CONCRETE), "seats", near(rng, (BLUE, RUST, LIGHT)[rng.integers(3)]), 4, 4)
    parts = [seats.part(box(0, 0, a, b * 0.55), 3.5), dress.part(box(0, b * 0.55, a, b), 9)]
    return _joined("stand", box(0, 0, a, b), parts, [])


def pavilion(rng: np.random.Generator) -> Architecture:
    """A small building in a park or beside a pitch."""
    dress = classic(rng)
    a, b = rng.uniform(14, 24), rng.uniform(9, 13)
    wing = box(0, 0, a, b)
    return _joined("pavilion", wing, [dress.part(wing, 3.6, "hip", b * 0.3)], [])


def barn(rng: np.random.Generator) -> Architecture:
    """A farm building."""
    dress = shed(rng)
    a, b = rng.uniform(18, 36), rng.uniform(10, 15)
    wing = box(0, 0, a, b)
    return _joined("barn", wing, [dress.part(wing, 4.5, "gable", b * 0.25)], [])


def outhouse(rng: np.random.Generator) -> Architecture:
    """A garden shed or garage."""
    dress = Dress("plain", near(rng, (BROWN, BUFF, CONCRETE)[rng.integers(3)]), "bitumen",
                  near(rng, (GREY, DARK, BROWN, LIGHT)[rng.integers(4)]), 3, 3)  # fmt: skip
    a, b = rng.uniform(2.4, 6), rng.uniform(2.2, 3.6)
    wing = box(0, 0, a, b)
    return _joined("shed", wing, [dress.part(wing, 2.3, "gable" if rng.random() < 0.5 else "flat", 0.7)], [])


def tank(rng: np.random.Generator) -> Architecture:
    """A storage tank."""
    across = rng.uniform(7, 16)
    dress = Dress("plain", near(rng, WHITE), "plain", near(rng, (WHITE, LIGHT)[rng.integers(2)]), 3, 3)
    ring = tuple((float(x), float(y)) for x, y in ellipse(0, 0, across, across, 0, 28))
    return _joined("tank", ring, [dress.part(ring, rng.uniform(5, 10), "cone", 0.8)], [])


def container(rng: np.random.Generator) -> Architecture:
    """A freight container or a trailer."""
    tint = near(rng, (BLUE, RUST, GREEN, LIGHT, WHITE, BUFF)[rng.integers(6)])
    dress = Dress("plain", tint, "seams", tint, 3, 3)
    wing = box(0, 0, float(rng.choice([6.1, 12.2])), 2.45)
    return _joined("container", wing, [dress.part(wing, 2.6)], [])


def _pitched(
    make: Callable[[np.random.Generator, bool], Architecture],
) -> Callable[[np.random.Generator], Architecture]:
    return lambda rng: make(rng, True)


_BLOCKS = (slab, lshape, ushape, tshape, courtyard, tower, hall, church, shop, stand, pavilion, barn, tank, container)
_HOMES = (terrace, dormitory, house, townhouse)
MAKERS: dict[str, Callable[[np.random.Generator], Architecture]] = {
    **{make.__name__: make for make in (*_BLOCKS, *_HOMES)},
    **{f"old {make.__name__}": _pitched(make) for make in (lshape, ushape, tshape, courtyard)},
    "round": rotunda,
    "shed": outhouse,
}
