"""The queue before the network, with a model that computes only when it is told to: no test looks at a clock."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

import numpy as np
import pytest

from explorer.compute import inference_scheduler
from explorer.compute.background_jobs import WorkCancelledError
from explorer.compute.cache import SingleFlightCache
from explorer.compute.inference_scheduler import KEPT, ROOM, TURN, BusyError, InferenceScheduler
from explorer.compute.request_context import STALE, QueuedModel, RequestContext
from explorer.compute.worker import Worker
from lpn.core.arrays import Float32Array
from lpn.core.errors import InputError, LPNError, ModelFileError
from lpn.core.views import View
from lpn.models.base import ForwardPass, Heads, Model
from lpn.models.spec import ModelSpec

SPEC = ModelSpec(views=("satellite", "drone"), n_parts=2, embedding=3, input_size=(4, 4))


class Slow(Model):
    """Answers with the mean of each picture, one pass each time it is let; `passes` has the marks of each pass's pictures."""

    def __init__(self, held: bool = True) -> None:
        self.spec, self.fingerprint = SPEC, "slow"
        self.passes: list[list[int]] = []
        self.viewed: list[View] = []
        self.read = 0
        self._lets = threading.Semaphore(0)
        self._began = threading.Semaphore(0)
        self._held = held

    def run(self, images: Float32Array, view: View) -> ForwardPass:
        """One pass; a picture of mark 13 is one that cannot be computed, one of mark 14 would end the thread."""
        marks = [round(float(image.flat[0])) for image in images]
        self.passes.append(marks)
        self.viewed.append(view)
        self._began.release()
        if self._held:
            assert self._lets.acquire(timeout=20)
        if 13 in marks:
            raise ModelFileError("It cannot be computed.")
        if 14 in marks:
            raise SystemExit
        parts = np.repeat(images.mean(axis=(1, 2, 3))[:, None, None], 6, axis=1).reshape(-1, 2, 3)
        return ForwardPass(parts, images[:, :1] * 2, None)

    def began(self) -> None:
        """Wait until the next pass has begun."""
        assert self._began.acquire(timeout=20)

    def let(self, passes: int = 1) -> None:
        """Let passes end."""
        self._lets.release(passes)

    def heads(self, view: View) -> Heads:
        """Anything."""
        self.check_view(view)
        self.read += 1
        return Heads(*(np.zeros(1, np.float32),) * 3)

    def map_size(self, view: View) -> tuple[int, int]:  # noqa: ARG002
        """Anything."""
        return (4, 4)


def pictures(mark: int, count: int = 1) -> Float32Array:
    return np.full((count, 3, 4, 4), mark, np.float32)


class Asking(threading.Thread):
    """One thread that asks once."""

    def __init__(self, model: QueuedModel | None, mark: int, count: int = 1, view: View = "drone") -> None:
        super().__init__(daemon=True)
        assert model is not None
        self._model, self._images, self._view = model, pictures(mark, count), view
        self.found: ForwardPass | None = None
        self.error: Exception | None = None
        self.start()

    def run(self) -> None:
        try:
            self.found = self._model.run(self._images, self._view)
        except Exception as error:
            self.error = error

    def ended(self) -> Asking:
        self.join(20)
        assert not self.is_alive()
        return self


def until(true: Callable[[], bool]) -> None:
    deadline = time.monotonic() + 20
    while not true():
        assert time.monotonic() < deadline
        time.sleep(0.002)


@pytest.fixture
def slow() -> Slow:
    return Slow()


def shared(slow: Slow, queue: InferenceScheduler, patient: bool = False) -> QueuedModel:
    return QueuedModel(slow, queue, RequestContext(queue), patient)


def held_up(slow: Slow, queue: InferenceScheduler, mark: int = 99) -> Asking:
    """A pass that has begun and does not end, so that what comes now waits."""
    first = Asking(shared(slow, queue), mark)
    slow.began()
    return first


def in_line(queue: InferenceScheduler, *asking: Callable[[], Asking]) -> list[Asking]:
    """Threads that ask one after the other."""
    begun = []
    for one in asking:
        before = queue.waiting
        begun.append(one())
        until(lambda before=before: queue.waiting > before)  # type: ignore[misc]
    return begun


def test_what_waits_is_one_pass_and_each_gets_its_own_rows(slow: Slow) -> None:
    queue = InferenceScheduler()
    first = held_up(slow, queue)
    waiting = in_line(queue, *(lambda mark=mark: Asking(shared(slow, queue), mark, 2) for mark in (1, 2, 3)))
    slow.let(3)
    for mark, one in enumerate(waiting, 1):
        found = one.ended().found
        assert found is not None
        np.testing.assert_array_equal(found.parts, np.full((2, 2, 3), mark))
        np.testing.assert_array_equal(found.features, np.full((2, 1, 4, 4), 2 * mark))
        assert found.features.base is None, "a view would keep the whole batch"
    first.ended()
    assert slow.passes == [[99], [1, 1, 2, 2], [3, 3]]


def test_views_sizes_and_models_are_not_mixed_and_the_oldest_goes_first(slow: Slow) -> None:
    queue, other = InferenceScheduler(), Slow(held=False)
    first = held_up(slow, queue)
    waiting = in_line(
        queue,
        lambda: Asking(shared(slow, queue), 1),
        lambda: Asking(shared(slow, queue), 2, view="satellite"),
        lambda: Asking(shared(other, queue), 3),
        lambda: Asking(shared(slow, queue), 4),
    )
    slow.let(10)
    for one in (first, *waiting):
        assert one.ended().error is None
    assert slow.passes == [[99], [1, 4], [2]]
    assert slow.viewed == ["drone", "drone", "satellite"]
    assert other.passes == [[3]]


def test_more_pictures_than_a_pass_has_are_several(slow: Slow) -> None:
    slow._held = False
    images = np.concatenate([pictures(mark) for mark in range(10)])
    found = shared(slow, InferenceScheduler()).run(images, "drone")
    assert [len(marks) for marks in slow.passes] == [4, 4, 2]
    np.testing.assert_array_equal(found.parts[:, 0, 0], np.arange(10))
    assert found.attention is None


def test_what_is_wrong_with_one_is_not_wrong_with_the_others(slow: Slow) -> None:
    queue = InferenceScheduler()
    first = held_up(slow, queue)
    waiting = in_line(queue, *(lambda mark=mark: Asking(shared(slow, queue), mark) for mark in (1, 13, 2)))
    slow.let(10)
    one, bad, other = (asking.ended() for asking in waiting)
    assert isinstance(bad.error, ModelFileError)
    assert bad.found is None
    for good in (one, other, first.ended()):
        assert good.error is None
        assert good.found is not None
    assert slow.passes == [[99], [1, 13, 2], [1], [13], [2]]
    assert Asking(shared(slow, queue), 5).ended().found is not None, "it goes on"


def test_wrong_input_is_said_as_the_model_says_it(slow: Slow) -> None:
    slow._held = False
    model = shared(slow, InferenceScheduler())
    with pytest.raises(InputError, match="no 'street' view"):
        model.descriptors(pictures(1), "street")
    with pytest.raises(InputError, match="expected float32"):
        model.descriptors(np.zeros((2, 2)), "drone")
    assert model.describe() == slow.describe()
    assert model.descriptors(pictures(1), "drone").shape == (1, 2, 3)


class Clock:
    """Seconds as a test says."""

    now = 0.0

    def __call__(self) -> float:
        return self.now


class Round:
    """Browsers that ask again as soon as they are answered, and how many passes each had between."""

    def __init__(self, slow: Slow, queue: InferenceScheduler, answers: int, long: int, room: int = ROOM) -> None:
        self._slow, self._queue, self._room = slow, queue, room
        self._going = True
        self._threads = [
            threading.Thread(target=self._ask, args=(shared(slow, queue, mark >= answers), mark), daemon=True)
            for mark in range(answers + long)
        ]
        self.count = answers + long

    def run(self, passes: int) -> list[list[int]]:
        """The marks of so many passes, before each of which everybody else waits."""
        first = held_up(self._slow, self._queue)
        for thread in self._threads:
            thread.start()
        for _ in range(passes):
            going = self._slow.passes[-1]
            others = self.count if going == [99] else self.count - len(going)
            until(lambda others=others: self._all_wait(others))  # type: ignore[misc]
            self._slow.let()
            self._slow.began()
        self._going = False
        self._slow.let(1000)
        for thread in self._threads:
            thread.join(20)
        first.ended()
        return self._slow.passes[1 : passes + 1]

    def _all_wait(self, others: int) -> bool:
        """Whether all others wait, or have been refused where there is no room."""
        waiting = min(others, self._room)
        return self._queue.waiting == waiting and len(self._queue._refused) == others - waiting

    def _ask(self, model: QueuedModel, mark: int) -> None:
        while self._going:
            try:
                model.run(pictures(mark), "drone")
            except BusyError:
                time.sleep(0.001)


def test_nobody_is_answered_twice_while_another_waits(slow: Slow) -> None:
    slow.batch = 2
    passes = Round(slow, InferenceScheduler(), answers=7, long=0).run(42)
    turns = [mark for marks in passes for mark in marks]
    for mark in range(7):
        places = [place for place, of in enumerate(turns) if of == mark]
        # Those of one pass ask again in any order, so by one more or less.
        assert np.diff(places).max() <= 7 + 1
        assert len(places) >= len(turns) // 7 - 1


def test_more_browsers_than_there_is_room_for_are_answered_in_turn(slow: Slow) -> None:
    slow.batch = 1
    passes = Round(slow, InferenceScheduler(3, Clock()), answers=7, long=0, room=3).run(42)
    turns = [marks[0] for marks in passes]
    for mark in range(7):
        assert np.diff([place for place, of in enumerate(turns) if of == mark]).max() <= 7 + 1
        assert turns.count(mark) >= 5


def test_long_work_neither_holds_up_answers_nor_waits_for_ever(slow: Slow) -> None:
    slow.batch = 1
    passes = [marks[0] for marks in Round(slow, InferenceScheduler(), answers=3, long=4).run(32)]
    long = [mark >= 3 for mark in passes]
    assert np.diff(np.flatnonzero(long)).tolist() == [TURN] * (sum(long) - 1)
    assert sum(long) == 8
    assert {mark for mark in passes if mark >= 3} == {3, 4, 5, 6}, "each of it"
    for mark in range(3):
        assert np.diff([place for place, of in enumerate(passes) if of == mark]).max() <= 3 + 1


def test_alone_long_work_has_every_pass(slow: Slow) -> None:
    slow.batch = 4
    passes = Round(slow, InferenceScheduler(), answers=0, long=3).run(6)
    assert all(len(marks) >= 1 for marks in passes)
    assert set(np.concatenate(passes).tolist()) == {0, 1, 2}


def test_a_full_queue_refuses_in_one_sentence_and_keeps_the_place(slow: Slow) -> None:
    clock = Clock()
    queue = InferenceScheduler(room=2, clock=clock)
    slow.batch = 1
    first = held_up(slow, queue)
    waiting = in_line(queue, *(lambda mark=mark: Asking(shared(slow, queue), mark) for mark in (1, 2)))
    refused, newcomer = shared(slow, queue), shared(slow, queue)
    with pytest.raises(BusyError, match=r"^2 answers are waited for already, and no more are taken; ask again"):
        refused.run(pictures(3), "drone")
    slow.let()
    slow.began()  # one place is free, and it is kept
    with pytest.raises(BusyError):
        newcomer.run(pictures(4), "drone")
    waiting += in_line(queue, lambda: Asking(refused, 3))
    clock.now += KEPT + 1
    with pytest.raises(BusyError):
        newcomer.run(pictures(4), "drone")
    slow.let()
    slow.began()
    clock.now += KEPT + 1  # who was refused does not come again
    waiting += in_line(queue, lambda: Asking(shared(slow, queue), 5))
    slow.let(10)
    for one in (first, *waiting):
        assert one.ended().error is None
    assert slow.passes == [[99], [1], [2], [3], [5]]


def test_long_work_is_never_refused_and_takes_nobodys_room(slow: Slow) -> None:
    queue = InferenceScheduler(room=1)
    first = held_up(slow, queue)
    waiting = in_line(queue, *(lambda: Asking(shared(slow, queue, patient=True), 1) for _ in range(5)))
    waiting += in_line(queue, lambda: Asking(shared(slow, queue), 2))
    slow.let(10)
    for one in (first, *waiting):
        assert one.ended().error is None
    assert slow.passes[:2] == [[99], [2]]


def test_what_a_browser_that_left_waits_for_is_not_computed(slow: Slow) -> None:
    queue = InferenceScheduler()
    first = held_up(slow, queue)
    gone = RequestContext(queue)
    answers, long = (gone.of(shared(slow, queue), patient) for patient in (False, True))
    dropped = in_line(queue, lambda: Asking(answers, 1), lambda: Asking(long, 2))
    stays = in_line(queue, lambda: Asking(shared(slow, queue), 3))
    gone.leave()
    for one in dropped:
        assert isinstance(one.ended().error, WorkCancelledError)
    assert queue.waiting == 1
    assert isinstance(Asking(answers, 4).ended().error, WorkCancelledError)
    slow.let(10)
    for one in (first, *stays):
        assert one.ended().error is None
    assert slow.passes == [[99], [3]]
    gone.leave()


def test_a_browser_that_leaves_during_its_pass_frees_the_place_that_was_kept(slow: Slow) -> None:
    queue = InferenceScheduler(room=1)
    going = RequestContext(queue)
    model = going.of(shared(slow, queue))
    pending = Asking(model, 1)
    slow.began()
    waiting = in_line(queue, lambda: Asking(shared(slow, queue), 2))
    other = RequestContext(queue)
    with pytest.raises(BusyError):
        other.of(model).run(pictures(3), "drone")  # type: ignore[union-attr]
    other.leave()
    going.leave()
    slow.let()
    slow.began()
    waiting += in_line(queue, lambda: Asking(shared(slow, queue), 4))
    slow.let(10)
    assert pending.ended().found is not None, "it was being computed"
    for one in waiting:
        assert one.ended().error is None


def test_heads_are_read_once_of_each_model(slow: Slow) -> None:
    queue = InferenceScheduler()
    one, other = shared(slow, queue), shared(slow, queue)
    assert one.heads("drone") is other.heads("drone")
    assert slow.read == 1
    assert shared(Slow(), queue).heads("drone") is not one.heads("drone")
    with pytest.raises(InputError, match="street"):
        one.heads("street")
    assert RequestContext(queue).of(None) is None


def test_the_thread_ends_when_nobody_asks_and_begins_anew(slow: Slow, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(inference_scheduler, "IDLE", 0.01)
    slow._held = False
    queue = InferenceScheduler()
    for mark in (1, 2):
        assert Asking(shared(slow, queue), mark).ended().found is not None
        until(lambda: queue._thread is None)
    assert slow.passes == [[1], [2]]


class Dragging(threading.Thread):
    """A browser that wants one answer, of two passes: of its state alone, and one that others may wait for, too."""

    def __init__(self, slow: Slow, queue: InferenceScheduler, mark: int) -> None:
        super().__init__(daemon=True)
        self.mark, self.asker = mark, RequestContext(queue)
        self.begun = self.shown = 0
        self.error: Exception | None = None
        model = self.asker.of(shared(slow, queue))
        assert model is not None
        self._model = model
        self.start()

    def moves(self, mark: int) -> None:
        """Its state changes."""
        self.mark = mark
        self.asker.moved()

    def run(self) -> None:
        try:
            self.shown = self.asker.newest(self._answer)
        except Exception as error:
            self.error = error

    def _answer(self) -> int:
        self.begun, mark = self.begun + 1, self.mark
        if mark == 0:
            raise ModelFileError("There is no such picture.")
        self._model.replaceable().run(pictures(mark), "drone")
        self._model.run(pictures(100 + mark), "drone")
        return mark


def dragged(slow: Slow, queue: InferenceScheduler, *marks: int) -> list[Dragging]:
    begun: list[Dragging] = []
    for mark in marks:
        begun.append(Dragging(slow, queue, mark))
        until(lambda: queue.waiting == len(begun))
    return begun


def test_who_moves_on_while_waiting_is_answered_for_the_newest_state_in_the_same_place(slow: Slow) -> None:
    clock = Clock()
    queue, slow.batch = InferenceScheduler(room=3, clock=clock), 1
    first = held_up(slow, queue)
    asking = dragged(slow, queue, 1, 2, 3)
    other, third = asking[1:]
    clock.now += STALE
    other.moves(22)
    slow.let()
    slow.began()  # that of `one`, during which `other` prepares what it wants now
    until(lambda: other.begun == 2 and queue.waiting == 2)
    third.moves(33)
    slow.let()
    slow.began()
    until(lambda: third.begun == 2 and queue.waiting == 2)
    clock.now += STALE
    for dragging in asking:  # what they wait for next is called off for nobody: no answer would ever be shown
        dragging.moves(7)
    slow.let(20)
    for dragging in asking:
        dragging.join(20)
        assert dragging.error is None
    first.ended()
    assert slow.passes[:4] == [[99], [1], [22], [33]]
    assert sorted(slow.passes[4:]) == [[101], [122], [133]]
    assert [dragging.shown for dragging in asking] == [1, 22, 33]


def test_what_has_hardly_waited_is_computed_though_its_browser_moved_on(slow: Slow) -> None:
    queue, slow.batch = InferenceScheduler(clock=Clock()), 1
    first = held_up(slow, queue)
    asking = dragged(slow, queue, 1, 2)
    for dragging in asking:
        dragging.moves(9)
    slow.let(20)
    for dragging in asking:
        dragging.join(20)
    first.ended()
    assert [(dragging.shown, dragging.begun) for dragging in asking] == [(1, 1), (2, 1)]


def test_a_place_that_is_held_is_nobody_elses_and_is_given_back(slow: Slow) -> None:
    clock = Clock()
    queue, slow.batch = InferenceScheduler(room=2, clock=clock), 1
    first = held_up(slow, queue)
    one, other = dragged(slow, queue, 1, 2)
    clock.now += STALE
    other.moves(0)
    slow.let()
    slow.began()
    other.join(20)
    assert isinstance(other.error, ModelFileError)
    assert not queue._held, "it asked for nothing"
    queue._held[other.asker] = 0
    waiting = in_line(queue, lambda: Asking(shared(slow, queue), 4))
    with pytest.raises(BusyError):
        shared(slow, queue).run(pictures(5), "drone")
    other.asker.leave()
    clock.now += KEPT + 1  # until which the one who was refused has a place
    waiting += in_line(queue, lambda: Asking(shared(slow, queue), 6))
    slow.let(20)
    one.join(20)
    for asking in (first, *waiting):
        assert asking.ended().error is None


def test_a_model_that_ends_its_thread_is_an_error_and_the_queue_goes_on(slow: Slow) -> None:
    slow._held = False
    queue = InferenceScheduler()
    assert isinstance(Asking(shared(slow, queue), 14).ended().error, LPNError)
    assert Asking(shared(slow, queue), 1).ended().found is not None


def test_a_queue_that_fails_answers_who_waits_and_begins_anew(slow: Slow, monkeypatch: pytest.MonkeyPatch) -> None:
    queue = InferenceScheduler()
    first = held_up(slow, queue)
    waiting = in_line(queue, *(lambda mark=mark: Asking(shared(slow, queue), mark) for mark in (1, 2)))
    with monkeypatch.context() as patched:
        patched.setattr(queue, "_next", lambda: 1 // 0)
        slow.let()
        for one in waiting:
            assert isinstance(one.ended().error, ZeroDivisionError)
    assert first.ended().error is None
    slow.let()
    assert Asking(shared(slow, queue), 3).ended().found is not None


def test_where_there_can_be_no_more_threads_the_next_one_tries_again(
    slow: Slow, monkeypatch: pytest.MonkeyPatch
) -> None:
    slow._held = False
    queue, ran = InferenceScheduler(), threading.Event()
    worker = Worker(ran.set, lambda _: None)

    def full(_: threading.Thread) -> None:
        raise RuntimeError("can't start new thread")

    with monkeypatch.context() as patched:
        patched.setattr(threading.Thread, "start", full)
        with pytest.raises(RuntimeError):
            shared(slow, queue).run(pictures(1), "drone")
        with pytest.raises(RuntimeError):
            worker.wake()
    assert queue.waiting == 0
    assert Asking(shared(slow, queue), 2).ended().found is not None
    assert slow.passes == [[2]]
    worker.wake()
    assert ran.wait(20)
    worker.stop()


def test_what_several_want_is_made_once_and_the_oldest_is_forgotten() -> None:
    kept: SingleFlightCache[int, object] = SingleFlightCache(2)
    making, go, made, got = threading.Event(), threading.Event(), [], []

    def make() -> object:
        made.append(1)
        making.set()
        assert go.wait(20)
        return object()

    threads = [threading.Thread(target=lambda: got.append(kept.get(1, make))) for _ in range(5)]
    for thread in threads:
        thread.start()
    assert making.wait(20)
    go.set()
    for thread in threads:
        thread.join(20)
    assert len(made) == 1
    assert len(got) == 5
    assert len(set(map(id, got))) == 1
    kept.get(2, object)
    assert kept.get(1, object) is got[0]
    kept.get(3, object)
    assert kept.get(1, object) is got[0]
    assert kept.get(2, lambda: "anew") == "anew"


def test_what_cannot_be_made_for_one_is_made_for_the_next() -> None:
    kept: SingleFlightCache[int, str] = SingleFlightCache(2)
    making, go, got = threading.Event(), threading.Event(), []

    def fail() -> str:
        making.set()
        assert go.wait(20)
        raise WorkCancelledError

    def failing() -> None:
        with pytest.raises(WorkCancelledError):
            kept.get(1, fail)

    threads = [
        threading.Thread(target=failing),
        threading.Thread(target=lambda: got.append(kept.get(1, lambda: "made"))),
    ]
    threads[0].start()
    assert making.wait(20)
    threads[1].start()
    go.set()
    for thread in threads:
        thread.join(20)
    assert got == ["made"]
