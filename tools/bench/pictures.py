"""Synthetic pictures for benchmarks: blurred noise, which compresses about as well as photographs."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np


def write(file: Path, side: int, rng: np.random.Generator) -> None:
    """Write a square JPEG file and its folders."""
    file.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(file), cv2.GaussianBlur(rng.integers(0, 256, (side, side, 3), np.uint8), (5, 5), 1.5))


def make_folder(root: Path, count: int) -> Path:
    """Write pictures of 512 x 512 pixels, 16 in each folder."""
    rng = np.random.default_rng(0)
    for number in range(count):
        write(root / f"{number // 16:04d}" / f"image-{number % 16:02d}.jpg", 512, rng)
    return root


def make_train_split(root: Path, places: int = 24) -> Path:
    """Write a training split in University-1652's layout: per place a 512-pixel satellite and four 256-pixel drone pictures."""
    rng = np.random.default_rng(0)
    for label in range(places):
        for view, count, side in (("satellite", 1, 512), ("drone", 4, 256)):
            for number in range(count):
                write(root / "train" / view / f"{label:04d}" / f"image-{number:02d}.jpg", side, rng)
    return root
