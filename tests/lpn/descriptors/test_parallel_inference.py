from __future__ import annotations

import threading
import time
from pathlib import Path

import numpy as np
import pytest

from lpn.core.arrays import Float32Array
from lpn.core.errors import PictureError
from lpn.descriptors import parallel_inference
from lpn.descriptors.parallel_inference import describe_each
from lpn.models.onnx_engine import Engine


@pytest.fixture
def pictures() -> Float32Array:
    return np.random.default_rng(0).standard_normal((23, 3, 64, 64)).astype(np.float32)


def collected(model: Engine, pictures: Float32Array, count: int) -> Float32Array:
    found = np.full((len(pictures), model.n_parts, model.embedding), np.nan, np.float32)
    for some in describe_each(model, list(range(len(pictures))), lambda i: pictures[i], "drone", count):
        assert np.isnan(found[some.items]).all()
        found[some.items] = some.descriptors
    return found


@pytest.mark.parametrize("worth", [1, 1000])
def test_streams_say_what_one_call_says(
    worth: int, model_file: Path, pictures: Float32Array, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each stream computes by itself, or all take turns with the model as it was opened."""
    monkeypatch.setattr(parallel_inference, "_MIN_PICTURES", worth)
    model = Engine(model_file, threads=2)
    np.testing.assert_allclose(collected(model, pictures, 3), model.descriptors(pictures, "drone"), atol=1e-6)


def test_a_network_on_the_cpu_runs_in_several_threads_at_once(
    model_file: Path, pictures: Float32Array, monkeypatch: pytest.MonkeyPatch
) -> None:
    both = threading.Barrier(2, timeout=120)
    original = Engine.descriptors

    def descriptors(self: Engine, images: Float32Array, view: str, mirror: bool = True) -> Float32Array:
        both.wait()  # breaks unless two are in here together
        return original(self, images, view, mirror)

    model = Engine(model_file, threads=1)
    whole = model.descriptors(pictures[:8], "drone")
    monkeypatch.setattr(Engine, "descriptors", descriptors)
    np.testing.assert_allclose(collected(model, pictures[:8], 2), whole, atol=1e-6)


def test_others_are_computed_one_at_a_time_while_pictures_are_prepared(
    model_file: Path, pictures: Float32Array, monkeypatch: pytest.MonkeyPatch
) -> None:
    model = Engine(model_file, threads=2)
    inside, preparing = threading.Lock(), threading.Event()
    original = Engine.descriptors

    def descriptors(self: Engine, images: Float32Array, view: str, mirror: bool = True) -> Float32Array:
        assert inside.acquire(blocking=False), "two computed at once"
        try:
            assert preparing.wait(120), "nothing was prepared meanwhile"
            return original(self, images, view, mirror)
        finally:
            inside.release()

    def prepare(i: int) -> Float32Array:
        until = time.monotonic() + 120
        # The second thread prepares the second batch while the first is computed.
        while i >= model.batch and not preparing.is_set() and time.monotonic() < until:
            if inside.locked():
                preparing.set()
            time.sleep(0.001)
        return pictures[i]

    monkeypatch.setattr(Engine, "descriptors", descriptors)
    found = [i for some in describe_each(model, list(range(23)), prepare, "drone", 2) for i in some.items]
    assert sorted(found) == list(range(23))


def test_no_more_is_in_hand_than_the_threads_have(model_file: Path, pictures: Float32Array) -> None:
    prepared: list[int] = []
    model = Engine(model_file, threads=1)

    def prepare(i: int) -> Float32Array:
        prepared.append(i)
        return pictures[i % len(pictures)]

    walk = describe_each(model, list(range(400)), prepare, "drone", 2)
    next(walk)
    threading.Event().wait(0.5)
    assert len(prepared) <= 5 * model.batch
    walk.close()
    before = len(prepared)
    threading.Event().wait(0.2)
    assert len(prepared) == before


def test_broken_pictures_stop_no_others_and_an_error_loses_nothing_in_hand(
    model_file: Path, pictures: Float32Array
) -> None:
    model = Engine(model_file, threads=1)

    def prepare(i: int) -> Float32Array:
        if i in (2, 5, 6):
            raise PictureError(f"{i} is broken")
        if i == 9:
            raise ZeroDivisionError
        return pictures[i]

    described: list[int] = []
    broken: list[tuple[int, str]] = []

    def walk() -> None:
        for some in describe_each(model, list(range(12)), prepare, "drone", 3):
            described.extend(some.items)
            broken.extend((i, str(error)) for i, error in some.broken)

    with pytest.raises(ZeroDivisionError):
        walk()
    assert sorted(described) == [0, 1, 3, 4, 7]
    assert sorted(broken) == [(i, f"{i} is broken") for i in (2, 5, 6)]
    assert list(describe_each(model, [], prepare, "drone")) == []
