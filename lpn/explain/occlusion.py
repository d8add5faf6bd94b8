"""What the score of a pair would be were some of the picture not there: measured by covering it, and so approximate.

It needs only a model's descriptors, so it serves every model; `lpn.explain` accounts for the score exactly where the heads are
affine. Covering makes a picture that no camera took, and cells answer to more of it than the square that is covered.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, cast

import cv2
import numpy as np

from lpn.core import images
from lpn.core.arrays import BoolArray, Float32Array, UInt8Array
from lpn.core.views import View
from lpn.explain import Evidence
from lpn.models.base import Model
from lpn.retrieval import scoring

SQUARES = 8
"""Squares across and down that a picture is divided into."""
_AT_ONCE = 8


def covered(
    model: Model, picture: UInt8Array, view: View, other: Float32Array, rows: int = SQUARES, columns: int = SQUARES
) -> Iterator[tuple[int, Float32Array]]:
    """Cover one square of a picture after the other, and measure what each part's cosine with another picture loses.

    Args:
        picture: (H, W, 3) uint8.
        other: the other picture's descriptor, (n, D).
        rows, columns: squares the picture is divided into, as the network gets it.

    Yields:
        How many squares are done, and the losses so far, (n, rows, columns), NaN where not known yet; a positive number says
        that the square speaks for the pair. Stop whenever it has taken long enough.
    """
    shaped = model.to_input_size(picture, view)
    whole = _cosines(model, [shaped], view, other)[0]
    blurred = blur(shaped)
    losses = np.full((model.n_parts, rows, columns), np.nan, np.float32)
    squares = [(row, column) for row in range(rows) for column in range(columns)]
    for start in range(0, len(squares), _AT_ONCE):
        some = squares[start : start + _AT_ONCE]
        pictures = []
        for square in some:
            mask = np.zeros((rows, columns), bool)
            mask[square] = True
            pictures.append(mixed(shaped, blurred, mask))
        for (row, column), cosines in zip(some, _cosines(model, pictures, view, other), strict=True):
            losses[:, row, column] = whole - cosines
        yield start + len(some), losses


def to_dict(found: Evidence, losses: Float32Array, names: Sequence[str]) -> dict[str, Any]:
    """The losses (n, rows, columns) of a pair as a JSON file has them; they add up to nothing."""
    parts = [
        {
            "name": name,
            "cosine": float(found.cosines[part]),
            "weight": float(found.weights[part]),
            "contribution": float(found.contributions[part]),
            "losses": losses[part].tolist(),
        }
        for part, name in enumerate(names)
    ]
    return {"exact": False, "score": found.score, "distance2": found.distance2, "parts": parts}


def curve(
    model: Model,
    picture: UInt8Array,
    view: View,
    other: Float32Array,
    weights: Float32Array,
    order: Sequence[int],
    size: tuple[int, int],
    steps: int = 10,
    insert: bool = False,
) -> Float32Array:
    """The score as more and more cells of a picture are blurred, or, with `insert`, as they come back in a blurred one.

    Args:
        order: cells in the order they go or come, row by row numbers of `size`.
        size: (h, w) cells that the picture is divided into.
        steps: equal steps from the picture as it is, or wholly blurred, to the other end.

    Returns:
        Scores, (steps + 1,).
    """
    shaped = model.to_input_size(picture, view)
    blurred, pictures = blur(shaped), []
    for step in range(steps + 1):
        gone = np.zeros(size[0] * size[1], bool)
        gone[list(order[: round(step * len(order) / steps)])] = True
        pictures.append(mixed(shaped, blurred, (~gone if insert else gone).reshape(size)))
    return cast(Float32Array, _cosines(model, pictures, view, other) @ weights)


def centre_first(size: tuple[int, int]) -> list[int]:
    """Cells from the middle of a picture outwards: what guessing alone would say of a picture centred on its target."""
    down, across = (np.abs((np.arange(length) + 0.5) / length - 0.5) for length in size)
    return [int(cell) for cell in np.argsort(np.hypot(down[:, None], across).reshape(-1), kind="stable")]


def blur(picture: UInt8Array) -> UInt8Array:
    """A picture without its detail: blurred over an eighth of its shorter side."""
    return cast(UInt8Array, cv2.GaussianBlur(picture, (0, 0), min(picture.shape[:2]) / 8))


def mixed(picture: UInt8Array, blurred: UInt8Array, gone: BoolArray) -> UInt8Array:
    """A picture with its squares (rows, columns) that are gone taken from the blurred one.

    One fades into the other between the middles of neighbours: sharp borders would be something new to see.
    """
    height, width = picture.shape[:2]
    share = cv2.resize(gone.astype(np.float32), (width, height), interpolation=cv2.INTER_LINEAR)[..., None]
    return np.asarray(np.round(picture * (1 - share) + blurred * share), np.uint8)


def _cosines(model: Model, pictures: Sequence[UInt8Array], view: View, other: Float32Array) -> Float32Array:
    """Each part's cosine of each picture, (B, n)."""
    batch = np.stack([images.normalise(picture) for picture in pictures])
    return scoring.part_cosines(other, model.descriptors(batch, view))
