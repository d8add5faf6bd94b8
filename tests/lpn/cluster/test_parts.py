"""Drivers that are killed, or two at once, in a place of parts: the real driver and worker, with neither Ray nor a model."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

pytest.importorskip("pyarrow", reason="the extra cluster is not installed")

from lpn.cluster import driver
from lpn.cluster.driver import Summary
from lpn.cluster.parts import PLAN, PartItem, Plan, contents_of, open_parts, part_names, to_store, write_part
from lpn.cluster.storage import Storage
from lpn.cluster.worker import DescribeWorker, WorkerTask, _UnreadError
from lpn.core.arrays import Float32Array
from lpn.core.errors import PictureError, StoreError
from lpn.descriptors import Row
from lpn.descriptors.parallel_inference import DescribedRow
from lpn.index.tiles import open_tiles
from lpn.models.base import normalise

KIND = Plan("f" * 16, "drone", 2, 4, "float32")


def pictures(count: int, size: int = 10, latitude: float = 46.0) -> list[PartItem]:
    return [PartItem(Row(f"{i:03d}.png", size, 1), (latitude, 7.0)) for i in range(count)]


def described(items: Sequence[PartItem]) -> Float32Array:
    """Descriptors that tell pictures, and their states, apart: (B, 2, 4)."""
    raw = [np.random.default_rng([*item.row.file.encode(), item.row.size]).standard_normal((2, 4)) for item in items]
    return normalise(np.array(raw, np.float32).reshape(-1, 2, 4))


class KilledError(Exception):
    """The driver is gone."""


class OneProcess:
    """The functions of Ray Data that the driver uses, run in succession in this process.

    Args:
        before: told how many parts were begun, before each.
    """

    def __init__(self, before: Callable[[int], None]) -> None:
        self.before = before
        self.ActorPoolStrategy = lambda **_: None

    def from_items(self, rows: list[dict[str, Any]], **_: object) -> OneProcess:
        self.rows = rows
        return self

    def map_batches(
        self, worker: Callable[..., DescribeWorker], fn_constructor_args: tuple[WorkerTask, Any], **_: object
    ) -> Any:
        ready = worker(*fn_constructor_args)

        def results() -> Iterator[Mapping[str, Any]]:
            for begun, row in enumerate(self.rows):
                self.before(begun)
                made = ready({name: [value] for name, value in row.items()})
                yield {name: value[0] for name, value in made.items()}

        return SimpleNamespace(iter_rows=results)


class Place:
    """A place of parts as in object storage, where nothing keeps a second driver out.

    Attributes:
        computed: names of the pictures that were given to the model, of all runs.
        unread: names of pictures that cannot be read now.
    """

    def __init__(self, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        folder.mkdir()
        self.folder, self.storage, self.monkeypatch = folder, Storage(folder), monkeypatch
        self.computed: list[str] = []
        self.unread: set[str] = set()
        monkeypatch.setattr("lpn.cluster.worker.describe_each", self._describe_each)

    def run(self, items: Sequence[PartItem], size: int = 4, before: Callable[[int], None] = lambda _: None) -> Summary:
        """Do the work of lpn describe --engine ray after it has listed the pictures."""

        @contextmanager
        def ray_session(*_: object) -> Iterator[tuple[OneProcess, int, Callable[[Any], Any]]]:
            yield OneProcess(before), 1, lambda files: files

        def worker(task: WorkerTask, _: object) -> DescribeWorker:
            made = DescribeWorker.__new__(DescribeWorker)
            made.task, made.images, made.out = task, Storage(task.images), Storage(task.out)
            made.model = SimpleNamespace()  # type: ignore[assignment]
            return made

        with self.monkeypatch.context() as patched:
            patched.setattr(driver, "ray_session", ray_session)
            place, say = self.storage, lambda _: None
            return driver._run(place, place, list(items), KIND, {}, "m.onnx", None, 1, 1, size, say, worker)  # type: ignore[arg-type]

    def killed(self, items: Sequence[PartItem], after: int) -> None:
        """A run whose driver is killed after a number of parts."""

        def before(begun: int) -> None:
            if begun == after:
                raise KilledError

        with pytest.raises(KilledError):
            self.run(items, before=before)

    def check(self, items: Sequence[PartItem]) -> None:
        """Each picture is in the parts once, with its own descriptor and position."""
        opened = open_parts(self.folder)
        found = [both for part in opened.parts for both in zip(part.items, opened.vectors(part), strict=True)]
        assert sorted(item.row.file for item, _ in found) == sorted(item.row.file for item in items)
        rows = dict(found)
        np.testing.assert_array_equal([rows[item] for item in items], described(items))

    def _describe_each(self, _: object, items: Sequence[PartItem], *__: object) -> Iterator[DescribedRow]:
        good = [i for i, item in enumerate(items) if item.row.file not in self.unread]
        self.computed += [items[i].row.file for i in good]
        unread = _UnreadError("cannot be read (nobody is there)")
        broken: list[tuple[int, PictureError]] = [(i, unread) for i in range(len(items)) if i not in good]
        yield DescribedRow(good, described([items[i] for i in good]), broken)


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Place:
    return Place(tmp_path / "parts", monkeypatch)


def test_a_killed_driver_costs_nothing_that_was_written(place: Place, tmp_path: Path) -> None:
    for after in (0, 2, 1):
        place.killed(pictures(20), after)
        with pytest.raises(StoreError, match="has not ended; wait for it, or run lpn describe --engine ray again"):
            open_parts(place.folder)
    assert len(place.computed) == 12
    assert place.run(pictures(20)).computed == 8
    assert sorted(place.computed) == [item.row.file for item in pictures(20)]
    place.check(pictures(20))
    before = {path.name: path.stat().st_mtime_ns for path in place.folder.glob("part-*")}
    assert place.run(pictures(20)).computed == 0
    assert {path.name: path.stat().st_mtime_ns for path in place.folder.glob("part-*")} == before
    store = to_store(open_parts(place.folder), tmp_path / "store")
    assert store.manifest.rows == tuple(item.row for item in pictures(20))
    np.testing.assert_array_equal(store.float32, described(pictures(20)))


def test_pictures_that_changed_are_computed_and_those_that_are_gone_are_dropped(place: Place) -> None:
    place.run(pictures(12))
    place.check(pictures(12))
    now = [*pictures(3), *pictures(5, size=11)[3:], *pictures(12)[7:], *pictures(14)[12:]]
    assert place.run(now).computed == 4
    place.check(now)
    # A position that is known now needs no description.
    elsewhere = [item._replace(position=(47.0, 8.0)) for item in now]
    assert place.run(elsewhere).computed == 0
    place.check(elsewhere)


def test_a_picture_that_could_not_be_read_is_tried_again_and_forgotten_when_it_is_gone(
    place: Place, tmp_path: Path
) -> None:
    place.unread = {"003.png"}
    assert [one.item.row.file for one in place.run(pictures(12)).broken] == ["003.png"]
    assert len(to_store(open_parts(place.folder), tmp_path / "store").manifest.rows) == 11
    assert len(place.run(pictures(12)).broken) == 1
    others = [item for item in pictures(12) if item.row.file != "003.png"]
    assert place.run(others).broken == []
    place.check(others)
    place.unread = set()
    assert place.run(pictures(12)).broken == []
    place.check(pictures(12))
    assert sorted(place.computed) == [item.row.file for item in pictures(12)]


def test_a_run_that_begins_while_parts_are_read_is_seen(place: Place, tmp_path: Path) -> None:
    place.run(pictures(12))
    opened, tiles = open_parts(place.folder), open_tiles(str(place.folder))
    place.run(pictures(12, size=11))
    with pytest.raises(StoreError, match="was written anew while it was read"):
        to_store(opened, tmp_path / "store")
    with pytest.raises(StoreError, match="was written anew while it was read"):
        next(tiles.chunks).rows(np.arange(2))
    assert not (tmp_path / "store" / "manifest.json").exists()
    to_store(open_parts(place.folder), tmp_path / "store")


def test_a_late_part_of_another_driver_is_refused_until_a_run_mends_it(place: Place) -> None:
    place.run(pictures(8))
    late = pictures(6, size=9)
    write_part(place.storage, KIND, late, described(late))
    with pytest.raises(
        StoreError, match="are not those of the run that ended last; run lpn describe --engine ray again"
    ):
        open_parts(place.folder)
    assert place.run(pictures(8)).computed == 0
    place.check(pictures(8))
    # Two drivers that described the same pictures: each stays once.
    write_part(place.storage, KIND, pictures(6), described(pictures(6)))
    assert place.run(pictures(8)).computed == 0
    place.check(pictures(8))


def test_damaged_parts_are_named_and_computed_again(place: Place) -> None:
    place.run(pictures(12))
    first, second, _ = (place.folder / name for name in part_names(place.storage))
    first.write_bytes(first.read_bytes()[:-30])
    with pytest.raises(StoreError, match=r"1 of 3 parts in .* are damaged"):
        open_parts(place.folder)
    second.unlink()
    with pytest.raises(StoreError, match="are not those of the run that ended last"):
        open_parts(place.folder)
    assert place.run(pictures(12)).computed == 8
    place.check(pictures(12))


def test_a_file_of_somebody_else_stays(place: Place) -> None:
    (place.folder / "part-of-me.zip").write_bytes(b"mine")
    place.run(pictures(4))
    place.run(pictures(2))
    assert (place.folder / "part-of-me.zip").read_bytes() == b"mine"
    plan = Plan.read(place.storage)
    assert plan is not None
    assert plan.contents == contents_of(part_names(place.storage))
    (place.folder / PLAN).write_bytes(replace(plan, fingerprint="0" * 16).to_json())
    with pytest.raises(StoreError, match="choose another place"):
        place.run(pictures(4))
