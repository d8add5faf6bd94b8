"""The ranking of all queries of a task where that takes long: in steps that can be gone on with, and kept between runs.

    <cache>/rankings/<key>.npz     first, true, false (Q,) int64, precision (Q,) float64, gallery: see `metrics.Retrieval`

The key is of both sides' descriptors and of what counts as a true match, so that nothing old is ever found under it. A file
that cannot be read, or that is of other numbers of pictures, is as good as none.
"""

from __future__ import annotations

import hashlib
import io
import logging
import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from tokenize import TokenError
from zipfile import BadZipFile

import numpy as np

from lpn.core.arrays import Float32Array, Int64Array
from lpn.core.errors import OutputError
from lpn.core.files import write_atomic
from lpn.datasets import Truth
from lpn.descriptors import cache_folder
from lpn.retrieval import metrics
from lpn.retrieval.metrics import Retrieval
from lpn.retrieval.ranks import Ranked

log = logging.getLogger(__name__)

FORMAT = "lpn-ranking/1"
STEP = 4096
"""Queries that are ranked at a time; what is given up is at most the step that is being done."""
_COLUMNS = ("first", "true", "false", "precision")


@dataclass(frozen=True, eq=False)
class Sides:
    """What is ranked.

    Attributes:
        asked, tiles: descriptors of queries and gallery, (Q, n, D) and (G, n, D).
        query_labels, labels: the place each shows, (Q,) and (G,), -1 for junk.
        truth: for each query its true matches and its junk, in place of labels.
        identity: a text that only these descriptors have; empty where nobody can say, and then nothing is kept.
    """

    asked: Float32Array
    tiles: Float32Array
    query_labels: Int64Array
    labels: Int64Array
    truth: Sequence[Truth] | None = None
    identity: str = ""

    @property
    def work(self) -> int:
        """Multiplications that it takes."""
        return self.asked.size * len(self.tiles)

    @property
    def file(self) -> Path | None:
        """Where the ranking is kept, None where it is not."""
        if not self.identity:
            return None
        try:
            folder = cache_folder() / "rankings"
        except OutputError:  # there is no place for a cache
            return None
        digest = hashlib.sha256(f"{FORMAT} {self.identity}".encode())
        for values in (self.query_labels, self.labels):
            digest.update(np.ascontiguousarray(values, np.int64).tobytes() + b"|")
        for of in self.truth or ():
            digest.update(of.good.astype(np.int64).tobytes() + b"/" + of.junk.astype(np.int64).tobytes() + b"|")
        return folder / f"{digest.hexdigest()[:24]}.npz"


@dataclass(eq=False)
class Progressing:
    """A ranking that may be stopped and gone on with; for one thread at a time."""

    sides: Sides
    _done: list[Ranked] = field(default_factory=list)

    def finish(self, progress: Callable[[int, int], None]) -> Retrieval:
        """Rank what is not ranked yet.

        Args:
            progress: told how many queries are done, and of how many; what it raises ends the work until it is gone on with.

        Raises:
            InputError: as for `metrics.retrieve`.
        """
        sides, total = self.sides, len(self.sides.asked)
        while (done := sum(len(part.first) for part in self._done)) < total:
            progress(done, total)
            rows = slice(done, done + STEP)
            truth = None if sides.truth is None else sides.truth[rows]

            def told(count: int, _: int, before: int = done) -> None:
                progress(before + count, total)

            self._done.append(
                metrics.retrieve(
                    sides.asked[rows], sides.query_labels[rows], sides.tiles, sides.labels, truth, progress=told
                )
            )
        return metrics.joined(self._done, len(sides.tiles))


def keep(sides: Sides, found: Retrieval) -> None:
    """Keep a ranking for the next time; a cache that cannot be written to is no more than a warning."""
    file = sides.file
    if file is None:
        return
    data = io.BytesIO()
    np.savez(data, gallery=found.gallery, **{name: getattr(found, name) for name in _COLUMNS})
    try:
        write_atomic(file, data.getvalue())
    except OutputError as error:
        log.warning("The ranking is not kept for the next time: %s", error)


def kept(sides: Sides) -> Retrieval | None:
    """The ranking of another time, or None where there is none that can be used."""
    file = sides.file
    if file is None:
        return None
    try:
        with np.load(io.BytesIO(file.read_bytes()), allow_pickle=False) as held:
            columns = [held[name] for name in _COLUMNS]
            gallery = int(held["gallery"])
    except (OSError, ValueError, KeyError, TypeError, EOFError, BadZipFile, zlib.error, NotImplementedError):
        return None
    except (SyntaxError, TokenError, OverflowError, MemoryError, RuntimeError):  # a header that cannot be made sense of
        return None
    if not all(isinstance(column, np.ndarray) for column in columns):
        return None
    queries, tiles = len(sides.asked), len(sides.tiles)
    first, true, false, precision = columns
    positions = (first, true, false)
    whole = all(c.dtype == np.int64 and c.shape == (queries,) and _within(c, -1, tiles - 1) for c in positions)
    shares = precision.dtype == np.float64 and precision.shape == (queries,) and _within(precision, 0, 1)
    return Retrieval(first, true, false, precision, tiles) if whole and shares and gallery == tiles else None


def _within(values: np.ndarray, low: int, high: int) -> bool:
    return bool(((values >= low) & (values <= high)).all())
