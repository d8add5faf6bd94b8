"""The check of a model on pictures: its cells and constants must add up to its parts, as its contract states."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from lpn.core.arrays import UInt8Array
from lpn.core.errors import LPNError
from lpn.core.files import printable
from lpn.core.texts import counted
from lpn.core.views import View, views_of
from lpn.datasets import Dataset
from lpn.drawing import verdicts
from lpn.models.base import Model
from lpn.models.trace import Trace
from lpn.retrieval import describe_picture

# Allowed error of cells and constants, as a share of the part's largest value.
TOLERANCE = 1e-5
# Pictures of each view for the proof.
PICTURES = 4


@dataclass(frozen=True)
class ModelFinding:
    """The check of one view.

    Attributes:
        healthy: True if nothing contradicts the contract.
        error: the largest error of cells and constants as a share of the part's largest value; None without cells, or if another
            fault was found first.
        message: the result in words.
    """

    view: View
    healthy: bool
    error: float | None
    message: str

    @property
    def line(self) -> str:
        """The finding as one line of text."""
        return f"{'OK' if self.healthy else 'problem':8}{self.view}: {self.message}"


def check_model(model: Model, pictures: Mapping[View, Sequence[tuple[str, UInt8Array]]]) -> Iterator[ModelFinding]:
    """Describe pictures in each view of a model, and compare cells and constants with the parts.

    At the level "exact", cell weights, slopes, and constants must also be equal for all pictures.

    Args:
        pictures: names and pictures by view, (H, W, 3) uint8.
    """
    for view in model.views:
        if view in pictures:
            yield _check_view(model, view, pictures[view])


def pictures_of(dataset: Dataset) -> dict[View, list[tuple[str, UInt8Array]]]:
    """Return some pictures of each view of a data set, spread over the lists of its tasks.

    Raises:
        LPNError: if a picture cannot be read, or the data set has no task.
    """
    if not dataset.tasks():
        raise dataset.no_task()
    found: dict[View, list[tuple[str, UInt8Array]]] = {}
    for query, gallery in map(views_of, dataset.tasks()):
        for view, listed in ((gallery, dataset.gallery), (query, dataset.queries)):
            if view not in found:
                pictures = listed(view)
                chosen = np.linspace(0, len(pictures) - 1, min(PICTURES, len(pictures))).round().astype(int)
                found[view] = [(pictures[i].name, pictures[i].load_cropped()) for i in chosen]
    return found


def noise() -> list[tuple[str, UInt8Array]]:
    """Return pictures of coloured squares, for a model without a data set."""
    rng = np.random.default_rng(0)
    squares = [rng.integers(0, 256, (12, 12, 3)).astype(np.uint8) for _ in range(2)]
    return [
        (f"a picture of squares {number}", square.repeat(32, axis=0).repeat(32, axis=1))
        for number, square in enumerate(squares, 1)
    ]


def _check_view(model: Model, view: View, pictures: Sequence[tuple[str, UInt8Array]]) -> ModelFinding:
    contract, names = model.contract, model.contract.names(view)
    worst, without_cells = (0.0, "", ""), set(range(model.n_parts))
    first: Trace | None = None
    on = f"on {counted(len(pictures), 'picture')}"
    # With a single picture, differences between pictures would stay unknown.
    for name, picture in pictures if len(pictures) > 1 else [*pictures, noise()[0]]:
        try:
            trace = describe_picture(model, picture, view).trace
        except LPNError as failure:
            return ModelFinding(view, False, None, printable(str(failure)))
        if trace is None:
            continue
        without_cells &= {part for part in range(model.n_parts) if not trace.cells[:, part].any()}
        errors, first = trace.errors(), first or trace
        part = int(np.argmax(errors))
        worst = max(worst, (float(errors[part]), names[part], printable(name)))
        if contract.level == "exact" and (differing := _differing(trace, first)):
            message = (
                f"The {differing} of {printable(name)} differ from those of {printable(pictures[0][0])}, but by the contract "
                "('exact') they are equal for all pictures; add that quantity to the contract's 'held'."
            )
            return ModelFinding(view, False, None, message)
    if not contract.has_cells:
        message = f"It gives {model.n_parts} x {model.embedding} numbers {on}, and no cells to prove."
        return ModelFinding(view, True, None, message)
    error, of, at = worst
    if not np.isfinite(error):
        message = f"The sum of cells and constants of part {of} is no finite number on {at}; use smaller numbers."
        return ModelFinding(view, False, None, message)
    if error > TOLERANCE:
        message = (
            f"Cells and constants do not add up to part {of}: the error is {error:.1g} of its largest value on {at} (allowed: "
            f"{TOLERANCE:g}). The contract leaves something out, such as a bias, a scale, or a layer that is not linear."
        )
        return ModelFinding(view, False, error, message)
    proof = (
        f"Cells and constants add up to each part {on}, to {error:.1g} of its largest value (allowed: {TOLERANCE:g})."
    )
    lumps = verdicts.describe_lumps([names[part] for part in sorted(without_cells)])
    return ModelFinding(view, True, error, f"{proof} {lumps}".rstrip())


def _differing(trace: Trace, first: Trace) -> str:
    """Return "cells", "slopes", or "constants", the first of them that differs between two pictures; empty if none does."""
    for name in ("cells", "slopes", "constants"):
        actual, expected = getattr(trace, name), getattr(first, name)
        if actual is None and expected is None:
            continue
        largest = max(float(np.abs(expected).max()), 1e-30)
        if actual.shape != expected.shape or float(np.abs(actual - expected).max()) > TOLERANCE * largest:
            return name
    return ""
