"""Occlusion: the loss of a pair's score by a covered square of the picture. It is measured, and so approximate.

Occlusion needs only a model's descriptors and serves every model; `lpn.explain.attribution` is exact for a model with cells.
Covered pictures are artificial, and the receptive fields of cells reach beyond the covered square.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, cast

import cv2
import numpy as np

from lpn.core.arrays import BoolArray, Float32Array, FloatingArray, UInt8Array
from lpn.core.views import View
from lpn.explain.attribution import part_values
from lpn.models.base import Model
from lpn.retrieval import scoring

# Squares across and down.
SQUARES = 8
_BATCH = 8


def occlude(
    model: Model, picture: UInt8Array, view: View, other: Float32Array, rows: int = SQUARES, columns: int = SQUARES
) -> Iterator[tuple[int, Float32Array]]:
    """Cover each square of a picture in turn, and measure the loss of each part's cosine with another picture.

    Args:
        picture: (H, W, 3) uint8.
        other: the other picture's descriptor, (n, D).
        rows, columns: numbers of squares down and across the network's input.

    Yields:
        The number of measured squares, and the losses so far, (n, rows, columns), NaN for the other squares; a square with a
        positive loss speaks for the pair.
    """
    shaped = model.to_input_size(picture, view)
    whole = _cosines(model, [shaped], view, other)[0]
    blurred = blur(shaped)
    losses = np.full((model.n_parts, rows, columns), np.nan, np.float32)
    squares = [(row, column) for row in range(rows) for column in range(columns)]
    for start in range(0, len(squares), _BATCH):
        some = squares[start : start + _BATCH]
        masks = np.zeros((len(some), rows, columns), bool)
        masks[(np.arange(len(some)), *np.transpose(some))] = True
        pictures = [mixed(shaped, blurred, mask) for mask in masks]
        for (row, column), cosines in zip(some, _cosines(model, pictures, view, other), strict=True):
            losses[:, row, column] = whole - cosines
        yield start + len(some), losses


def to_dict(
    cosines: FloatingArray, weights: Float32Array, losses: Float32Array, names: Sequence[str]
) -> dict[str, Any]:
    """Return the JSON values for a pair's losses (n, rows, columns), which have no meaningful sum.

    Args:
        cosines: of the parts of the pair, (n,).
        weights: part weights that sum to one, (n,).
    """
    score, parts = float(cosines @ weights), part_values(names, cosines, weights)
    for part, of_part in zip(parts, losses.tolist(), strict=True):
        part["losses"] = of_part
    return {"level": "measured by occlusion", "score": score, "distance2": 2 - 2 * score, "parts": parts}


def blur(picture: UInt8Array) -> UInt8Array:
    """Blur a picture with a standard deviation of an eighth of its shorter side."""
    return cast(UInt8Array, cv2.GaussianBlur(picture, (0, 0), min(picture.shape[:2]) / 8))


def mixed(picture: UInt8Array, blurred: UInt8Array, covered: BoolArray) -> UInt8Array:
    """Blend a picture with its blurred copy, which shows in the squares of `covered`, (rows, columns).

    The blend is linear between the middles of neighbouring squares, since sharp borders would be new features.
    """
    height, width = picture.shape[:2]
    share = cv2.resize(covered.astype(np.float32), (width, height), interpolation=cv2.INTER_LINEAR)[..., None]
    return np.asarray(np.round(picture * (1 - share) + blurred * share), np.uint8)


def _cosines(model: Model, pictures: Sequence[UInt8Array], view: View, other: Float32Array) -> Float32Array:
    """Return each part's cosine of each picture, (B, n)."""
    batch = np.stack([model.normalise(picture) for picture in pictures])
    return scoring.part_cosines(other, model.descriptors(batch, view))
