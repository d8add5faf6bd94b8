"""The inference scheduler, with a model whose forward passes the tests release one by one."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np
import pytest

from explorer.compute import inference_scheduler
from explorer.compute.background_jobs import WorkCancelledError
from explorer.compute.batching import SupersededError
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
from lpn.models.base import Model
from lpn.models.contract import ForwardPass, Heads
from lpn.models.spec import ModelSpec
from tools.fixtures.waiting import TIMEOUT, n_queued, wait_until

SPEC = ModelSpec(views=("satellite", "drone"), n_parts=2, embedding=3, input_size=(4, 4))


class ManualModel(Model):
    """Returns the mean of each picture; each forward pass waits for `release`.

    Attributes:
        passes: the marks (first values) of the pictures of each forward pass.
    """

    def __init__(self, held: bool = True) -> None:
        self.contract, self.fingerprint = SPEC.contract(), "network"
        self.passes: list[list[int]] = []
        self.viewed: list[View] = []
        self.read = 0
        self._released = threading.Semaphore(0)
        self._began = threading.Semaphore(0)
        self._kept_positions = held

    def run(self, images: Float32Array, view: View) -> ForwardPass:
        """Compute a forward pass. Mark 13 fails; mark 14 would end the thread."""
        marks = [round(float(image.flat[0])) for image in images]
        self.passes.append(marks)
        self.viewed.append(view)
        self._began.release()
        if self._kept_positions:
            assert self._released.acquire(timeout=TIMEOUT)
        if 13 in marks:
            raise ModelFileError("It cannot be computed.")
        if 14 in marks:
            raise SystemExit
        parts = np.repeat(images.mean(axis=(1, 2, 3))[:, None, None], 6, axis=1).reshape(-1, 2, 3)
        return ForwardPass(parts, images[:, :1] * 2)

    def began(self) -> None:
        """Wait until the next forward pass has begun."""
        assert self._began.acquire(timeout=TIMEOUT)

    def release(self, passes: int = 1) -> None:
        """Let forward passes end."""
        self._released.release(passes)

    def heads(self, view: View) -> Heads:
        """Return empty heads, and count the calls."""
        self.check_view(view)
        self.read += 1
        return Heads(*(np.zeros(1, np.float32),) * 3)

    def map_size(self, view: View) -> tuple[int, int]:  # noqa: ARG002
        """Return a fixed size."""
        return (4, 4)


def pictures(mark: int, count: int = 1) -> Float32Array:
    return np.full((count, 3, 4, 4), mark, np.float32)


class Client(threading.Thread):
    """A thread with one request."""

    def __init__(self, model: QueuedModel | None, mark: int, count: int = 1, view: View = "drone") -> None:
        super().__init__(daemon=True)
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
        self.join(TIMEOUT)
        assert not self.is_alive()
        return self


@pytest.fixture
def network() -> Iterator[ManualModel]:
    """A network that computes all waiting requests when the test ends, so that no thread waits for ever."""
    made = ManualModel()
    yield made
    made.release(MAX_QUEUED)


def queued(network: ManualModel, queue: InferenceScheduler, background: bool = False) -> QueuedModel:
    return QueuedModel(network, queue, RequestContext(queue), background)


def occupy(network: ManualModel, queue: InferenceScheduler, mark: int = 99) -> Client:
    """Start a forward pass that does not end, so that further requests wait."""
    first = Client(queued(network, queue), mark)
    network.began()
    return first


def queue_up(queue: InferenceScheduler, *clients: Callable[[], Client]) -> list[Client]:
    """Start clients in succession."""
    begun = []
    for one in clients:
        before = n_queued(queue)
        begun.append(one())
        wait_until(lambda before=before: n_queued(queue) > before)
    return begun


def all_end(network: ManualModel, *clients: Client) -> None:
    """Let all forward passes end, and check that each request of some clients has its result."""
    network.release(20)
    for one in clients:
        assert one.finished().error is None


def test_waiting_requests_share_a_batch_and_get_their_own_rows(network: ManualModel) -> None:
    queue = InferenceScheduler()
    first = occupy(network, queue)
    waiting = queue_up(queue, *(lambda mark=mark: Client(queued(network, queue), mark, 2) for mark in (1, 2, 3)))
    network.release(3)
    for mark, one in enumerate(waiting, 1):
        found = one.finished().result
        np.testing.assert_array_equal(found.parts, np.full((2, 2, 3), mark))
        np.testing.assert_array_equal(found.features, np.full((2, 1, 4, 4), 2 * mark))
        assert found.features.base is None, "a view would keep the whole batch in memory"
    first.finished()
    assert network.passes == [[99], [1, 1, 2, 2], [3, 3]]


def test_a_batch_has_one_view_and_model_and_the_oldest_request_goes_first(network: ManualModel) -> None:
    queue, other = InferenceScheduler(), ManualModel(held=False)
    first = occupy(network, queue)
    waiting = queue_up(
        queue,
        lambda: Client(queued(network, queue), 1),
        lambda: Client(queued(network, queue), 2, view="satellite"),
        lambda: Client(queued(other, queue), 3),
        lambda: Client(queued(network, queue), 4),
    )
    all_end(network, first, *waiting)
    assert network.passes == [[99], [1, 4], [2]]
    assert network.viewed == ["drone", "drone", "satellite"]
    assert other.passes == [[3]]


def test_browsers_of_one_task_share_batches_and_heads_of_branches_by_role(network: ManualModel) -> None:
    network.contract = replace(network.contract, roles="role", groups=())
    queue = InferenceScheduler()
    one, other = (queued(network, queue).for_task("satellite", "drone") for _ in range(2))
    first = occupy(network, queue)
    waiting = queue_up(queue, lambda: Client(one, 1), lambda: Client(other.for_task("satellite", "drone"), 2))
    all_end(network, first, *waiting)
    assert network.passes == [[99], [1, 2]]
    assert one.model.role("satellite") == "query" != network.role("satellite")
    assert one.heads("drone") is other.heads("drone")
    assert queued(network, queue).for_task("drone", "satellite").model is not one.model


def test_a_large_request_is_split_into_batches(network: ManualModel) -> None:
    network._kept_positions = False
    images = np.concatenate([pictures(mark) for mark in range(10)])
    found = queued(network, InferenceScheduler()).run(images, "drone")
    assert [len(marks) for marks in network.passes] == [4, 4, 2]
    np.testing.assert_array_equal(found.parts[:, 0, 0], np.arange(10))
    assert found.cells is None


def test_a_bad_request_does_not_fail_the_others_of_its_batch(network: ManualModel) -> None:
    queue = InferenceScheduler()
    first = occupy(network, queue)
    waiting = queue_up(queue, *(lambda mark=mark: Client(queued(network, queue), mark) for mark in (1, 13, 2)))
    network.release(10)
    one, bad, other = (clients.finished() for clients in waiting)
    assert isinstance(bad.error, ModelFileError)
    assert bad.result is None
    for good in (one, other, first.finished()):
        assert good.error is None
        assert good.result is not None
    assert network.passes == [[99], [1, 13, 2], [1], [13], [2]]
    assert Client(queued(network, queue), 5).finished().result is not None, "it goes on"


def test_wrong_input_raises_the_models_error(network: ManualModel) -> None:
    network._kept_positions = False
    model = queued(network, InferenceScheduler())
    with pytest.raises(InputError, match="no 'street' view"):
        model.descriptors(pictures(1), "street")
    with pytest.raises(InputError, match="expected float32"):
        model.descriptors(np.zeros((2, 2)), "drone")
    assert model.describe() == network.describe()
    assert model.descriptors(pictures(1), "drone").shape == (1, 2, 3)


class Clock:
    """A clock that the test sets."""

    now = 0.0

    def __call__(self) -> float:
        return self.now


class RoundRobin:
    """Clients that make their next request right after an answer.

    The first `interactive` ones are interactive, the others do background work.
    """

    def __init__(self, network: ManualModel, queue: InferenceScheduler, interactive: int, background: int) -> None:
        self._network, self._queue, self._going = network, queue, True
        self._threads = [
            threading.Thread(target=self._ask, args=(queued(network, queue, mark >= interactive), mark), daemon=True)
            for mark in range(interactive + background)
        ]
        self.count = interactive + background

    def run(self, passes: int) -> list[list[int]]:
        """Return the marks of some forward passes; before each, all other clients wait."""
        first = occupy(self._network, self._queue)
        for thread in self._threads:
            thread.start()
        for _ in range(passes):
            going = self._network.passes[-1]
            others = self.count if going == [99] else self.count - len(going)
            wait_until(lambda others=others: n_queued(self._queue) == others)
            self._network.release()
            self._network.began()
        self._going = False
        self._network.release(1000)
        for thread in self._threads:
            thread.join(TIMEOUT)
        first.finished()
        return self._network.passes[1 : passes + 1]

    def _ask(self, model: QueuedModel, mark: int) -> None:
        while self._going:
            model.run(pictures(mark), "drone")


def test_no_client_is_served_twice_while_another_waits(network: ManualModel) -> None:
    network.batch = 2
    passes = RoundRobin(network, InferenceScheduler(), interactive=7, background=0).run(42)
    turns = [mark for marks in passes for mark in marks]
    for mark in range(7):
        places = [place for place, of in enumerate(turns) if of == mark]
        # Clients of one batch make their next requests in any order, so one client may always come last.
        assert np.diff(places).max() <= 7 + 1
        assert len(places) >= len(turns) // (7 + 1)


def test_background_work_neither_delays_answers_nor_starves(network: ManualModel) -> None:
    network.batch = 1
    passes = [marks[0] for marks in RoundRobin(network, InferenceScheduler(), interactive=3, background=4).run(32)]
    long = [mark >= 3 for mark in passes]
    assert np.diff(np.flatnonzero(long)).tolist() == [BACKGROUND_INTERVAL] * (sum(long) - 1)
    assert sum(long) == 8
    assert {mark for mark in passes if mark >= 3} == {3, 4, 5, 6}, "each of it"
    for mark in range(3):
        assert np.diff([place for place, of in enumerate(passes) if of == mark]).max() <= 3 + 1


def test_a_full_queue_refuses_a_request_and_reserves_its_place(network: ManualModel) -> None:
    clock = Clock()
    queue = InferenceScheduler(max_queued=2, clock=clock)
    network.batch = 1
    first = occupy(network, queue)
    waiting = queue_up(queue, *(lambda mark=mark: Client(queued(network, queue), mark) for mark in (1, 2)))
    refused, newcomer = queued(network, queue), queued(network, queue)
    with pytest.raises(BusyError, match=r"^2 requests are queued, which is the limit; try again"):
        refused.run(pictures(3), "drone")
    network.release()
    network.began()  # one place is free, and reserved
    with pytest.raises(BusyError):
        newcomer.run(pictures(4), "drone")
    waiting += queue_up(queue, lambda: Client(refused, 3))
    clock.now += RESERVATION + 1
    with pytest.raises(BusyError):
        newcomer.run(pictures(4), "drone")
    network.release()
    network.began()
    clock.now += RESERVATION + 1  # the refused client does not try again
    waiting += queue_up(queue, lambda: Client(queued(network, queue), 5))
    all_end(network, first, *waiting)
    assert network.passes == [[99], [1], [2], [3], [5]]


def test_background_work_is_never_refused_and_does_not_fill_the_queue(network: ManualModel) -> None:
    queue = InferenceScheduler(max_queued=1)
    first = occupy(network, queue)
    waiting = queue_up(queue, *(lambda: Client(queued(network, queue, background=True), 1) for _ in range(5)))
    waiting += queue_up(queue, lambda: Client(queued(network, queue), 2))
    all_end(network, first, *waiting)
    assert network.passes[:2] == [[99], [2]]


def test_requests_of_a_closed_context_are_dropped(network: ManualModel) -> None:
    queue = InferenceScheduler()
    first = occupy(network, queue)
    gone = RequestContext(queue)
    answers, long = (gone.queued(queued(network, queue), background) for background in (False, True))
    dropped = queue_up(queue, lambda: Client(answers, 1), lambda: Client(long, 2))
    stays = queue_up(queue, lambda: Client(queued(network, queue), 3))
    gone.close()
    for one in dropped:
        assert isinstance(one.finished().error, WorkCancelledError)
    assert n_queued(queue) == 1
    assert isinstance(Client(answers, 4).finished().error, WorkCancelledError)
    all_end(network, first, *stays)
    assert network.passes == [[99], [3]]
    gone.close()


def test_the_heads_of_each_model_are_read_once(network: ManualModel) -> None:
    queue = InferenceScheduler()
    one, other = queued(network, queue), queued(network, queue)
    assert one.heads("drone") is other.heads("drone")
    assert network.read == 1
    assert queued(ManualModel(), queue).heads("drone") is not one.heads("drone")
    with pytest.raises(InputError, match="street"):
        one.heads("street")
    assert RequestContext(queue).queued(None) is None


def test_an_idle_thread_ends_and_the_next_request_starts_another(
    network: ManualModel, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(inference_scheduler, "IDLE_TIMEOUT", 0.01)
    network._kept_positions = False
    queue = InferenceScheduler()
    for mark in (1, 2):
        assert Client(queued(network, queue), mark).finished().result is not None
        wait_until(lambda: queue._thread is None)
    assert network.passes == [[1], [2]]


class DraggingBrowser(threading.Thread):
    """A browser whose answer takes two requests: a cancellable one of its state, and a shared one."""

    def __init__(self, network: ManualModel, queue: InferenceScheduler, mark: int) -> None:
        super().__init__(daemon=True)
        self.mark, self.context = mark, RequestContext(queue)
        self.begun = self.shown = 0
        self.error: Exception | None = None
        model = self.context.queued(queued(network, queue))
        self._model = model
        self.start()

    def move(self, mark: int) -> None:
        """Change the state."""
        self.mark = mark
        self.context.supersede()

    def run(self) -> None:
        try:
            with self.context.answering():
                try:
                    self.shown = self._answer()
                except SupersededError:
                    self.shown = self._answer()
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
        wait_until(lambda: n_queued(queue) == len(begun))
    return begun


def test_a_superseded_request_is_replaced_by_the_newest_in_the_same_place(network: ManualModel) -> None:
    clock = Clock()
    queue, network.batch = InferenceScheduler(max_queued=3, clock=clock), 1
    first = occupy(network, queue)
    clients = drag(network, queue, 1, 2, 3)
    other, third = clients[1:]
    clock.now += MIN_WAIT
    other.move(22)
    network.release()
    network.began()  # computes `one`, while `other` prepares its next request
    wait_until(lambda: other.begun == 2 and n_queued(queue) == 2)
    third.move(33)
    network.release()
    network.began()
    wait_until(lambda: third.begun == 2 and n_queued(queue) == 2)
    clock.now += MIN_WAIT
    for browser in clients:  # there is no second cancellation, against starvation
        browser.move(7)
    network.release(20)
    for browser in clients:
        browser.join(TIMEOUT)
        assert browser.error is None
    first.finished()
    assert network.passes[:4] == [[99], [1], [22], [33]]
    assert sorted(network.passes[4:]) == [[101], [122], [133]]
    assert [browser.shown for browser in clients] == [1, 22, 33]


def test_a_request_that_has_hardly_waited_is_not_superseded(network: ManualModel) -> None:
    queue, network.batch = InferenceScheduler(clock=Clock()), 1
    first = occupy(network, queue)
    clients = drag(network, queue, 1, 2)
    for browser in clients:
        browser.move(9)
    network.release(20)
    for browser in clients:
        browser.join(TIMEOUT)
    first.finished()
    assert [(browser.shown, browser.begun) for browser in clients] == [(1, 1), (2, 1)]


def test_a_held_place_is_nobody_elses_and_is_released(network: ManualModel) -> None:
    clock = Clock()
    queue, network.batch = InferenceScheduler(max_queued=2, clock=clock), 1
    first = occupy(network, queue)
    one, other = drag(network, queue, 1, 2)
    clock.now += MIN_WAIT
    other.move(0)
    network.release()
    network.began()
    other.join(TIMEOUT)
    assert isinstance(other.error, ModelFileError)
    assert not queue._kept_positions, "it made no further request"
    queue._kept_positions[other.context] = 0
    waiting = queue_up(queue, lambda: Client(queued(network, queue), 4))
    with pytest.raises(BusyError):
        queued(network, queue).run(pictures(5), "drone")
    other.context.close()
    clock.now += RESERVATION + 1  # the reservation of the refused one ends
    waiting += queue_up(queue, lambda: Client(queued(network, queue), 6))
    all_end(network, first, *waiting)
    one.join(TIMEOUT)


def test_a_model_that_raises_system_exit_does_not_end_the_scheduler(network: ManualModel) -> None:
    network._kept_positions = False
    queue = InferenceScheduler()
    assert isinstance(Client(queued(network, queue), 14).finished().error, LPNError)
    assert Client(queued(network, queue), 1).finished().result is not None


def test_a_failing_scheduler_fails_its_requests_and_starts_again(
    network: ManualModel, monkeypatch: pytest.MonkeyPatch
) -> None:
    queue = InferenceScheduler()
    first = occupy(network, queue)
    waiting = queue_up(queue, *(lambda mark=mark: Client(queued(network, queue), mark) for mark in (1, 2)))
    with monkeypatch.context() as patched:
        patched.setattr(queue, "_next_batch", lambda: 1 // 0)
        network.release()
        for one in waiting:
            assert isinstance(one.finished().error, ZeroDivisionError)
    assert first.finished().error is None
    network.release()
    assert Client(queued(network, queue), 3).finished().result is not None


def test_after_a_failed_thread_start_the_next_call_tries_again(
    network: ManualModel, monkeypatch: pytest.MonkeyPatch
) -> None:
    network._kept_positions = False
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
    assert n_queued(queue) == 0
    assert Client(queued(network, queue), 2).finished().result is not None
    assert network.passes == [[2]]
    worker.wake()
    assert ran.wait(TIMEOUT)
    worker.stop()
