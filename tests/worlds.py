"""A small data set in University-1652's layout, drawn here, and an untrained LPN for it."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
import torch

from lpn.core.images import Picture, polar, rotate
from lpn.models.checkpoints import save
from lpn.models.export import export
from lpn.models.network import LPN
from lpn.models.spec import ModelSpec
from lpn.world.glb import Primitive, glb

SIZE = 96


def place(seed: int) -> Picture:
    """A plan view of an invented place: ground, roads, and roofs in colours of its own."""
    rng = np.random.default_rng(seed)
    picture = np.empty((SIZE, SIZE, 3), np.uint8)
    picture[:] = rng.integers(60, 150, 3)
    for _ in range(3):
        start, end = (tuple(int(v) for v in rng.integers(0, SIZE, 2)) for _ in range(2))
        cv2.line(picture, start, end, tuple(int(v) for v in rng.integers(90, 140, 3)), int(rng.integers(3, 8)))
    for _ in range(14):
        x, y, w, h = (int(v) for v in (*rng.integers(0, SIZE - 12, 2), *rng.integers(6, 26, 2)))
        cv2.rectangle(picture, (x, y), (x + w, y + h), tuple(int(v) for v in rng.integers(0, 256, 3)), -1)
    noise = rng.integers(-12, 13, picture.shape)
    return np.clip(picture + noise, 0, 255).astype(np.uint8)


def from_drone(picture: Picture, seed: int) -> Picture:
    """The same place from a drone: turned a little, in other light."""
    rng = np.random.default_rng(seed)
    lit = picture * rng.uniform(0.75, 1.2) + rng.uniform(-15, 15, 3)
    return rotate(np.clip(lit, 0, 255).astype(np.uint8), float(rng.uniform(-8, 8)))


def write(path: Path, picture: Picture) -> None:
    """Write a picture file, folders included."""
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), cv2.cvtColor(picture, cv2.COLOR_RGB2BGR))


def spoilt_png(path: Path) -> None:
    """A PNG that is whole at both ends, with right checksums, and still cannot be decoded."""
    chunks = [(b"IHDR", struct.pack(">IIBBBBB", SIZE, SIZE, 8, 2, 0, 0, 0)), (b"IDAT", b"\xff" * 400), (b"IEND", b"")]
    framed = [struct.pack(">I", len(d)) + kind + d + struct.pack(">I", zlib.crc32(kind + d)) for kind, d in chunks]
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + b"".join(framed))


def make_dataset(root: Path, train: int = 6, test: int = 14) -> Path:
    """Train and test places with one satellite and one drone picture each, labels from 1."""
    for label in range(1, train + test + 1):
        satellite = place(label)
        drone = from_drone(satellite, 1000 + label)
        name = f"{label:04d}"
        if label <= train:
            write(root / "train" / "satellite" / name / f"{name}.png", satellite)
            write(root / "train" / "drone" / name / "image-01.png", drone)
        else:
            for role in ("query", "gallery"):
                write(root / "test" / f"{role}_satellite" / name / f"{name}.png", satellite)
                write(root / "test" / f"{role}_drone" / name / "image-01.png", drone)
    return root


def map_dataset(root: Path) -> Path:
    """Give a drawn data set a `geo.csv`: its places 100 m apart on a grid of four columns, its drones at a slant."""
    lines = ["path,latitude,longitude,altitude,heading,tilt,fov,width"]
    for file in sorted((root / "test").rglob("*.png")):
        row, column = divmod(int(file.parent.name), 4)
        pose = ",,,,90" if "satellite" in file.parts[-3] else f"150,{10 * row},-50,41,"
        lines.append(f"{file.relative_to(root).as_posix()},{46 - row * 0.0009:.6f},{7 + column * 0.0013:.6f},{pose}")
    (root / "geo.csv").write_text("\n".join(lines) + "\n")
    return root


def city() -> bytes:
    """A `city.glb` of red ground and houses for the places above, 400 m by 500 m."""
    solid = [_box(150, -250, 700, 800, -5)]
    solid += [_box(east, -south, 40, 40, 30) for east in range(0, 500, 100) for south in range(0, 600, 100)]
    vertices = np.concatenate(solid)
    faces = _BOX + 8 * np.arange(len(solid))[:, None, None]
    colours = np.full((len(vertices), 3), (230, 4, 4), np.uint8)
    colours[8:] = (250, 10, 120)
    return glb([Primitive("houses", vertices, faces.reshape(-1, 3), colours)], {"latitude": 45.9991, "longitude": 7.0})


_BOX = np.array(
    [(0, 1, 5), (0, 5, 4), (1, 2, 6), (1, 6, 5), (2, 3, 7), (2, 7, 6), (3, 0, 4), (3, 4, 7), (4, 5, 6), (4, 6, 7)]
)


def _box(east: float, north: float, length: float, width: float, top: float) -> np.ndarray:
    ring = [(-length, -width), (length, -width), (length, width), (-length, width)]
    return np.array([(east + x / 2, north + y / 2, z) for z in (top - 30, top) for x, y in ring], np.float64)


def make_network(n_parts: int = 4, size: int = 64, classes: int = 6, seed: int = 0) -> LPN:
    """An untrained ResNet-18 LPN, cut after layer3, for satellite and drone."""
    torch.manual_seed(seed)
    return LPN(
        ModelSpec(
            backbone="resnet18",
            last_layer="layer3",
            views=("satellite", "drone"),
            n_parts=n_parts,
            classes=classes,
            input_size=(size, size),
        )
    )


def make_model(folder: Path, n_parts: int = 4, size: int = 64) -> Path:
    """The network above as an exported `model.onnx`."""
    save(make_network(n_parts, size), folder / "model.safetensors")
    export(folder / "model.safetensors", folder / "model.onnx")
    return folder / "model.onnx"


def make_views(root: Path, places: int) -> Path:
    """The same places to train on and to test on, from satellite, drone, and street, and a "google" set.

    The drone's pictures are negatives, which a network that has learnt nothing does not find.
    """
    for label in range(1, places + 1):
        satellite, name = place(label), f"{label:04d}"
        pictures = {"satellite": satellite, "drone": from_drone(255 - satellite, 1000 + label)}
        pictures["street"] = from_drone(np.ascontiguousarray(satellite[SIZE // 4 :]), 2000 + label)
        for view, picture in pictures.items():
            for split in (f"train/{view}", f"test/query_{view}", f"test/gallery_{view}"):
                write(root / split / name / "a.png", picture)
        write(root / "train" / "google" / name / "b.png", from_drone(satellite, 3000 + label))
    return root


def make_cvusa(root: Path, pairs: int, height: int = 56, width: int = 224) -> Path:
    """Pairs of tile and panorama in CVUSA's layout, the same to train on and to test on; a panorama is its unrolled tile in
    other light."""
    rows = []
    for number in range(1, pairs + 1):
        tile = cv2.resize(place(number), (2 * SIZE, 2 * SIZE))
        panorama = np.clip(polar(tile, height, width) * 0.8 + 20, 0, 255).astype(np.uint8)
        names = (f"bingmap/19/{number:07d}.png", f"streetview/panos/{number:07d}.png")
        for name, picture in zip(names, (tile, panorama), strict=True):
            write(root / name, picture)
        rows.append(f"{names[0]},{names[1]},\n")
    (root / "splits").mkdir()
    for split in ("train", "val"):
        (root / "splits" / f"{split}-19zl.csv").write_text("".join(rows))
    return root
