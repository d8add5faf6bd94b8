"""Synthetic pictures to measure with: blurred noise, which compresses about as photographs do."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np


def write(file: Path, side: int, rng: np.random.Generator) -> None:
    """A square JPEG file, with the folders it lies in."""
    file.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(file), cv2.GaussianBlur(rng.integers(0, 256, (side, side, 3), np.uint8), (5, 5), 1.5))


def make_folder(root: Path, count: int) -> Path:
    """Pictures of 512 pixels a side, 16 in each folder below the root."""
    rng = np.random.default_rng(0)
    for number in range(count):
        write(root / f"{number // 16:04d}" / f"image-{number % 16:02d}.jpg", 512, rng)
    return root


def make_train_split(root: Path, places: int = 24) -> Path:
    """A train split in University-1652's layout: of each place a satellite of 512 pixels and four drone pictures of 256."""
    rng = np.random.default_rng(0)
    for label in range(places):
        for view, count, side in (("satellite", 1, 512), ("drone", 4, 256)):
            for number in range(count):
                write(root / "train" / view / f"{label:04d}" / f"image-{number:02d}.jpg", side, rng)
    return root
