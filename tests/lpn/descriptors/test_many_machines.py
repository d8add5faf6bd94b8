"""Describing with many workers. Ray is started once for the module, with two workers."""

from __future__ import annotations

import csv
import shutil
import time
import warnings
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

pytest.importorskip("ray", reason="the extra cluster is not installed")

from lpn import descriptors
from lpn.cli.main import main
from lpn.core.errors import DataError, InputError, LPNError, StoreError
from lpn.core.files import exclusive_lock
from lpn.core.progress import listening
from lpn.descriptors import many_machines
from lpn.descriptors.many_machines import Summary, describe_by_many
from lpn.index import open_index
from lpn.models.onnx_engine import Engine
from tests.lpn.models.test_own_models import graph
from tools.fixtures import small_worlds
from tools.fixtures.failing_workers import Killed, Odd
from tools.fixtures.processes import free_port

pytestmark = [
    # Ray uses deprecated functions in its own modules, and leaves processes and sockets to the system.
    pytest.mark.filterwarnings("ignore::DeprecationWarning:ray"),
    pytest.mark.filterwarnings("ignore::FutureWarning:ray"),
    pytest.mark.filterwarnings("ignore::ResourceWarning"),
    pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning"),
]

PICTURES = 40


@pytest.fixture(scope="module", autouse=True)
def _ray() -> Iterator[None]:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        with ExitStack() as running:
            for attempts_left in range(9, -1, -1):
                try:  # Ray gives itself 30 seconds, which is too little on a busy machine
                    running.enter_context(many_machines._ray_session(None, 2, 1))
                    break
                except StoreError:
                    if not attempts_left:
                        raise
            yield


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for i in range(PICTURES):
        small_worlds.write(tmp_path / "pictures" / f"{i % 3}" / f"{i:02d}.png", small_worlds.place(i))
    return tmp_path / "pictures"


def describe(model_file: Path, folder: Path, out: str | Path, workers: int = 1, **given: Any) -> Summary:
    return describe_by_many(model_file, folder, "drone", out, workers=workers, size=8, **given)


def expected(model_file: Path, folder: Path, out: Path) -> descriptors.Store:
    return descriptors.describe(Engine(model_file), descriptors.pictures_below(folder), "drone", out, root=folder)


def assert_equal(store: descriptors.Store, alone: descriptors.Store) -> None:
    """Both hold the same rows, in any order."""
    order = [store.rows.index(row) for row in alone.rows]
    assert len(store) == len(alone)
    assert store.kind == alone.kind
    np.testing.assert_allclose(store.descriptors[order], alone.descriptors, atol=1e-6)


def test_two_workers_say_what_one_machine_says(
    model_file: Path, folder: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    out, counts = tmp_path / "store", list[tuple[int, int]]()
    engine, files = Engine(model_file), descriptors.pictures_below(folder)
    for share in (1, 2):
        descriptors.describe_share(engine, files, "drone", out, folder, (share, 2))
    cut, _ = sorted(out.glob("part-*/vectors.npy"))  # it is described again
    cut.write_bytes(cut.read_bytes()[:-1])
    with listening(lambda _, *count: counts.append(count)):
        summary = describe(model_file, folder, out, workers=2)
    assert (summary.pictures, summary.computed, summary.broken) == (PICTURES, PICTURES // 2, {})
    assert (counts[0], counts[-1]) == ((PICTURES // 2, PICTURES), (PICTURES, PICTURES))
    alone, store = expected(model_file, folder, tmp_path / "alone"), descriptors.open_store(out)
    assert store.rows == alone.rows
    assert_equal(store, alone)
    assert store.check() == 0
    assert (out / "broken.csv").read_text() == "name,reason\n"
    before = {path: path.stat().st_mtime_ns for path in out.glob("part-*/*")}
    assert describe(model_file, folder, out).computed == 0
    assert {path: path.stat().st_mtime_ns for path in out.glob("part-*/*")} == before
    with pytest.raises(StoreError, match=r"and these would be .*; choose another folder"):
        describe(model_file, folder, out, precision="float16")
    with ThreadPoolExecutor(1) as other:  # another run waits for this one
        with exclusive_lock(out, wait=True):
            waiting = other.submit(describe, model_file, folder, out)
            while "waiting for it" not in caplog.text:
                assert not waiting.done()
                time.sleep(0.02)
        assert waiting.result().computed == 0


@pytest.mark.slow
def test_what_changed_alone_is_computed_and_what_is_broken_is_named(
    model_file: Path, folder: Path, tmp_path: Path
) -> None:
    out, broken = tmp_path / "store", ["0/cut.png", "1/text.jpg", "2/spoilt.png"]
    describe(model_file, folder, out)
    (folder / broken[0]).write_bytes((folder / "0" / "00.png").read_bytes()[:-500])
    (folder / broken[1]).write_bytes(b"no picture")
    small_worlds.spoilt_png(folder / broken[2])
    small_worlds.write(folder / "0" / "00.png", small_worlds.place(51))
    small_worlds.write(folder / "3" / "new.png", small_worlds.place(52))
    (folder / "2" / "02.png").unlink()
    summary = describe(model_file, folder, out)
    assert (summary.pictures, summary.computed, list(summary.broken)) == (PICTURES + 3, 2, broken)
    reasons = ["is cut short or damaged", "is not a picture that can be read", "is damaged"]
    rows = list(csv.reader((out / "broken.csv").read_text().splitlines()))
    assert rows == [["name", "reason"], *map(list, zip(broken, reasons, strict=True))]
    for name in broken:
        (folder / name).unlink()
    assert_equal(descriptors.open_store(out), expected(model_file, folder, tmp_path / "alone"))


@pytest.mark.slow
def test_a_killed_worker_is_replaced_and_a_faulty_one_is_told(model_file: Path, folder: Path, tmp_path: Path) -> None:
    summary = describe(model_file, folder, tmp_path / "store", workers=2, worker=Killed)
    assert (tmp_path / "killed").exists()
    assert (summary.pictures, summary.computed) == (PICTURES, PICTURES)
    assert_equal(descriptors.open_store(tmp_path / "store"), expected(model_file, folder, tmp_path / "alone"))
    with pytest.raises(StoreError, match=r"^The workers failed \(ZeroDivisionError: part .*run this again\.$"):
        describe(model_file, folder, tmp_path / "other", worker=Odd)


@pytest.mark.slow
def test_addresses_roles_and_commands(
    model_file: Path, folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Pictures and a store behind addresses, which lpn index copies; broken pictures end with status 1."""
    (folder / "1" / "text.jpg").write_bytes(b"no picture")
    out = tmp_path / "store"
    given = ["describe", "--model", str(model_file), "--view", "drone", "--images", f"file://{folder}"]
    given += ["--out", f"file://{out}", "--precision", "float16"]
    assert main([*given, "--engine", "ray", "--workers", "1"]) == 1
    said = capsys.readouterr().out
    assert "holds 40 descriptors, 40 of them computed now." in said
    assert "1 picture could not be described; broken.csv there gives names" in said
    (folder / "1" / "text.jpg").unlink()
    alone = expected(model_file, folder, tmp_path / "alone")
    assert main(["index", "--descriptors", f"file://{out}", "--out", str(tmp_path / "index")]) == 0
    with open_index(tmp_path / "index") as index:
        assert index.search(alone.descriptors[7], None, 1).ids == [alone.names[7]]
    assert main([*given, "--workers", "2"]) == 2
    assert "--workers is for many workers" in capsys.readouterr().err
    change = {"groups": "satellite, drone", "roles": "role", "source": "1"}
    model = graph(tmp_path / "both.onnx", change=change)
    graph(tmp_path / "both.drone.onnx", change=change, cells="fixed")
    describe(model, folder, tmp_path / "gallery", role="gallery")
    bound = Engine(model).for_task("satellite", "drone")
    assert descriptors.open_store(tmp_path / "gallery").kind == descriptors.DescriptorKind.of_model(bound, "drone")


def test_that_ray_does_not_start_or_is_not_there_is_told_in_a_sentence(monkeypatch: pytest.MonkeyPatch) -> None:
    def init(**_: object) -> None:
        raise Exception("The current node timed out during startup.\nSee the logs.")

    ended: list[bool] = []
    data = SimpleNamespace(DataContext=SimpleNamespace(get_current=SimpleNamespace))
    ray = SimpleNamespace(is_initialized=lambda: False, init=init, shutdown=lambda: ended.append(True), data=data)
    monkeypatch.setattr(many_machines, "importlib", SimpleNamespace(import_module=lambda _: ray))
    with (
        pytest.raises(StoreError, match=r"^Ray does not start on this machine \(The current node timed out during sta"),
        many_machines._ray_session(None, 1, 1),
    ):
        pass
    nobody = f"127.0.0.1:{free_port()}"
    with (
        pytest.raises(InputError, match=f"There is no Ray cluster at {nobody}; start one"),
        many_machines._ray_session(nobody, 1, 1),
    ):
        pass
    assert ended == [True, True]


def test_bad_options_are_refused_in_words(model_file: Path, folder: Path, tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    cases: list[tuple[type[LPNError], str, dict[str, object]]] = [
        (InputError, "expected 1 or more", {"threads": 0}),
        (InputError, "no 'street' view", {"view": "street"}),
        (InputError, "make one with lpn export", {"model": model_file.with_suffix(".safetensors")}),
        (InputError, "cannot be opened", {"pictures": "nowhere://bucket/tiles"}),
        (DataError, "no folder of pictures", {"pictures": folder / "absent"}),
        (DataError, "holds no pictures", {"pictures": tmp_path / "empty"}),
        (DataError, "holds no pictures", {"pictures": f"file://{tmp_path}/empty"}),
    ]
    for kind, said, given in cases:
        options = {"model": model_file, "pictures": folder, "view": "drone", "out": tmp_path / "out"} | given
        with pytest.raises(kind, match=said):
            describe_by_many(**options)
    assert not (tmp_path / "out").exists()
    shutil.rmtree(folder)
