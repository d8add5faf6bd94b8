"""Describing with many workers. Ray is started once for the module, with two workers."""

from __future__ import annotations

import csv
import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
import warnings
from collections import Counter
from collections.abc import Iterator
from contextlib import ExitStack, suppress
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("ray", reason="the extra cluster is not installed")
pytest.importorskip("pyarrow", reason="the extra cluster is not installed")

from lpn import descriptors
from lpn.cli import main
from lpn.cluster import session
from lpn.cluster.driver import Summary, describe_parts
from lpn.cluster.parts import PartItem, open_parts, to_store
from lpn.cluster.session import ray_session
from lpn.cluster.storage import Storage
from lpn.cluster.worker import DescribeWorker
from lpn.core.errors import DataError, InputError, LPNError, StoreError
from lpn.index import open_index
from lpn.index.tiles import open_tiles
from lpn.models.onnx_engine import Engine
from tests.lpn.models.test_own_models import graph
from tools.fixtures import small_worlds
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
                    running.enter_context(ray_session(None, 2, 1))
                    break
                except StoreError:
                    if not attempts_left:
                        raise
            yield


@pytest.fixture(scope="module")
def described(model_file: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path, Summary, list[str]]:
    """Pictures, their parts, and what was said; no test may change them."""
    root, lines = tmp_path_factory.mktemp("described"), []
    for i in range(PICTURES):
        small_worlds.write(root / "pictures" / f"{i % 3}" / f"{i:02d}.png", small_worlds.place(i))
    out = root / "parts"
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        summary = describe_parts(model_file, root / "pictures", "drone", out, workers=2, size=8, say=lines.append)
    return root / "pictures", out, summary, lines


@pytest.fixture
def folder(described: tuple[Path, Path, Summary, list[str]], tmp_path: Path) -> Path:
    """The same pictures, with the same times, for one test."""
    return shutil.copytree(described[0], tmp_path / "pictures")


@pytest.fixture
def done(described: tuple[Path, Path, Summary, list[str]], tmp_path: Path) -> Path:
    """Their parts, for one test."""
    return shutil.copytree(described[1], tmp_path / "parts")


def describe(model_file: Path, folder: Path, out: Path, workers: int = 1, **given: object) -> Summary:
    """By one worker, as each takes seconds to start, where not two are what is tested."""
    return describe_parts(model_file, folder, "drone", out, workers=workers, size=8, say=lambda _: None, **given)  # type: ignore[arg-type]


def expected(model_file: Path, folder: Path, out: Path) -> descriptors.Store:
    return descriptors.describe(Engine(model_file), descriptors.pictures_below(folder), "drone", out, root=folder)


def held(out: Path) -> dict[str, np.ndarray]:
    """Descriptors by name, each name once."""
    parts = open_parts(out)
    found = [
        (one.row.file, row) for part in parts.parts for one, row in zip(part.items, parts.vectors(part), strict=True)
    ]
    assert len(dict(found)) == len(found)
    return dict(found)


@pytest.mark.slow
def test_workers_take_the_branch_of_a_role(tmp_path: Path) -> None:
    for i in range(2):
        small_worlds.write(tmp_path / "pictures" / f"{i}.png", small_worlds.place(i))
    change = {"groups": "satellite, drone", "roles": "role", "source": "1"}
    model = graph(tmp_path / "both.onnx", change=change)
    graph(tmp_path / "both.drone.onnx", change=change, cells="fixed")
    bound = Engine(model).for_task("satellite", "drone")
    files = descriptors.pictures_below(tmp_path / "pictures")
    alone = descriptors.describe(bound, files, "drone", tmp_path / "alone", root=tmp_path / "pictures")
    describe(model, tmp_path / "pictures", tmp_path / "gallery", role="gallery")
    store = to_store(open_parts(tmp_path / "gallery"), tmp_path / "store")
    assert store.manifest == alone.manifest
    assert store.manifest.role == "gallery"
    np.testing.assert_allclose(store.descriptors, alone.descriptors, atol=1e-6)
    assert open_tiles(str(tmp_path / "gallery")).kind.fingerprint == bound.fingerprint
    describe(model, tmp_path / "pictures", tmp_path / "query")
    with pytest.raises(InputError, match="branch for queries, and an index holds a gallery"):
        open_tiles(str(tmp_path / "query"))


def test_two_workers_say_what_one_machine_says(
    model_file: Path, described: tuple[Path, Path, Summary, list[str]], tmp_path: Path
) -> None:
    pictures, out, summary, lines = described
    assert (summary.pictures, summary.computed, summary.broken) == (PICTURES, PICTURES, [])
    assert "40 of 40 pictures" in lines[-1]
    assert "per second" in lines[-1]
    alone = expected(model_file, pictures, tmp_path / "alone")
    store = to_store(open_parts(out), tmp_path / "store")
    assert store.manifest == alone.manifest
    np.testing.assert_allclose(store.descriptors, alone.descriptors, atol=1e-6)
    found = held(out)
    for row, descriptor in zip(alone.manifest.rows, alone.descriptors, strict=True):
        np.testing.assert_allclose(found[row.file], descriptor, atol=1e-6)
    assert (out / "broken.csv").read_text() == "name,reason\n"
    before = {path.name: path.stat().st_mtime_ns for path in out.glob("part-*.zip")}
    assert describe(model_file, pictures, out).computed == 0
    assert {path.name: path.stat().st_mtime_ns for path in out.glob("part-*.zip")} == before


class Killed(DescribeWorker):
    """Is killed once, in the middle of its second part; writes its process and the first picture of each part to a file."""

    def describe(self, items: list[PartItem]) -> tuple[int, int]:
        with (Path(self.task.out).parent / "begun").open("a") as begun:
            begun.write(f"{os.getpid()} {items[0].row.file}\n")
        fuse = Path(self.task.out).parent / "killed"
        seen = getattr(self, "seen", 0)
        self.seen = seen + 1
        if seen == 1:
            try:
                with fuse.open("x") as killed:
                    killed.write(f"{os.getpid()} {items[0].row.file}")
            except FileExistsError:
                pass
            else:
                os.kill(os.getpid(), signal.SIGKILL)
        return super().describe(items)


@pytest.mark.slow
def test_a_killed_worker_costs_its_own_parts_alone(model_file: Path, folder: Path, tmp_path: Path) -> None:
    out = tmp_path / "parts"
    summary = describe(model_file, folder, out, workers=2, worker=Killed)
    assert (summary.pictures, summary.computed, summary.broken) == (PICTURES, PICTURES, [])
    begun = [line.split() for line in (tmp_path / "begun").read_text().splitlines()]
    process, lost = (tmp_path / "killed").read_text().split()
    times = Counter(first for _, first in begun)
    assert len(times) == 5
    repeated = {first for first, count in times.items() if count > 1}
    # Its part before the last is lost too if the driver had not heard of that yet.
    assert lost in repeated
    assert repeated <= {first for by, first in begun if by == process}
    assert max(times.values()) == 2
    alone = expected(model_file, folder, tmp_path / "alone")
    store = to_store(open_parts(out), tmp_path / "store")
    assert store.manifest == alone.manifest
    np.testing.assert_allclose(store.descriptors, alone.descriptors, atol=1e-6)


class Odd(DescribeWorker):
    """Fails at every part, as a fault of ours would make it."""

    def describe(self, items: list[PartItem]) -> tuple[int, int]:
        raise ZeroDivisionError(f"part of {len(items)}")


@pytest.mark.slow
def test_what_workers_cannot_mend_is_one_sentence(model_file: Path, folder: Path, tmp_path: Path) -> None:
    with pytest.raises(StoreError, match=r"^The workers failed \(ZeroDivisionError: part .*run this again\.$"):
        describe(model_file, folder, tmp_path / "parts", worker=Odd)


@pytest.mark.slow
def test_what_changed_alone_is_computed_and_what_is_broken_is_named(
    model_file: Path, folder: Path, done: Path, tmp_path: Path
) -> None:
    broken = ["0/cut.png", "1/text.jpg", "2/spoilt.png"]
    (folder / broken[0]).write_bytes((folder / "0" / "00.png").read_bytes()[:-500])
    (folder / broken[1]).write_bytes(b"no picture")
    small_worlds.spoilt_png(folder / broken[2])
    small_worlds.write(folder / "0" / "00.png", small_worlds.place(51))
    small_worlds.write(folder / "3" / "new.png", small_worlds.place(52))
    (folder / "2" / "02.png").unlink()
    names = [path.relative_to(folder).as_posix() for path in descriptors.pictures_below(folder)]
    (folder / "geo.csv").write_text("path,latitude,longitude\n" + "".join(f"{name},46.5,7.25\n" for name in names))
    summary = describe(model_file, folder, done)
    assert (summary.pictures, summary.computed) == (len(names), 2)
    assert [one.item.row.file for one in summary.broken] == broken
    reasons = ["is cut short or damaged", "is not a picture that can be read", "is damaged"]
    rows = list(csv.reader((done / "broken.csv").read_text().splitlines()))
    assert rows == [["name", "reason"], *map(list, zip(broken, reasons, strict=True))]
    assert set(held(done)) == set(names) - set(broken)
    assert all((part.positions == (46.5, 7.25)).all() for part in open_parts(done).parts)
    again = describe(model_file, folder, done)
    assert (again.computed, again.broken) == (0, summary.broken)
    for name in broken:
        (folder / name).unlink()
    alone = expected(model_file, folder, tmp_path / "alone")
    np.testing.assert_allclose(to_store(open_parts(done), tmp_path / "store").descriptors, alone.descriptors, atol=1e-6)


DRIVER = """
import sys, time
from pathlib import Path
from lpn.cluster.driver import describe_parts
from lpn.cluster.worker import DescribeWorker

class Slow(DescribeWorker):
    def describe(self, items):
        time.sleep(1.0)
        return super().describe(items)

describe_parts(Path(sys.argv[1]), sys.argv[2], "drone", sys.argv[3], workers=2, size=8, worker=Slow)
"""


@pytest.mark.slow
def test_a_killed_driver_leaves_what_was_done(model_file: Path, folder: Path, tmp_path: Path) -> None:
    out = tmp_path / "parts"
    driver = subprocess.Popen(
        [sys.executable, "-c", DRIVER, str(model_file), str(folder), str(out)],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    try:
        end = time.monotonic() + 6000
        while not list(out.glob("part-*.zip")):
            assert driver.poll() is None, "the driver ended before it was killed"
            assert time.monotonic() < end
            time.sleep(0.02)
    finally:
        driver.kill()
        driver.wait()
    with pytest.raises(StoreError, match="has not ended; wait for it, or run lpn describe --engine ray again"):
        open_parts(out)
    summary = describe(model_file, folder, out)
    assert 0 < summary.computed < PICTURES
    assert len(held(out)) == PICTURES


@pytest.mark.slow
def test_parts_are_indexed_with_their_positions(
    model_file: Path, folder: Path, done: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Given to describe in a file above the pictures, and so named as `lpn index --data` takes them."""
    names = [path.relative_to(folder).as_posix() for path in descriptors.pictures_below(folder)]
    places = {name: (place, 2 * place) for place, name in enumerate(names, start=1)}
    lines = [f"{folder.name}/{name},{latitude},{longitude}\n" for name, (latitude, longitude) in places.items()]
    (tmp_path / "geo.csv").write_text("path,latitude,longitude\n" + "".join(lines))
    (folder / "0" / "text.jpg").write_bytes(b"no picture")
    with (tmp_path / "geo.csv").open("a") as more:
        more.write(f"{folder.name}/0/text.jpg,1,1\n")
    assert describe(model_file, folder, done, positions=tmp_path / "geo.csv").computed == 0
    for where, more in ((str(done), []), (f"file://{done}", []), (str(done), ["--data", str(tmp_path)])):
        out = tmp_path / f"index{len(list(tmp_path.iterdir()))}"
        making = ["index", "--descriptors", where, "--out", str(out), *more]
        assert main.main(making) == 0
        said = capsys.readouterr().out
        assert "holds 40 tiles, 40 of them added now" in said
        assert "1 pictures are broken and not in it" in said
        assert main.main(making) == 0
        assert "40 were there already" in capsys.readouterr().out
        with open_index(out) as index:
            for name, row in list(held(done).items())[:5]:
                found = index.search(row, None, 1, (places[name][0], -180, places[name][0], 180))
                assert found.ids == [name]
                np.testing.assert_array_equal(found.vectors[0], row)
                np.testing.assert_array_equal(found.positions[0], places[name])


@pytest.fixture
def cluster() -> Iterator[str]:
    """The address of a cluster of one machine with one core, which ends with the test."""
    port = free_port()
    with tempfile.TemporaryDirectory(prefix="lpn-", dir="/tmp", ignore_cleanup_errors=True) as short:
        log = Path(short, "log")
        sizes = ["--num-cpus=1", f"--object-store-memory={80 << 20}", "--min-worker-port=0", "--max-worker-port=0"]
        quiet = ["--include-dashboard=false", "--disable-usage-stats", f"--temp-dir={short}/ray"]
        starting = ["start", "--head", "--block", "--node-ip-address=127.0.0.1", f"--port={port}", *sizes, *quiet]
        with log.open("wb") as said:
            head = subprocess.Popen([sys.executable, "-m", "ray.scripts.scripts", *starting], stdout=said, stderr=said)
        try:
            end = time.monotonic() + 600
            while b"will now block" not in log.read_bytes():
                assert head.poll() is None, log.read_text()
                assert time.monotonic() < end, log.read_text()
                time.sleep(0.05)
            yield f"127.0.0.1:{port}"
        finally:
            head.kill()  # its children end with it
            head.wait()


COMMANDS = """
import json, sys, time
from lpn.cli.main import main

for given in json.loads(sys.argv[1]):
    began = time.monotonic()
    status = main(given)
    sys.stdout.flush()
    print(json.dumps([status, time.monotonic() - began]), file=sys.stderr, flush=True)
"""


@pytest.mark.slow
def test_a_cluster_is_joined_by_its_address_and_one_that_is_not_there_is_told(
    model_file: Path, folder: Path, cluster: str, tmp_path: Path
) -> None:
    """In a process that has no Ray yet; one for all of these, as it takes seconds to load."""
    out = tmp_path / "parts"
    common = ["describe", "--engine", "ray", "--model", str(model_file), "--images", str(folder), "--view", "drone"]
    common += ["--out", str(out), "--address"]
    with socket.create_server(("127.0.0.1", 0)) as closed:
        nobody = f"127.0.0.1:{closed.getsockname()[1]}"
    with socket.create_server(("127.0.0.1", 0)) as web:
        threading.Thread(target=_answers, args=(web,), daemon=True).start()
        other = f"127.0.0.1:{web.getsockname()[1]}"
        given = [[*common, nobody], [*common, other], [*common, cluster, "--threads", "2"], [*common, cluster]]
        ran = subprocess.run(
            [sys.executable, "-c", COMMANDS, json.dumps(given)], capture_output=True, text=True, timeout=900, check=True
        )
    absent = "There is no Ray cluster at {}; start one with ray start, or check the address."
    said = [line for line in ran.stderr.splitlines() if line]
    ends = [json.loads(line) for line in said if line.startswith("[")]
    assert [status for status, _ in ends] == [2, 2, 2, 0], ran.stderr
    assert max(seconds for _, seconds in ends[:2]) < 240  # Ray itself waits for minutes
    sentences = [line for line in said if not line.startswith("[")]
    assert [any(text in line for line in sentences) for text in (absent.format(nobody), absent.format(other))] == [
        True
    ] * 2
    assert any("No machine of the cluster has 2 cores; give fewer --threads." in line for line in sentences)
    assert len(sentences) == 3, sentences
    assert f"{out} holds {PICTURES} descriptors, {PICTURES} of them computed now." in ran.stdout
    assert len(held(out)) == PICTURES


def _answers(server: socket.socket) -> None:
    """A web server, as far as Ray would know."""
    with suppress(OSError):
        connection, _ = server.accept()
        with connection:
            connection.recv(100)
            connection.sendall(b"HTTP/1.1 400 Bad Request\r\nContent-Length: 0\r\n\r\n")


def test_that_ray_does_not_start_is_told_in_a_sentence(monkeypatch: pytest.MonkeyPatch) -> None:
    def init(**_: object) -> None:
        raise Exception("The current node timed out during startup.\nSee the logs.")

    ended: list[bool] = []
    ray = SimpleNamespace(is_initialized=lambda: False, init=init, shutdown=lambda: ended.append(True))
    monkeypatch.setattr(session, "importlib", SimpleNamespace(import_module=lambda _: ray))
    with (
        pytest.raises(
            StoreError, match=r"^Ray does not start on this machine \(The current node timed out during startup\.\); "
        ),
        ray_session(None, 1, 1),
    ):
        pass
    assert ended == [True]


@pytest.mark.slow
def test_commands_say_what_they_did(
    model_file: Path, folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (folder / "1" / "text.jpg").write_bytes(b"no picture")
    out = tmp_path / "parts"
    common = ["describe", "--model", str(model_file), "--view", "drone", "--engine", "ray", "--workers", "1"]
    given = [*common, "--images", f"file://{folder}", "--out", str(out), "--precision", "float16"]
    assert main.main(given) == 1
    said = capsys.readouterr().out
    assert f"{out} holds 40 descriptors, 40 of them computed now." in said
    assert "1 pictures could not be described; broken.csv there names them" in said
    assert main.main(["describe", "--parts", str(out), "--out", str(tmp_path / "store")]) == 0
    assert f"1 pictures are broken and not in it; broken.csv in {out} names them." in capsys.readouterr().out
    (folder / "1" / "text.jpg").unlink()
    store = descriptors.open_store(tmp_path / "store")
    alone = expected(model_file, folder, tmp_path / "alone")
    assert (store.manifest.precision, store.manifest.rows) == ("float16", alone.manifest.rows)
    np.testing.assert_allclose(store.float32, alone.descriptors, atol=2e-4)
    assert main.main([*given[:-2], "--precision", "float32"]) == 2
    assert "choose another place" in capsys.readouterr().err
    assert main.main([*given[:-2], "--precision", "int8"]) == 2
    assert "float32 or float16" in capsys.readouterr().err
    locally = [*common[:5], "--images", str(folder), "--out", str(out), "--workers", "2"]
    assert main.main(locally) == 2
    assert "--workers is for many workers" in capsys.readouterr().err


def test_object_storage_is_read_like_a_folder(folder: Path) -> None:
    names = [str(path.relative_to(folder)) for path in descriptors.pictures_below(folder)]
    (folder / ".hidden").mkdir()
    small_worlds.write(folder / ".hidden" / "a.png", small_worlds.place(0))
    for where in (folder, f"file://{folder}", f"local://{folder}"):  # the last is opened by fsspec
        storage = Storage(where)
        rows = storage.files((".png",))
        assert [row.file for row in rows] == names
        assert [row.size for row in rows] == [(folder / name).stat().st_size for name in names]
        assert storage.read(names[0]) == (folder / names[0]).read_bytes()
        storage.write("new.txt", b"whole")
        assert (folder / "new.txt").read_bytes() == b"whole"
        with pytest.raises(FileNotFoundError):
            storage.read("absent")


def test_bad_options_are_refused_in_words(model_file: Path, folder: Path, tmp_path: Path) -> None:
    empty = tmp_path / "empty.csv"
    empty.write_text("path,latitude,longitude\n")
    cases: list[tuple[type[LPNError], str, dict[str, object]]] = [
        (InputError, "expected 1 or more", {"threads": 0}),
        (InputError, "no 'street' view", {"view": "street"}),
        (InputError, "make one with lpn export", {"model": model_file.with_suffix(".safetensors")}),
        (InputError, "cannot be opened", {"pictures": "nowhere://bucket/tiles"}),
        (DataError, "cannot be listed", {"pictures": folder / "absent"}),
        (DataError, "holds no pictures", {"pictures": model_file.parent}),
        (DataError, "no file of positions", {"positions": folder / "absent.csv"}),
        (DataError, "no position for 40 of 40 pictures", {"positions": empty}),
    ]
    for kind, said, given in cases:
        options = {"model": model_file, "pictures": folder, "view": "drone", "out": tmp_path / "out"} | given
        with pytest.raises(kind, match=said):
            describe_parts(**options)  # type: ignore[arg-type]
    assert not list(tmp_path.glob("out/part-*.zip"))
    with pytest.raises(StoreError, match="no folder of parts"):
        open_parts(tmp_path)
