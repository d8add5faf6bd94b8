"""The curve of one photo: the truth's rank and the nearest distance at each angle, filled in the background."""

from __future__ import annotations

from collections.abc import Callable, Hashable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

from explorer.compute.background_jobs import WorkCancelledError
from explorer.compute.cache import SingleFlightCache
from explorer.compute.worker import Worker
from lpn import retrieval
from lpn.core.arrays import Float32Array, UInt8Array
from lpn.core.errors import LPNError
from lpn.descriptors.transforms import Change
from lpn.library.analyser import KeepDescribed, described_key
from lpn.models.base import Model
from lpn.retrieval import Ranking, scoring
from lpn.tasks.task import Task

# Degrees between two points, and maximum of cached descriptors for all browsers: 24 for a photo, some 8 kB each.
STEP = 15
ANGLES = tuple(range(-180, 180, STEP))
_HELD = 4000

# Descriptors of turned photos, by the photo and the angle.
Descriptors = SingleFlightCache[Hashable, Float32Array]


def held_descriptors() -> Descriptors:
    """Return an empty cache of descriptors of turned photos."""
    return SingleFlightCache(_HELD, budget=_HELD * 65_536, bytes_of=lambda descriptor: descriptor.nbytes)


@dataclass(frozen=True, eq=False)
class Turning:
    """A photo whose curve is wanted.

    Attributes:
        key: identifies photo and model, without angle and part weights.
        source: the photo before it is turned, (H, W, 3) uint8.
        change: other changes of the photo, see `Change.for_picture`.
        index: position among the queries; None for the user's own photo.
        weights: the part weights, (n,); None for equal ones.
        model: describes the photo like the task's pictures, in the background.
        keep: caches described queries, so that a turn to one of the curve's angles needs no forward pass.
    """

    key: Hashable
    task: Task
    source: UInt8Array
    change: Change
    index: int | None
    weights: tuple[float, ...] | None
    model: Model
    keep: KeepDescribed

    def descriptor(self, angle: int) -> Float32Array:
        """Describe the photo turned counter-clockwise by `angle` degrees, (n, D)."""
        change, task = replace(self.change, rotate=float(angle)), self.task
        model = self.model.for_task(*task.views)
        describe = partial(retrieval.describe_picture, model, self.source, task.query_view, change)
        described = describe() if self.index is None else self.keep(described_key(task, self.index, change), describe)
        return described.descriptor

    def point(self, descriptor: Float32Array) -> tuple[int | None, float]:
        """Return the truth's rank, None if it is unknown, and the distance of the nearest tile."""
        weights = scoring.part_weights(self.task.contract.n_parts, self.weights)
        ranking: Ranking = self.task.start_search(self.index, descriptor)(weights)
        truth = ranking.positive()
        return None if truth is None else truth.rank, round(ranking.match(0).distance2, 3)


class Curve:
    """Draws the curve of one tab's newest photo, point by point.

    Args:
        send: hands a message to the page.
        held: the cache that all browsers share.
    """

    def __init__(self, send: Callable[[dict[str, Any]], None], held: Descriptors) -> None:
        self._send, self._held = send, held
        # The photo and its sequence are assigned together, as another thread reads both.
        self._followed: tuple[Turning | None, str] = None, ""
        self._worker = Worker(self._work)

    def follow(self, turning: Turning | None, sequence: str) -> None:
        """Draw the curve of a photo, unless it is being drawn already.

        Args:
            sequence: names the page's photo and weights in the messages.
        """
        before, self._followed = self._followed[0], (turning, sequence)
        if turning is not None and (before is None or (before.key, before.weights) != (turning.key, turning.weights)):
            self._worker.wake()

    def stop(self) -> None:
        """End after the current point."""
        self._followed = None, ""
        self._worker.stop()

    def _work(self) -> None:
        turning, sequence = self._followed
        points: dict[int, tuple[int | None, float]] = {}
        # From the upright photo outwards, as a user turns it.
        for angle in sorted(ANGLES, key=abs):
            newest = self._followed[0]
            if newest is None or turning is None or newest.key != turning.key:
                return
            try:
                descriptor = self._held.get((turning.key, angle), partial(turning.descriptor, angle))
                points[angle] = turning.point(descriptor)
            except (LPNError, WorkCancelledError):  # the answer itself reports a fault of the photo
                return
            if len(points) in (len(ANGLES), len(ANGLES) // 2) or len(points) % 4 == 0:
                self._send({"curve": {"sequence": sequence, "points": [[a, *points[a]] for a in sorted(points)]}})
