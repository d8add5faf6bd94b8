from __future__ import annotations

import errno
import os
import shutil
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import lpn
from lpn import descriptors
from lpn.cli.main import main
from lpn.core import images
from lpn.core.arrays import Float32Array
from lpn.core.errors import DataError, OutputError, PictureError, StoreError
from lpn.core.files import write_atomic
from lpn.core.views import View
from lpn.datasets import Picture, open_dataset
from lpn.descriptors.transforms import Change
from lpn.descriptors.weather import Weather
from lpn.index import open_index
from lpn.models.base import Model
from tools.fixtures import small_worlds


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for i in range(20):
        small_worlds.write(tmp_path / "pictures" / f"{i % 3}" / f"{i:02d}.png", small_worlds.place(i))
    return tmp_path / "pictures"


@pytest.fixture
def files(folder: Path) -> list[Path]:
    return descriptors.pictures_below(folder)


class Killed(BaseException):
    """In place of the process's end."""


def _killed_after(steps: Iterator[int], original: Callable[..., None]) -> Callable[..., None]:
    def step(*given: object, **more: object) -> None:
        if next(steps, None) is None:
            raise Killed
        original(*given, **more)

    return step


class Counting:
    """A model that counts its computations, and can be killed in the middle."""

    def __init__(self, model: Model, monkeypatch: pytest.MonkeyPatch, die_after: int | None = None) -> None:
        self.described, self.die_after = 0, die_after
        original = type(model).descriptors

        def descriptors(of: Model, pictures: Float32Array, view: View, mirror: bool = True) -> Float32Array:
            if self.die_after is not None and self.described >= self.die_after:
                raise KeyboardInterrupt
            self.described += len(pictures)
            return original(of, pictures, view, mirror)

        monkeypatch.setattr(type(model), "descriptors", descriptors)


def assert_one_part(store: Path) -> None:
    """Nothing is left of an earlier run."""
    assert sorted(path.name[:4] for path in store.iterdir()) == ["part", "stor"]


def test_store_holds_what_the_model_says(model: Model, folder: Path, files: list[Path], tmp_path: Path) -> None:
    store = descriptors.describe(model, files, "drone", tmp_path / "store", root=folder)
    prepared = np.stack([images.prepare(images.load_picture(file), model.input_size) for file in files])
    np.testing.assert_allclose(store.descriptors, model.descriptors(prepared, "drone"), atol=1e-6)
    assert store.names == [str(file.relative_to(folder)) for file in files]
    assert isinstance(store.descriptors, np.memmap)
    assert_one_part(tmp_path / "store")


def test_a_killed_description_goes_on_where_it_stood(
    model: Model, files: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = np.array(descriptors.describe(model, files, "drone", tmp_path / "whole").descriptors)
    with monkeypatch.context() as patch:
        Counting(model, patch, die_after=8)
        with pytest.raises(KeyboardInterrupt):
            descriptors.describe(model, files, "drone", tmp_path / "store")
    with pytest.raises(StoreError, match="not finished"):
        descriptors.open_store(tmp_path / "store")
    count = Counting(model, monkeypatch)
    rest = [*files[:3], *files[4:]]  # that a picture is gone costs nothing that was done
    store = descriptors.describe(model, rest, "drone", tmp_path / "store")
    assert count.described == 12
    np.testing.assert_array_equal(store.descriptors, np.delete(whole, 3, axis=0))


def test_nothing_is_computed_twice(
    model: Model, folder: Path, files: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    descriptors.describe(model, files, "drone", tmp_path / "store")
    count = Counting(model, monkeypatch)
    descriptors.describe(model, files, "drone", tmp_path / "store")
    assert count.described == 0
    small_worlds.write(folder / "3" / "new.png", small_worlds.place(99))
    small_worlds.write(files[4], small_worlds.place(98))
    store = descriptors.describe(model, descriptors.pictures_below(folder), "drone", tmp_path / "store")
    assert count.described == 2
    assert len(store.descriptors) == 21
    with pytest.raises(StoreError, match="choose another folder"):
        descriptors.describe(model, files, "satellite", tmp_path / "store")
    with pytest.raises(StoreError, match=r"4 x 512 numbers in float32, and these would be .* shifted 3 px to the"):
        descriptors.describe(model, files, "drone", tmp_path / "store", change=Change(shift=3))
    assert count.described == 2


def test_a_name_that_is_not_utf_8_is_read_again(
    model: Model, folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    try:
        (folder / "0" / "00.png").rename(folder / "0" / os.fsdecode(b"caf\xe9.png"))
    except OSError:
        pytest.skip("this file system takes UTF-8 names alone")
    files = descriptors.pictures_below(folder)
    with monkeypatch.context() as patch:
        Counting(model, patch, die_after=8)
        with pytest.raises(KeyboardInterrupt):
            descriptors.describe(model, files, "drone", tmp_path / "store")
    count = Counting(model, monkeypatch)
    store = descriptors.describe(model, files, "drone", tmp_path / "store")
    assert count.described == 12
    assert descriptors.open_store(tmp_path / "store").rows == store.rows
    assert store.check() == 0


def test_a_kill_while_a_store_is_finished_loses_no_row(
    model: Model, files: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """At each step in turn that changes a name in the folder, of a new store and of one whose list has changed."""
    rest = [*files[:3], *files[4:]]
    expected = descriptors.describe(model, rest, "drone", tmp_path / "other").descriptors
    descriptors.describe(model, rest[::-1], "drone", tmp_path / "before")
    count = Counting(model, monkeypatch)
    for there, missing in ((False, 19), (True, 0)):
        for step in range(20):
            out = tmp_path / f"{there} {step}"
            if there:
                shutil.copytree(tmp_path / "before", out)
            before = count.described
            try:
                with monkeypatch.context() as patch:
                    steps = iter(range(step))
                    for owner, name in ((os, "replace"), (Path, "unlink"), (Path, "rmdir")):
                        patch.setattr(owner, name, _killed_after(steps, getattr(owner, name)))
                    descriptors.describe(model, rest, "drone", out)
                break
            except Killed:
                assert count.described - before == missing
                again = descriptors.describe(model, rest, "drone", out)
                assert count.described - before == missing
                np.testing.assert_allclose(again.descriptors, expected, atol=1e-6)
                assert_one_part(out)
        assert step >= (4 if there else 1)


def test_an_error_that_the_system_has_no_name_for_is_told(
    model: Model, files: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def short(*_: object) -> None:
        raise OSError("512 requested and 0 written")  # as NumPy says of a full disk

    monkeypatch.setattr(descriptors.PartialStore, "save", short)
    with pytest.raises(StoreError, match=r"cannot be written \(512 requested and 0 written\)"):
        descriptors.describe(model, files, "drone", tmp_path / "store")
    monkeypatch.setattr(Path, "write_bytes", short)
    with pytest.raises(OutputError, match=r"cannot be written \(512 requested and 0 written\)"):
        write_atomic(tmp_path / "file", b"")


def test_files_of_other_origin_are_not_touched(model: Model, files: list[Path], tmp_path: Path) -> None:
    (tmp_path / "own").mkdir()
    (tmp_path / "own" / "store.json").write_text('{"name": "my web app"}')
    with pytest.raises(StoreError, match="in another folder"):
        descriptors.describe(model, files, "drone", tmp_path / "own")
    assert [p.name for p in (tmp_path / "own").iterdir()] == ["store.json"]
    assert (tmp_path / "own" / "store.json").read_text() == '{"name": "my web app"}'


def test_machines_share_the_pictures_and_the_last_makes_the_store(
    model: Model, model_file: Path, folder: Path, files: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "store"
    whole = np.array(descriptors.describe(model, files, "drone", tmp_path / "whole", root=folder).descriptors)
    count = Counting(model, monkeypatch)
    given = ["describe", "--model", str(model_file), "--images", str(folder), "--view", "drone", "--out", str(out)]
    assert main([*given, "--part", "3/3"]) == main([*given, "--part", "1/3"]) == 0
    assert count.described == 13
    with pytest.raises(StoreError, match="not finished"):
        descriptors.open_store(out)
    with pytest.raises(StoreError, match=r"holds other descriptors than .* give all shares the same options"):
        descriptors.describe_share(model, files, "drone", out, folder, (2, 3), "float16")
    assert main(given) == 0
    with pytest.raises(StoreError, match="and these would be"):
        descriptors.describe_share(model, files, "drone", out, folder, (2, 3), "float16")
    assert count.described == 20
    np.testing.assert_allclose(descriptors.open_store(out).descriptors, whole, atol=1e-6)
    assert_one_part(out)
    for share in ("0/3", "4/3", "x", "1/2/3"):
        assert main([*given, "--part", share]) == 2


def test_a_cache_that_cannot_be_written_says_how_to_choose_another(
    model: Model, files: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("LPN_CACHE", str(tmp_path / "file" / "cache"))
    with pytest.raises(StoreError, match="Set LPN_CACHE"):
        descriptors.cached_descriptors(model, [Picture(files[0], 1, "1")], "drone")


def test_a_store_that_comes_along_is_used_for_its_own_pictures_and_model(
    model: Model, folder: Path, files: list[Path], tmp_path: Path
) -> None:
    made = np.array(descriptors.describe(model, files, "drone", tmp_path / "store", root=folder).descriptors)
    copied = [tmp_path / "copy" / file.relative_to(folder) for file in files]
    for source, target in zip(files, copied, strict=True):
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_bytes(source.read_bytes())
    pictures = [Picture(file, 1, file.stem) for file in copied]
    shipped = descriptors.shipped_descriptors(model, pictures, "drone", tmp_path / "store")
    np.testing.assert_array_equal(shipped, made)
    assert descriptors.shipped_descriptors(model, pictures, "satellite", tmp_path / "store") is None
    assert descriptors.shipped_descriptors(model, pictures[1:], "drone", tmp_path / "store") is None
    assert descriptors.shipped_descriptors(model, pictures, "drone", tmp_path / "absent") is None
    copied[3].write_bytes(copied[3].read_bytes() + b"\0")
    assert descriptors.shipped_descriptors(model, pictures, "drone", tmp_path / "store") is None


@pytest.mark.parametrize(("precision", "error"), [("float16", 2e-4), ("int8", 4e-3)])
def test_a_smaller_store_says_nearly_the_same(
    precision: descriptors.Precision,
    error: float,
    model: Model,
    folder: Path,
    files: list[Path],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    whole = descriptors.describe(model, files, "drone", tmp_path / "whole", root=folder)
    with monkeypatch.context() as patch:
        Counting(model, patch, die_after=8)
        with pytest.raises(KeyboardInterrupt):
            descriptors.describe(model, files, "drone", tmp_path / "small", root=folder, precision=precision)
    count = Counting(model, monkeypatch)
    small = descriptors.describe(model, files, "drone", tmp_path / "small", root=folder, precision=precision)
    assert count.described == 12
    assert (small.descriptors.dtype, small.float32.dtype, small.kind.precision) == (precision, np.float32, precision)
    np.testing.assert_allclose(small.float32, whole.descriptors, atol=error)
    np.testing.assert_allclose(np.linalg.norm(small.float32, axis=2), 0.5, atol=1e-3)
    assert np.abs(small.float32 - whole.descriptors).max() > 0
    pictures = [Picture(file, 1, file.stem) for file in files]
    shipped = descriptors.shipped_descriptors(model, pictures, "drone", tmp_path / "small")
    np.testing.assert_array_equal(shipped, small.float32)
    with pytest.raises(StoreError, match=rf"in {precision}, and these would be .* in float32"):
        descriptors.describe(model, files, "drone", tmp_path / "small", root=folder)
    with open_index(tmp_path / "small", model.fingerprint) as index:  # which is converted block by block
        found = index.search(small.float32[7], None, 3)
    scores = small.float32.astype(np.float64).reshape(20, -1) @ small.float32[7].astype(np.float64).reshape(-1)
    assert found.ids == [small.names[i] for i in np.argsort(-scores, kind="stable")[:3]]


def test_a_data_sets_own_store_is_evaluated_where_it_is_exact(
    model: Model, data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    root = shutil.copytree(data, tmp_path / "data")
    tiles = open_dataset(root).gallery("satellite")
    folder = root / "test" / "gallery_satellite"
    count, read = Counting(model, monkeypatch), descriptors.descriptor_reader(root)
    stores = root / "descriptors"
    files = [tile.path for tile in tiles]
    descriptors.describe(model, files, "satellite", stores / "gallery_satellite", root=folder, precision="float16")
    assert count.described == len(tiles)
    read(model, tiles, "satellite")
    assert count.described == 2 * len(tiles)
    shutil.rmtree(stores)
    descriptors.describe(model, files, "satellite", stores / "gallery_satellite", root=folder)
    shutil.rmtree(tmp_path / "cache")
    before = count.described
    read(model, tiles, "satellite")
    assert count.described == before
    read(model, tiles, "satellite", Change(rotate=90))
    assert count.described == before + len(tiles)


def test_two_at_once_describe_into_one_folder_once(
    model: Model, files: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    count = Counting(model, monkeypatch)
    with ThreadPoolExecutor(2) as pool:
        both = [pool.submit(descriptors.describe, model, files, "drone", tmp_path / "store") for _ in range(2)]
    assert count.described == 20
    np.testing.assert_array_equal(both[0].result().descriptors, both[1].result().descriptors)


def test_unreadable_pictures_are_named_before_anything_is_computed(
    model: Model, folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (folder / "2" / "zz.jpg").write_bytes(b"no picture")
    cut = folder / "1" / "04.png"
    cut.write_bytes(cut.read_bytes()[:-500])
    count = Counting(model, monkeypatch)
    with pytest.raises(PictureError, match=r"2 of 21 pictures .*04\.png is cut short.*zz\.jpg is not a picture"):
        descriptors.describe(model, descriptors.pictures_below(folder), "drone", tmp_path / "store")
    assert count.described == 0
    (tmp_path / "empty").mkdir()
    for missing in ("empty", "absent"):
        with pytest.raises(DataError, match=missing):
            descriptors.pictures_below(tmp_path / missing)


def test_damaged_stores_are_refused_in_words_and_described_again(
    model: Model, files: list[Path], tmp_path: Path
) -> None:
    files = files[:3]
    store = tmp_path / "store"
    whole = np.array(descriptors.describe(model, files, "drone", store).descriptors)
    for damage in ("cut", "shape", "rows", "values"):
        (part,) = store.glob("part-*")
        if damage == "cut":
            (part / "vectors.npy").write_bytes((part / "vectors.npy").read_bytes()[:500])
        elif damage == "rows":
            (part / "rows.json").write_text("{}")
        else:
            np.save(part / "vectors.npy", -whole if damage == "values" else whole[:2])
        if damage == "values":  # which only the checksums tell, when rows are taken over into another list
            files = files[:2]
        else:
            with pytest.raises(StoreError, match="describe the pictures again"):
                _ = descriptors.open_store(store).rows
        again = descriptors.describe(model, files, "drone", store)
        np.testing.assert_allclose(again.descriptors, whole[: len(files)], atol=1e-6)
        assert_one_part(store)


def test_too_many_open_files_are_not_called_damage(
    model: Model, files: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    files = files[:2]
    descriptors.describe(model, files, "drone", tmp_path / "store")

    def refused(_: Path) -> None:
        raise OSError(errno.EMFILE, os.strerror(errno.EMFILE))

    monkeypatch.setattr("lpn.descriptors.store.open_memmap", refused)
    with pytest.raises(StoreError, match="let more files be open at once"):
        descriptors.describe(model, files, "drone", tmp_path / "store")


def test_a_picture_s_own_zoom_has_descriptors_of_its_own(model: Model, files: list[Path], tmp_path: Path) -> None:
    files = files[:5]
    pictures = [Picture(file, 1, file.stem) for file in files]
    made = {
        (scale, zoom): descriptors.cached_descriptors(model, pictures, "drone", Change(scale=scale, zoom=zoom))
        for scale, zoom in ((1, 1), (0.5, 2), (1, 2), (2, 1))
    }
    np.testing.assert_array_equal(made[1, 1], made[0.5, 2])
    np.testing.assert_array_equal(made[1, 2], made[2, 1])
    assert np.abs(made[1, 2] - made[1, 1]).max() > 1e-3
    store = descriptors.describe(model, files, "drone", tmp_path / "store", change=Change(scale=2, zoom=2))
    assert store.kind.change == Change(scale=4)
    with pytest.raises(StoreError, match="these would be"):
        descriptors.describe(model, files, "drone", tmp_path / "store", change=Change(scale=2))


CHANGES = [
    {}, {"shift": 4}, {"scale": 2}, {"down": 4}, {"rotate": 90}, {"rotate": 90, "around": True},
    {"weather": Weather("fog", 0.5, 3)}, {"weather": Weather("fog", 0.5, 4)},
]  # fmt: skip


def test_cache_is_keyed_by_every_change_and_box(
    model: Model, files: list[Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    pictures = [Picture(file, 1, file.stem) for file in files[:5]]
    boxed = [replace(picture, box=(0.0, 10.0, 50.5, 60.0)) for picture in pictures]
    count = Counting(model, monkeypatch)
    asked = [(pictures, Change(**given)) for given in CHANGES]
    asked.append((boxed, Change()))
    made = [descriptors.cached_descriptors(model, given, "drone", change) for given, change in asked]
    assert count.described == 45
    again = [descriptors.cached_descriptors(model, given, "drone", change) for given, change in asked]
    assert count.described == 45
    np.testing.assert_array_equal(made, again)
    assert len({array.tobytes() for array in made}) == 9
    for (_, change), found in zip(asked[:-1], made, strict=False):
        direct = lpn.retrieval.describe_picture(model, pictures[0].load(), "drone", change).descriptor
        np.testing.assert_allclose(found[0], direct, atol=1e-5)
    moved = [*boxed[:4], replace(boxed[4], box=(1.0, 10.0, 50.5, 60.0))]
    before = count.described
    descriptors.cached_descriptors(model, moved, "drone")
    assert count.described == before + 1


def test_a_damaged_or_cut_part_of_an_unfinished_store_is_described_again(
    model: Model, folder: Path, files: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "store"
    whole = np.array(descriptors.describe(model, files, "drone", tmp_path / "whole", root=folder).descriptors)
    for damaged in ("vectors.npy", "rows.json"):
        for i in (1, 2, 3):
            descriptors.describe_share(model, files, "drone", out, folder, (i, 4))
        broken = sorted(out.glob(f"*/{damaged}"))[1]
        data = broken.read_bytes()
        broken.write_bytes(data[:-9] + b"x" + data[-8:] if damaged == "vectors.npy" else data[:-7])
        with monkeypatch.context() as patch:
            count = Counting(model, patch)
            made = descriptors.describe(model, files, "drone", out, root=folder)
        np.testing.assert_allclose(made.descriptors, whole, atol=1e-6)
        assert count.described == 10
        assert_one_part(out)
        shutil.rmtree(out)


def test_rows_are_saved_about_once_a_second(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    clock = iter(0.3 * step for step in range(100))
    monkeypatch.setattr("lpn.descriptors.writer.time", SimpleNamespace(monotonic=lambda: next(clock)))
    parts: list[int] = []

    def put(partial: descriptors.PartialStore) -> None:
        for row in range(12):
            partial.put([row], np.ones((1, 2, 8), np.float32))
            parts.append(len(list(tmp_path.glob("part-*"))))

    rows = [descriptors.Row(f"{i}.png", 1, 1) for i in range(12)]
    descriptors.write_store(tmp_path, descriptors.DescriptorKind("model", 2, 8), rows, put)
    assert parts == [0, 0, 0, 1, 1, 1, 1, 2, 2, 2, 2, 3]
