"""One queue before the network for all browsers: what waits is computed together, in the order in which it came.

A thread that asks waits for its pass, so it has one in the queue at a time, and the order of coming is a round among all that
ask: nobody waits longer than one pass of everybody else. Long work (profiles, reports, a second model) asks for a pass at a
time, too. Answers go before it, yet one of `TURN` passes is its own. Of answers no more wait than there is room for;
the next are refused, and who was refused is taken before those who come for the first time.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Hashable, Iterable
from itertools import pairwise
from typing import cast

import numpy as np

from explorer.jobs import GivenUpError
from lpn.errors import LPNError
from lpn.model import FloatArray, Heads, Model, Pass
from lpn.spec import View

ROOM = 32
"""Answers that wait at a time. A large network on two cores takes a tenth of a second for each, so the last waits for three."""
TURN = 4
"""Of so many passes, one is of long work where some waits, however many answers do."""
AGAIN = 0.5
"""Seconds after which who was refused had best ask again."""
KEPT = 4 * AGAIN
"""Seconds for which a place is kept for who was refused, and may come again."""
IDLE = 60.0
"""Seconds without work after which the queue's thread ends; the next request begins one."""


class BusyError(LPNError):
    """More answers wait than there is room for."""


class _Request:
    """Pictures (B, 3, H, W) of one view that wait for their pass."""

    def __init__(self, asker: Asker, model: Model, images: FloatArray, view: View, patient: bool) -> None:
        self.asker, self.model, self.images, self.view, self.patient = asker, model, images, view, patient
        self.kind: Hashable = (model, view, images.shape[1:])
        """Requests of one kind can be computed in one pass."""
        self._ended = threading.Event()
        self._found: Pass | None = None
        self._error: Exception | None = None

    def end(self, found: Pass | None = None, error: Exception | None = None) -> None:
        """Hand over the outcome."""
        self._found, self._error = found, error
        self._ended.set()

    def wait(self) -> Pass:
        """The outcome, waited for; raises what went wrong."""
        self._ended.wait()
        if self._error is not None:
            raise self._error
        assert self._found is not None
        return self._found


class Inference:
    """The queue, and the one thread that computes what waits in it.

    A pass has at most `Model.batch` pictures, four on a CPU, which is two browsers' pictures with their mirrors: its cores are
    busy with one picture already, so a larger batch takes longer in proportion, all of it wait for the next answers, and the
    memory of its feature maps. A model on a GPU says a larger number.

    Args:
        room: answers that wait at a time.
        clock: seconds from any beginning.
    """

    def __init__(self, room: int = ROOM, clock: Callable[[], float] = time.monotonic) -> None:
        self._room, self._clock = room, clock
        self._changed = threading.Condition()
        self._answers: list[_Request] = []
        self._long: list[_Request] = []
        self._passed_over = 0
        """Passes since long work had its turn, while some waits."""
        self._refused: dict[Asker, float] = {}
        """Who was refused, the first first, and until when a place is kept."""
        self._thread: threading.Thread | None = None
        self._heads: dict[tuple[Model, View], Heads] = {}
        self._heads_lock = threading.Lock()

    @property
    def waiting(self) -> int:
        """Requests that are in the queue, without those that are being computed."""
        with self._changed:
            return len(self._answers) + len(self._long)

    def heads(self, model: Model, view: View) -> Heads:
        """A model's heads, read once: some models make them anew, of many megabytes, whenever they are asked."""
        with self._heads_lock:
            key = model, view
            if key not in self._heads:
                self._heads[key] = model.heads(view)
            return self._heads[key]

    def ask(self, asker: Asker, model: Model, images: FloatArray, view: View, patient: bool) -> Pass:
        """One pass, waited for.

        Raises:
            BusyError: when too many answers wait.
            GivenUpError: when the asker has left.
        """
        request = _Request(asker, model, images, view, patient)
        with self._changed:
            if asker.left:
                raise GivenUpError
            if patient:
                self._long.append(request)
            else:
                self._admit(asker)
                self._answers.append(request)
            if self._thread is None:
                self._thread = threading.Thread(target=self._loop, name="explorer-inference", daemon=True)
                self._thread.start()
            self._changed.notify_all()
        return request.wait()

    def drop(self, asker: Asker) -> None:
        """Take out of the queue what an asker waits for; see `Asker.leave`."""
        with self._changed:
            asker.left = True
            self._refused.pop(asker, None)
            dropped = [request for request in (*self._answers, *self._long) if request.asker is asker]
            self._take(dropped)
        for request in dropped:
            request.end(error=GivenUpError())

    def _admit(self, asker: Asker) -> None:
        """Raise BusyError unless there is room beside those who were refused before."""
        now = self._clock()
        self._refused = {one: until for one, until in self._refused.items() if until > now}
        before = list(self._refused)
        place = before.index(asker) if asker in self._refused else len(before)
        if place >= self._room - len(self._answers):
            self._refused[asker] = now + KEPT  # in its old place, where it had one
            raise BusyError(
                f"{len(self._answers)} answers are waited for already, and no more are taken; ask again in a moment."
            )
        self._refused.pop(asker, None)

    def _loop(self) -> None:
        while True:
            with self._changed:
                while not self._answers and not self._long:
                    if not self._changed.wait(IDLE) and not self._answers and not self._long:
                        self._thread = None
                        return
                batch = self._next()
            _compute(batch)
            del batch  # its pictures would stay until the next

    def _next(self) -> list[_Request]:
        """The oldest request of those whose turn it is, and what can be computed with it."""
        long = not self._answers or (bool(self._long) and self._passed_over >= TURN - 1)
        self._passed_over = self._passed_over + 1 if self._long and not long else 0
        waiting = self._long if long else self._answers  # never both in a pass: an answer would take as long as both
        first = waiting[0]
        batch, size = [first], len(first.images)
        for request in waiting:
            fits = request.kind == first.kind and size + len(request.images) <= first.model.batch
            if fits and request is not first:
                batch.append(request)
                size += len(request.images)
        self._take(batch)
        return batch

    def _take(self, requests: Iterable[_Request]) -> None:
        for request in requests:
            (self._long if request.patient else self._answers).remove(request)


class Asker:
    """One who asks, such as a browser; what it asks for is dropped when it leaves.

    Attributes:
        left: whether it is gone.
    """

    def __init__(self, inference: Inference) -> None:
        self._inference = inference
        self.left = False

    def of(self, model: Shared | None, patient: bool = False) -> Shared | None:
        """A model for this one to ask, None for None.

        Args:
            patient: for long work, which lets answers go before it and is never refused.
        """
        return None if model is None else Shared(model.own, self._inference, self, patient)

    def leave(self) -> None:
        """It is gone: what it waits for is not computed any more, and raises GivenUpError; and so does what it asks later."""
        self._inference.drop(self)


class Shared(Model):
    """A model whose passes wait their turn in a queue; for everything that is not a pass, the model itself.

    Attributes:
        own: the model that computes.
    """

    def __init__(self, own: Model, inference: Inference, asker: Asker, patient: bool = False) -> None:
        self.own, self._inference, self._asker, self._patient = own, inference, asker, patient
        self.spec, self.fingerprint, self.compute, self.batch = own.spec, own.fingerprint, own.compute, own.batch

    def run(self, images: FloatArray, view: View) -> Pass:
        """One pass of pictures (B, 3, H, W), waited for; more pictures than one pass has are several.

        Raises:
            BusyError: when too many answers wait.
            GivenUpError: when who asks has left.
            LPNError: as the model does.
        """
        size = max(self.batch, 1)
        chunks = [images[at : at + size] for at in range(0, len(images), size)] or [images]
        return _joined([self._inference.ask(self._asker, self.own, chunk, view, self._patient) for chunk in chunks])

    def heads(self, view: View) -> Heads:
        """The affine heads and cell weights for exact explanation; InputError where the model has none."""
        return self._inference.heads(self.own, view)

    def map_size(self, view: View) -> tuple[int, int]:
        """(h, w) of the feature map of a picture of the model's input size."""
        return self.own.map_size(view)


def _compute(batch: list[_Request]) -> None:
    """Run a batch, and hand each request its rows. Where several fail, each is tried alone: what is wrong with one is not
    wrong with the others."""
    first = batch[0]
    try:
        alone = len(batch) == 1
        images = first.images if alone else np.concatenate([request.images for request in batch])
        found = first.model.run(images, first.view)
        rows = [found] if alone else _divided(found, [len(request.images) for request in batch])
    except Exception as error:
        if len(batch) == 1:
            first.end(error=error)
        else:
            for request in batch:
                _compute([request])
        return
    for request, own in zip(batch, rows, strict=True):
        request.end(own)


def _divided(found: Pass, sizes: list[int]) -> list[Pass]:
    """Each request's rows, copied: a row that is kept would keep the whole batch."""
    ends = np.cumsum([0, *sizes])
    return [
        Pass(*(None if array is None else array[begin:end].copy() for array in found))  # type: ignore[arg-type]
        for begin, end in pairwise(ends)
    ]


def _joined(passes: list[Pass]) -> Pass:
    if len(passes) == 1:
        return passes[0]
    columns = zip(*passes, strict=True)
    parts, features, attention = (
        None if c[0] is None else np.concatenate(cast("list[FloatArray]", c)) for c in columns
    )
    return Pass(cast(FloatArray, parts), cast(FloatArray, features), attention)
