"""One queue before the network for all browsers: what waits is computed together, in the order in which it came.

A thread that asks waits for its pass, so it has one in the queue at a time, and the order of coming is a round among all that
ask: nobody waits longer than one pass of everybody else. Long work (profiles, reports, a second model) asks for a pass at a
time, too. Answers go before it, yet one of `TURN` passes is its own. Of answers no more wait than there is room for;
the next are refused, and who was refused is taken before those who come for the first time. Who wants another answer by the
time its turn is next asks for that one in the same place.
"""

from __future__ import annotations

import logging
import threading
import time
from bisect import insort
from collections.abc import Callable, Hashable, Iterable
from itertools import count, pairwise
from typing import TypeVar, cast

import numpy as np

from explorer.jobs import GivenUpError
from lpn.errors import LPNError
from lpn.model import FloatArray, Heads, Model, Pass
from lpn.spec import View

log = logging.getLogger(__name__)

T = TypeVar("T")

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

STALE = 0.2
"""Seconds that an answer must have waited before another is asked for in its place: preparing that one takes time, too."""


class BusyError(LPNError):
    """More answers wait than there is room for."""


class MovedError(Exception):
    """Another answer is wanted in place of the one that was asked for."""


class _Request:
    """Pictures (B, 3, H, W) of one view that wait for their pass."""

    def __init__(
        self, asker: Asker, model: Model, images: FloatArray, view: View, patient: bool, replaceable: bool, since: float
    ) -> None:
        self.asker, self.model, self.images, self.view, self.patient = asker, model, images, view, patient
        self.replaceable, self.since = replaceable, since
        self.place = 0
        """Among the answers, the least first."""
        self.kind: Hashable = (model, view, images.shape[1:], images.dtype)
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

    A pass has at most `Model.batch` pictures, four of an exported model, which is two browsers' pictures with their mirrors:
    a CPU's cores are busy with one picture already, so a larger batch takes longer in proportion, all of it wait for the next
    answers, and the memory of its feature maps. A model in PyTorch says eight, on a GPU 64.

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
        self._places = count()
        self._held: dict[Asker, int] = {}
        """The places of those who were told that another answer is wanted, and have not asked for it yet."""
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

    def ask(
        self,
        asker: Asker,
        model: Model,
        images: FloatArray,
        view: View,
        patient: bool = False,
        replaceable: bool = False,
    ) -> Pass:
        """One pass, waited for.

        Raises:
            BusyError: when too many answers wait.
            MovedError: when it is replaceable, and the asker has moved on.
            GivenUpError: when the asker has left.
        """
        request = _Request(asker, model, images, view, patient, replaceable, self._clock())
        with self._changed:
            if asker.left:
                raise GivenUpError
            if patient:
                self._long.append(request)
            else:
                if asker not in self._held:
                    self._admit(asker)
                    self._held[asker] = next(self._places)
                request.place = self._held.pop(asker)
                insort(self._answers, request, key=lambda one: one.place)
            if self._thread is None:
                try:
                    self._begin()
                except BaseException:  # as when there can be no more threads: this one would wait for ever
                    self._take([request])
                    raise
            self._changed.notify_all()
        return request.wait()

    def drop(self, asker: Asker) -> None:
        """Take out of the queue what an asker waits for; see `Asker.leave`."""
        with self._changed:
            asker.left = True
            self._refused.pop(asker, None)
            self._held.pop(asker, None)
            dropped = [request for request in (*self._answers, *self._long) if request.asker is asker]
            self._take(dropped)
        for request in dropped:
            request.end(error=GivenUpError())

    def free(self, asker: Asker) -> None:
        """Give the place of an asker back that was to ask for another answer."""
        with self._changed:
            self._held.pop(asker, None)

    def _begin(self) -> None:
        thread = threading.Thread(target=self._loop, name="explorer-inference", daemon=True)
        thread.start()
        self._thread = thread

    def _admit(self, asker: Asker) -> None:
        """Raise BusyError unless there is room beside those who were refused before."""
        now = self._clock()
        self._refused = {one: until for one, until in self._refused.items() if until > now}
        before = list(self._refused)
        place = before.index(asker) if asker in self._refused else len(before)
        if place >= self._room - len(self._answers) - len(self._held):
            self._refused[asker] = now + KEPT  # in its old place, where it had one
            raise BusyError(
                f"{len(self._answers)} answers are waited for already, and no more are taken; ask again in a moment."
            )
        self._refused.pop(asker, None)

    def _loop(self) -> None:
        try:
            self._work()
        except BaseException as error:
            log.exception("The queue before the network failed")
            with self._changed:  # nobody would answer these; who asks next begins anew
                lost, self._thread = [*self._answers, *self._long], None
                self._take(lost)
            for request in lost:
                request.end(error=_told(error))

    def _work(self) -> None:
        while True:
            with self._changed:
                while not self._answers and not self._long:
                    if not self._changed.wait(IDLE) and not self._answers and not self._long:
                        self._thread = None
                        return
                batch = self._next()
                moved = self._moved()
            for request in moved:  # what is wanted instead is prepared during the pass
                request.end(error=MovedError())
            _compute(batch)
            del batch  # its pictures would stay until the next

    def _next(self) -> list[_Request]:
        """The oldest request of those whose turn it is, and what can be computed with it."""
        long = not self._answers or (bool(self._long) and self._passed_over >= TURN - 1)
        self._passed_over = self._passed_over + 1 if self._long and not long else 0
        # Never both in a pass: an answer would take as long as both.
        batch = _together(self._long if long else self._answers)
        self._take(batch)
        return batch

    def _moved(self) -> list[_Request]:
        """Those of the next pass of answers that are not wanted as they are, taken out; their places are held."""
        now = self._clock()
        moved = [one for one in _together(self._answers) if one.replaceable and one.asker.calls_off(now - one.since)]
        self._take(moved)
        self._held.update((request.asker, request.place) for request in moved)
        return moved

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
        self._moved = False
        self._once = False
        """Whether what it waits for may be called off: once in an answer, or who moves on and on would never have one."""

    def of(self, model: Shared | None, patient: bool = False) -> Shared | None:
        """A model for this one to ask, None for None.

        Args:
            patient: for long work, which lets answers go before it and is never refused.
        """
        return None if model is None else Shared(model.own, self._inference, self, patient)

    def newest(self, answer: Callable[[], T]) -> T:
        """What `answer` makes of the newest state, which it reads itself; where `moved` is called before the turn of its
        `Shared.replaceable` passes has come, it is called again, in the same place of the queue."""
        self._moved, self._once = False, True
        try:
            try:
                return answer()
            except MovedError:
                return answer()
        finally:
            self._once = False
            self._inference.free(self)

    def moved(self) -> None:
        """It wants another answer than the one that it may be waiting for."""
        self._moved = True

    def calls_off(self, waited: float) -> bool:
        """Whether a pass that has waited some seconds is not wanted any more; true once in an answer."""
        off = self._moved and self._once and waited >= STALE
        self._once = self._once and not off
        return off

    def leave(self) -> None:
        """It is gone: what it waits for is not computed any more, and raises GivenUpError; and so does what it asks later."""
        self._inference.drop(self)


class Shared(Model):
    """A model whose passes wait their turn in a queue; for everything that is not a pass, the model itself.

    Attributes:
        own: the model that computes.
    """

    def __init__(
        self, own: Model, inference: Inference, asker: Asker, patient: bool = False, replaceable: bool = False
    ) -> None:
        self.own, self._inference, self._asker, self._patient = own, inference, asker, patient
        self._replaceable = replaceable
        self.spec, self.fingerprint, self.compute, self.batch = own.spec, own.fingerprint, own.compute, own.batch

    def replaceable(self) -> Shared:
        """The same for passes that are of one state alone: MovedError where another is wanted meanwhile, see `Asker.newest`."""
        return Shared(self.own, self._inference, self._asker, self._patient, replaceable=True)

    def run(self, images: FloatArray, view: View) -> Pass:
        """One pass of pictures (B, 3, H, W), waited for; more pictures than one pass has are several.

        Raises:
            BusyError: when too many answers wait.
            MovedError: see `replaceable`.
            GivenUpError: when who asks has left.
            LPNError: as the model does.
        """
        size = max(self.batch, 1)
        chunks = [images[at : at + size] for at in range(0, len(images), size)] or [images]
        asked = self._asker, self.own
        how = self._patient, self._replaceable
        return _joined([self._inference.ask(*asked, chunk, view, *how) for chunk in chunks])

    def heads(self, view: View) -> Heads:
        """The affine heads and cell weights for exact explanation; InputError where the model has none."""
        return self._inference.heads(self.own, view)

    def map_size(self, view: View) -> tuple[int, int]:
        """(h, w) of the feature map of a picture of the model's input size."""
        return self.own.map_size(view)


def _together(waiting: list[_Request]) -> list[_Request]:
    """The oldest request, and what can be computed with it."""
    batch, size = waiting[:1], len(waiting[0].images) if waiting else 0
    for request in waiting[1:]:
        if request.kind == batch[0].kind and size + len(request.images) <= request.model.batch:
            batch.append(request)
            size += len(request.images)
    return batch


def _told(error: BaseException) -> Exception:
    """An error as it can be raised in the thread that asked, which is not to end by it."""
    return (
        error
        if isinstance(error, Exception)
        else LPNError(f"The network ended with {type(error).__name__}; try again.")
    )


def _compute(batch: list[_Request]) -> None:
    """Run a batch, and hand each request its rows. Where several fail, each is tried alone: what is wrong with one is not
    wrong with the others."""
    first = batch[0]
    try:
        alone = len(batch) == 1
        images = first.images if alone else np.concatenate([request.images for request in batch])
        found = first.model.run(images, first.view)
        rows = [found] if alone else _divided(found, [len(request.images) for request in batch])
    except BaseException as error:  # who asked waits until there is an outcome
        if len(batch) == 1:
            first.end(error=_told(error))
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
