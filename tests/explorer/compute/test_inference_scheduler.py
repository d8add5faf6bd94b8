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
from explorer.compute.inference_scheduler import (
    BACKGROUND_INTERVAL,
    MAX_QUEUED,
    RESERVATION,
    BusyError,
    InferenceScheduler,
)
from explorer.compute.request_context import MIN_WAIT, QueuedModel, RequestContext
from explorer.compute.worker import Worker
from lpn.core.arrays import Float32Array
from lpn.core.errors import InputError, LPNError, ModelFileError
from lpn.core.views import View
from lpn.models.base import ForwardPass, Heads, Model
from lpn.models.spec import ModelSpec

SPEC = ModelSpec(views=("satellite", "drone"), n_parts=2, embedding=3, input_size=(4, 4))


class ManualModel(Model):
    """Answers with the mean of each picture, one pass each time it is let; `passes` has the marks of each pass's pictures."""

    def __init__(self, held: bool = True) -> None:
        self.spec, self.fingerprint = SPEC, "network"
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
            assert self._lets.acquire(timeout=120)
        if 13 in marks:
            raise ModelFileError("It cannot be computed.")
        if 14 in marks:
            raise SystemExit
        parts = np.repeat(images.mean(axis=(1, 2, 3))[:, None, None], 6, axis=1).reshape(-1, 2, 3)
        return ForwardPass(parts, images[:, :1] * 2, None)

    def began(self) -> None:
        """Wait until the next pass has begun."""
        assert self._began.acquire(timeout=120)

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


class Client(threading.Thread):
    """One thread that asks once."""

    def __init__(self, model: QueuedModel | None, mark: int, count: int = 1, view: View = "drone") -> None:
        super().__init__(daemon=True)
        assert model is not None
        self._model, self._images, self._view = model, pictures(mark, count), view
        self.result: ForwardPass | None = None
        self.error: Exception | None = None
        self.start()

    def run(self) -> None:
        try:
            self.result = self._model.run(self._images, self._view)
        except Exception as error:
            self.error = error

    def finished(self) -> Client:
        self.join(120)
        assert not self.is_alive()
        return self


def until(true: Callable[[], bool]) -> None:
    deadline = time.monotonic() + 120
    while not true():
        assert time.monotonic() < deadline
        time.sleep(0.002)


@pytest.fixture
def network() -> ManualModel:
    return ManualModel()


def queued(network: ManualModel, queue: InferenceScheduler, background: bool = False) -> QueuedModel:
    return QueuedModel(network, queue, RequestContext(queue), background)


def occupy(network: ManualModel, queue: InferenceScheduler, mark: int = 99) -> Client:
    """A pass that has begun and does not end, so that what comes now waits."""
    first = Client(queued(network, queue), mark)
    network.began()
    return first


def queue_up(queue: InferenceScheduler, *clients: Callable[[], Client]) -> list[Client]:
    """Threads that ask one after the other."""
    begun = []
    for one in clients:
        before = queue.queue_length
        begun.append(one())
        until(lambda before=before: queue.queue_length > before)  # type: ignore[misc]
    return begun


def test_what_waits_is_one_pass_and_each_gets_its_own_rows(network: ManualModel) -> None:
    queue = InferenceScheduler()
    first = occupy(network, queue)
    waiting = queue_up(queue, *(lambda mark=mark: Client(queued(network, queue), mark, 2) for mark in (1, 2, 3)))
    network.let(3)
    for mark, one in enumerate(waiting, 1):
        found = one.finished().result
        assert found is not None
        np.testing.assert_array_equal(found.parts, np.full((2, 2, 3), mark))
        np.testing.assert_array_equal(found.features, np.full((2, 1, 4, 4), 2 * mark))
        assert found.features.base is None, "a view would keep the whole batch"
    first.finished()
    assert network.passes == [[99], [1, 1, 2, 2], [3, 3]]


def test_views_sizes_and_models_are_not_mixed_and_the_oldest_goes_first(network: ManualModel) -> None:
    queue, other = InferenceScheduler(), ManualModel(held=False)
    first = occupy(network, queue)
    waiting = queue_up(
        queue,
        lambda: Client(queued(network, queue), 1),
        lambda: Client(queued(network, queue), 2, view="satellite"),
        lambda: Client(queued(other, queue), 3),
        lambda: Client(queued(network, queue), 4),
    )
    network.let(10)
    for one in (first, *waiting):
        assert one.finished().error is None
    assert network.passes == [[99], [1, 4], [2]]
    assert network.viewed == ["drone", "drone", "satellite"]
    assert other.passes == [[3]]


def test_more_pictures_than_a_pass_has_are_several(network: ManualModel) -> None:
    network._held = False
    images = np.concatenate([pictures(mark) for mark in range(10)])
    found = queued(network, InferenceScheduler()).run(images, "drone")
    assert [len(marks) for marks in network.passes] == [4, 4, 2]
    np.testing.assert_array_equal(found.parts[:, 0, 0], np.arange(10))
    assert found.attention is None


def test_what_is_wrong_with_one_is_not_wrong_with_the_others(network: ManualModel) -> None:
    queue = InferenceScheduler()
    first = occupy(network, queue)
    waiting = queue_up(queue, *(lambda mark=mark: Client(queued(network, queue), mark) for mark in (1, 13, 2)))
    network.let(10)
    one, bad, other = (clients.finished() for clients in waiting)
    assert isinstance(bad.error, ModelFileError)
    assert bad.result is None
    for good in (one, other, first.finished()):
        assert good.error is None
        assert good.result is not None
    assert network.passes == [[99], [1, 13, 2], [1], [13], [2]]
    assert Client(queued(network, queue), 5).finished().result is not None, "it goes on"


def test_wrong_input_is_said_as_the_model_says_it(network: ManualModel) -> None:
    network._held = False
    model = queued(network, InferenceScheduler())
    with pytest.raises(InputError, match="no 'street' view"):
        model.descriptors(pictures(1), "street")
    with pytest.raises(InputError, match="expected float32"):
        model.descriptors(np.zeros((2, 2)), "drone")
    assert model.describe() == network.describe()
    assert model.descriptors(pictures(1), "drone").shape == (1, 2, 3)


class Clock:
    """Seconds as a test says."""

    now = 0.0

    def __call__(self) -> float:
        return self.now


class RoundRobin:
    """Browsers that ask again as soon as they are answered, and how many passes each had between."""

    def __init__(
        self, network: ManualModel, queue: InferenceScheduler, answers: int, long: int, room: int = MAX_QUEUED
    ) -> None:
        self._slow, self._queue, self._room = network, queue, room
        self._going = True
        self._threads = [
            threading.Thread(target=self._ask, args=(queued(network, queue, mark >= answers), mark), daemon=True)
            for mark in range(answers + long)
        ]
        self.count = answers + long

    def run(self, passes: int) -> list[list[int]]:
        """The marks of so many passes, before each of which everybody else waits."""
        first = occupy(self._slow, self._queue)
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
            thread.join(120)
        first.finished()
        return self._slow.passes[1 : passes + 1]

    def _all_wait(self, others: int) -> bool:
        """Whether all others wait, or have been refused where there is no room."""
        waiting = min(others, self._room)
        return self._queue.queue_length == waiting and len(self._queue._refused) == others - waiting

    def _ask(self, model: QueuedModel, mark: int) -> None:
        while self._going:
            try:
                model.run(pictures(mark), "drone")
            except BusyError:
                time.sleep(0.001)


def test_nobody_is_answered_twice_while_another_waits(network: ManualModel) -> None:
    network.batch = 2
    passes = RoundRobin(network, InferenceScheduler(), answers=7, long=0).run(42)
    turns = [mark for marks in passes for mark in marks]
    for mark in range(7):
        places = [place for place, of in enumerate(turns) if of == mark]
        # Those of one pass ask again in any order, so by one more or less.
        assert np.diff(places).max() <= 7 + 1
        assert len(places) >= len(turns) // 7 - 1


def test_more_browsers_than_there_is_room_for_are_answered_in_turn(network: ManualModel) -> None:
    network.batch = 1
    passes = RoundRobin(network, InferenceScheduler(3, Clock()), answers=7, long=0, room=3).run(42)
    turns = [marks[0] for marks in passes]
    for mark in range(7):
        assert np.diff([place for place, of in enumerate(turns) if of == mark]).max() <= 7 + 1
        assert turns.count(mark) >= 5


def test_long_work_neither_holds_up_answers_nor_waits_for_ever(network: ManualModel) -> None:
    network.batch = 1
    passes = [marks[0] for marks in RoundRobin(network, InferenceScheduler(), answers=3, long=4).run(32)]
    long = [mark >= 3 for mark in passes]
    assert np.diff(np.flatnonzero(long)).tolist() == [BACKGROUND_INTERVAL] * (sum(long) - 1)
    assert sum(long) == 8
    assert {mark for mark in passes if mark >= 3} == {3, 4, 5, 6}, "each of it"
    for mark in range(3):
        assert np.diff([place for place, of in enumerate(passes) if of == mark]).max() <= 3 + 1


def test_alone_long_work_has_every_pass(network: ManualModel) -> None:
    network.batch = 4
    passes = RoundRobin(network, InferenceScheduler(), answers=0, long=3).run(6)
    assert sorted(passes[0]) == [0, 1, 2], "all that wait share a pass"
    assert all(len(set(marks)) == len(marks) for marks in passes), "none is in a pass twice"


def test_a_full_queue_refuses_in_one_sentence_and_keeps_the_place(network: ManualModel) -> None:
    clock = Clock()
    queue = InferenceScheduler(max_queued=2, clock=clock)
    network.batch = 1
    first = occupy(network, queue)
    waiting = queue_up(queue, *(lambda mark=mark: Client(queued(network, queue), mark) for mark in (1, 2)))
    refused, newcomer = queued(network, queue), queued(network, queue)
    with pytest.raises(BusyError, match=r"^2 requests are queued, which is the limit; try again"):
        refused.run(pictures(3), "drone")
    network.let()
    network.began()  # one place is free, and it is kept
    with pytest.raises(BusyError):
        newcomer.run(pictures(4), "drone")
    waiting += queue_up(queue, lambda: Client(refused, 3))
    clock.now += RESERVATION + 1
    with pytest.raises(BusyError):
        newcomer.run(pictures(4), "drone")
    network.let()
    network.began()
    clock.now += RESERVATION + 1  # who was refused does not come again
    waiting += queue_up(queue, lambda: Client(queued(network, queue), 5))
    network.let(10)
    for one in (first, *waiting):
        assert one.finished().error is None
    assert network.passes == [[99], [1], [2], [3], [5]]


def test_long_work_is_never_refused_and_takes_nobodys_room(network: ManualModel) -> None:
    queue = InferenceScheduler(max_queued=1)
    first = occupy(network, queue)
    waiting = queue_up(queue, *(lambda: Client(queued(network, queue, background=True), 1) for _ in range(5)))
    waiting += queue_up(queue, lambda: Client(queued(network, queue), 2))
    network.let(10)
    for one in (first, *waiting):
        assert one.finished().error is None
    assert network.passes[:2] == [[99], [2]]


def test_what_a_browser_that_left_waits_for_is_not_computed(network: ManualModel) -> None:
    queue = InferenceScheduler()
    first = occupy(network, queue)
    gone = RequestContext(queue)
    answers, long = (gone.queued(queued(network, queue), background) for background in (False, True))
    dropped = queue_up(queue, lambda: Client(answers, 1), lambda: Client(long, 2))
    stays = queue_up(queue, lambda: Client(queued(network, queue), 3))
    gone.close()
    for one in dropped:
        assert isinstance(one.finished().error, WorkCancelledError)
    assert queue.queue_length == 1
    assert isinstance(Client(answers, 4).finished().error, WorkCancelledError)
    network.let(10)
    for one in (first, *stays):
        assert one.finished().error is None
    assert network.passes == [[99], [3]]
    gone.close()


def test_a_browser_that_leaves_during_its_pass_frees_the_place_that_was_kept(network: ManualModel) -> None:
    queue = InferenceScheduler(max_queued=1)
    going = RequestContext(queue)
    model = going.queued(queued(network, queue))
    pending = Client(model, 1)
    network.began()
    waiting = queue_up(queue, lambda: Client(queued(network, queue), 2))
    other = RequestContext(queue)
    with pytest.raises(BusyError):
        other.queued(model).run(pictures(3), "drone")  # type: ignore[union-attr]
    other.close()
    going.close()
    network.let()
    network.began()
    waiting += queue_up(queue, lambda: Client(queued(network, queue), 4))
    network.let(10)
    assert pending.finished().result is not None, "it was being computed"
    for one in waiting:
        assert one.finished().error is None


def test_heads_are_read_once_of_each_model(network: ManualModel) -> None:
    queue = InferenceScheduler()
    one, other = queued(network, queue), queued(network, queue)
    assert one.heads("drone") is other.heads("drone")
    assert network.read == 1
    assert queued(ManualModel(), queue).heads("drone") is not one.heads("drone")
    with pytest.raises(InputError, match="street"):
        one.heads("street")
    assert RequestContext(queue).queued(None) is None


def test_the_thread_ends_when_nobody_asks_and_begins_anew(
    network: ManualModel, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(inference_scheduler, "IDLE_TIMEOUT", 0.01)
    network._held = False
    queue = InferenceScheduler()
    for mark in (1, 2):
        assert Client(queued(network, queue), mark).finished().result is not None
        until(lambda: queue._thread is None)
    assert network.passes == [[1], [2]]


class DraggingBrowser(threading.Thread):
    """A browser that wants one answer, of two passes: of its state alone, and one that others may wait for, too."""

    def __init__(self, network: ManualModel, queue: InferenceScheduler, mark: int) -> None:
        super().__init__(daemon=True)
        self.mark, self.context = mark, RequestContext(queue)
        self.begun = self.shown = 0
        self.error: Exception | None = None
        model = self.context.queued(queued(network, queue))
        assert model is not None
        self._model = model
        self.start()

    def moves(self, mark: int) -> None:
        """Its state changes."""
        self.mark = mark
        self.context.supersede()

    def run(self) -> None:
        try:
            self.shown = self.context.compute_newest(self._answer)
        except Exception as error:
            self.error = error

    def _answer(self) -> int:
        self.begun, mark = self.begun + 1, self.mark
        if mark == 0:
            raise ModelFileError("There is no such picture.")
        self._model.cancellable().run(pictures(mark), "drone")
        self._model.run(pictures(100 + mark), "drone")
        return mark


def drag(network: ManualModel, queue: InferenceScheduler, *marks: int) -> list[DraggingBrowser]:
    begun: list[DraggingBrowser] = []
    for mark in marks:
        begun.append(DraggingBrowser(network, queue, mark))
        until(lambda: queue.queue_length == len(begun))
    return begun


def test_who_moves_on_while_waiting_is_answered_for_the_newest_state_in_the_same_place(network: ManualModel) -> None:
    clock = Clock()
    queue, network.batch = InferenceScheduler(max_queued=3, clock=clock), 1
    first = occupy(network, queue)
    clients = drag(network, queue, 1, 2, 3)
    other, third = clients[1:]
    clock.now += MIN_WAIT
    other.moves(22)
    network.let()
    network.began()  # that of `one`, during which `other` prepares what it wants now
    until(lambda: other.begun == 2 and queue.queue_length == 2)
    third.moves(33)
    network.let()
    network.began()
    until(lambda: third.begun == 2 and queue.queue_length == 2)
    clock.now += MIN_WAIT
    for browser in clients:  # what they wait for next is called off for nobody: no answer would ever be shown
        browser.moves(7)
    network.let(20)
    for browser in clients:
        browser.join(120)
        assert browser.error is None
    first.finished()
    assert network.passes[:4] == [[99], [1], [22], [33]]
    assert sorted(network.passes[4:]) == [[101], [122], [133]]
    assert [browser.shown for browser in clients] == [1, 22, 33]


def test_what_has_hardly_waited_is_computed_though_its_browser_moved_on(network: ManualModel) -> None:
    queue, network.batch = InferenceScheduler(clock=Clock()), 1
    first = occupy(network, queue)
    clients = drag(network, queue, 1, 2)
    for browser in clients:
        browser.moves(9)
    network.let(20)
    for browser in clients:
        browser.join(120)
    first.finished()
    assert [(browser.shown, browser.begun) for browser in clients] == [(1, 1), (2, 1)]


def test_a_place_that_is_held_is_nobody_elses_and_is_given_back(network: ManualModel) -> None:
    clock = Clock()
    queue, network.batch = InferenceScheduler(max_queued=2, clock=clock), 1
    first = occupy(network, queue)
    one, other = drag(network, queue, 1, 2)
    clock.now += MIN_WAIT
    other.moves(0)
    network.let()
    network.began()
    other.join(120)
    assert isinstance(other.error, ModelFileError)
    assert not queue._held, "it asked for nothing"
    queue._held[other.context] = 0
    waiting = queue_up(queue, lambda: Client(queued(network, queue), 4))
    with pytest.raises(BusyError):
        queued(network, queue).run(pictures(5), "drone")
    other.context.close()
    clock.now += RESERVATION + 1  # until which the one who was refused has a place
    waiting += queue_up(queue, lambda: Client(queued(network, queue), 6))
    network.let(20)
    one.join(120)
    for clients in (first, *waiting):
        assert clients.finished().error is None


def test_a_model_that_ends_its_thread_is_an_error_and_the_queue_goes_on(network: ManualModel) -> None:
    network._held = False
    queue = InferenceScheduler()
    assert isinstance(Client(queued(network, queue), 14).finished().error, LPNError)
    assert Client(queued(network, queue), 1).finished().result is not None


def test_a_queue_that_fails_answers_who_waits_and_begins_anew(
    network: ManualModel, monkeypatch: pytest.MonkeyPatch
) -> None:
    queue = InferenceScheduler()
    first = occupy(network, queue)
    waiting = queue_up(queue, *(lambda mark=mark: Client(queued(network, queue), mark) for mark in (1, 2)))
    with monkeypatch.context() as patched:
        patched.setattr(queue, "_next_batch", lambda: 1 // 0)
        network.let()
        for one in waiting:
            assert isinstance(one.finished().error, ZeroDivisionError)
    assert first.finished().error is None
    network.let()
    assert Client(queued(network, queue), 3).finished().result is not None


def test_where_there_can_be_no_more_threads_the_next_one_tries_again(
    network: ManualModel, monkeypatch: pytest.MonkeyPatch
) -> None:
    network._held = False
    queue, ran = InferenceScheduler(), threading.Event()
    worker = Worker(ran.set, lambda _: None)

    def full(_: threading.Thread) -> None:
        raise RuntimeError("can't start new thread")

    with monkeypatch.context() as patched:
        patched.setattr(threading.Thread, "start", full)
        with pytest.raises(RuntimeError):
            queued(network, queue).run(pictures(1), "drone")
        with pytest.raises(RuntimeError):
            worker.wake()
    assert queue.queue_length == 0
    assert Client(queued(network, queue), 2).finished().result is not None
    assert network.passes == [[2]]
    worker.wake()
    assert ran.wait(120)
    worker.stop()


def test_what_several_want_is_made_once_and_the_oldest_is_forgotten() -> None:
    cache: SingleFlightCache[int, object] = SingleFlightCache(2)
    making, go, made, got = threading.Event(), threading.Event(), [], []

    def make() -> object:
        made.append(1)
        making.set()
        assert go.wait(120)
        return object()

    threads = [threading.Thread(target=lambda: got.append(cache.get(1, make))) for _ in range(5)]
    for thread in threads:
        thread.start()
    assert making.wait(120)
    go.set()
    for thread in threads:
        thread.join(120)
    assert len(made) == 1
    assert len(got) == 5
    assert len(set(map(id, got))) == 1
    cache.get(2, object)
    assert cache.get(1, object) is got[0]
    cache.get(3, object)
    assert cache.get(1, object) is got[0]
    assert cache.get(2, lambda: "anew") == "anew"


def test_what_cannot_be_made_for_one_is_made_for_the_next() -> None:
    cache: SingleFlightCache[int, str] = SingleFlightCache(2)
    making, go, got = threading.Event(), threading.Event(), []

    def fail() -> str:
        making.set()
        assert go.wait(120)
        raise WorkCancelledError

    def failing() -> None:
        with pytest.raises(WorkCancelledError):
            cache.get(1, fail)

    threads = [
        threading.Thread(target=failing),
        threading.Thread(target=lambda: got.append(cache.get(1, lambda: "made"))),
    ]
    threads[0].start()
    assert making.wait(120)
    threads[1].start()
    go.set()
    for thread in threads:
        thread.join(120)
    assert got == ["made"]
