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
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, suppress
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

pytest.importorskip("ray", reason="the extra cluster is not installed")
pytest.importorskip("pyarrow", reason="the extra cluster is not installed")

from lpn import descriptors
from lpn.cli import main
from lpn.cluster import session
from lpn.cluster.driver import Summary, describe_on_workers
from lpn.cluster.session import ray_session
from lpn.cluster.storage import Storage
from lpn.cluster.worker import DescribeWorker
from lpn.core.arrays import Float32Array
from lpn.core.errors import DataError, InputError, LPNError, StoreError
from lpn.core.progress import listening
from lpn.descriptors.partial_store import LOG
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
def pictures(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of pictures; no test may change it."""
    folder = tmp_path_factory.mktemp("described") / "pictures"
    for i in range(PICTURES):
        small_worlds.write(folder / f"{i % 3}" / f"{i:02d}.png", small_worlds.place(i))
    return folder


@pytest.fixture
def folder(pictures: Path, tmp_path: Path) -> Path:
    """The same pictures, with the same times, for one test."""
    return shutil.copytree(pictures, tmp_path / "pictures")


def describe(model_file: Path, folder: Path, out: Path, workers: int = 1, **given: object) -> Summary:
    """Describe by one worker, as each takes seconds to start, where not two are what is tested."""
    return describe_on_workers(model_file, folder, "drone", out, workers=workers, size=8, **given)  # type: ignore[arg-type]


def alone(model_file: Path, folder: Path, out: Path) -> descriptors.Store:
    return descriptors.describe(Engine(model_file), descriptors.pictures_below(folder), "drone", out, root=folder)


def check_equal(out: Path, expected: descriptors.Store) -> None:
    store = descriptors.open_store(out)
    assert store.manifest == expected.manifest
    assert not (out / LOG).exists()
    np.testing.assert_allclose(store.descriptors, expected.descriptors, atol=1e-6)


@pytest.mark.slow
def test_workers_take_the_branch_of_a_role(tmp_path: Path) -> None:
    for i in range(2):
        small_worlds.write(tmp_path / "pictures" / f"{i}.png", small_worlds.place(i))
    change = {"groups": "satellite, drone", "roles": "role", "source": "1"}
    model = graph(tmp_path / "both.onnx", change=change)
    graph(tmp_path / "both.drone.onnx", change=change, cells="fixed")
    bound = Engine(model).for_task("satellite", "drone")
    files = descriptors.pictures_below(tmp_path / "pictures")
    expected = descriptors.describe(bound, files, "drone", tmp_path / "alone", root=tmp_path / "pictures")
    assert expected.manifest.role == "gallery"
    describe(model, tmp_path / "pictures", tmp_path / "gallery", role="gallery")
    check_equal(tmp_path / "gallery", expected)


def test_two_workers_say_what_one_machine_says(model_file: Path, pictures: Path, tmp_path: Path) -> None:
    said: list[tuple[str, int, int]] = []
    with warnings.catch_warnings(), listening(lambda *heard: said.append(heard)):
        warnings.simplefilter("ignore")
        summary = describe(model_file, pictures, tmp_path / "store", workers=2)
    assert summary == Summary(PICTURES, PICTURES, {})
    assert said[0] == ("Describing drone pictures", 0, PICTURES)
    assert said[-1][1:] == (PICTURES, PICTURES)
    check_equal(tmp_path / "store", alone(model_file, pictures, tmp_path / "alone"))
    assert describe(model_file, pictures, tmp_path / "store") == Summary(PICTURES, 0, {})


class Killed(DescribeWorker):
    """Is killed once, in the middle of its second list; writes its process and the first picture of each list to a file."""

    def describe(self, names: Sequence[str]) -> tuple[Float32Array, dict[int, str]]:
        place = Path(self.task.pictures).parent
        with (place / "begun").open("a") as begun:
            begun.write(f"{os.getpid()} {names[0]}\n")
        seen = getattr(self, "seen", 0)
        self.seen = seen + 1
        if seen == 1:
            with suppress(FileExistsError), (place / "killed").open("x") as killed:
                killed.write(f"{os.getpid()} {names[0]}")
                killed.flush()
                os.kill(os.getpid(), signal.SIGKILL)
        return super().describe(names)


@pytest.mark.slow
def test_a_killed_worker_costs_its_own_lists_alone(model_file: Path, folder: Path, tmp_path: Path) -> None:
    out = tmp_path / "store"
    assert describe(model_file, folder, out, workers=2, worker=Killed) == Summary(PICTURES, PICTURES, {})
    begun = [line.split() for line in (tmp_path / "begun").read_text().splitlines()]
    process, lost = (tmp_path / "killed").read_text().split()
    times = Counter(first for _, first in begun)
    assert len(times) == 5
    repeated = {first for first, count in times.items() if count > 1}
    # Its list before the last is lost too if the driver had not heard of that yet.
    assert lost in repeated
    assert repeated <= {first for by, first in begun if by == process}
    assert max(times.values()) == 2
    check_equal(out, alone(model_file, folder, tmp_path / "alone"))


class Odd(DescribeWorker):
    """Fails at every list, as a fault of ours would make it."""

    def describe(self, names: Sequence[str]) -> tuple[Float32Array, dict[int, str]]:
        raise ZeroDivisionError(f"list of {len(names)}")


@pytest.mark.slow
def test_what_workers_cannot_mend_is_one_sentence(model_file: Path, folder: Path, tmp_path: Path) -> None:
    with pytest.raises(StoreError, match=r"^The workers failed \(ZeroDivisionError: list .*run this again\.$"):
        describe(model_file, folder, tmp_path / "store", worker=Odd)


@pytest.mark.slow
def test_changed_pictures_are_computed_and_broken_ones_named(model_file: Path, folder: Path, tmp_path: Path) -> None:
    out = tmp_path / "store"
    alone(model_file, folder, out)  # a store of one machine, which the workers continue
    broken = {"0/cut.png": "is cut short or damaged", "1/text.jpg": "is not a picture that can be read"}
    broken["2/spoilt.png"] = "is damaged"
    (folder / "0" / "cut.png").write_bytes((folder / "0" / "00.png").read_bytes()[:-500])
    (folder / "1" / "text.jpg").write_bytes(b"no picture")
    small_worlds.spoilt_png(folder / "2" / "spoilt.png")
    small_worlds.write(folder / "0" / "00.png", small_worlds.place(51))
    small_worlds.write(folder / "3" / "new.png", small_worlds.place(52))
    (folder / "2" / "02.png").unlink()
    assert describe(model_file, folder, out) == Summary(PICTURES + 3, 2, broken)
    rows = list(csv.reader((out / "broken.csv").read_text().splitlines()))
    assert rows == [["name", "reason"], *map(list, broken.items())]
    assert describe(model_file, folder, out) == Summary(PICTURES + 3, 0, broken)
    for name in broken:
        (folder / name).unlink()
    check_equal(out, alone(model_file, folder, tmp_path / "alone"))


DRIVER = """
import sys, time
from pathlib import Path
from lpn.cluster.driver import describe_on_workers
from lpn.cluster.worker import DescribeWorker

class Slow(DescribeWorker):
    def describe(self, names):
        time.sleep(1.0)
        return super().describe(names)

describe_on_workers(Path(sys.argv[1]), sys.argv[2], "drone", Path(sys.argv[3]), workers=2, size=8, worker=Slow)
"""


@pytest.mark.slow
def test_a_killed_driver_leaves_what_was_done(model_file: Path, folder: Path, tmp_path: Path) -> None:
    out = tmp_path / "store"
    driver = subprocess.Popen(
        [sys.executable, "-c", DRIVER, str(model_file), str(folder), str(out)],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    try:
        end = time.monotonic() + 6000
        while not (out / LOG).exists() or (out / LOG).stat().st_size < 8 * 4 * 4:
            assert driver.poll() is None, "the driver ended before it was killed"
            assert time.monotonic() < end
            time.sleep(0.02)
        logged = (out / LOG).stat().st_size
        while (out / LOG).stat().st_size == logged:
            assert driver.poll() is None, "the driver ended before it was killed"
            assert time.monotonic() < end
            time.sleep(0.02)
    finally:
        driver.kill()
        driver.wait()
    summary = describe(model_file, folder, out)
    assert 0 < summary.computed < PICTURES
    check_equal(out, alone(model_file, folder, tmp_path / "alone"))


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
            head.kill()  # what it started ends with it
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
    out = tmp_path / "store"
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
def test_the_command_says_what_it_did(
    model_file: Path, folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (folder / "1" / "text.jpg").write_bytes(b"no picture")
    out = tmp_path / "store"
    common = ["describe", "--model", str(model_file), "--view", "drone", "--engine", "ray", "--workers", "1"]
    given = [*common, "--images", f"file://{folder}", "--out", str(out), "--precision"]
    assert main.main([*given, "int8"]) == 1
    said = capsys.readouterr().out
    assert f"{out} holds 40 descriptors, 40 of them computed now." in said
    assert "1 pictures could not be described; broken.csv there names them" in said
    (folder / "1" / "text.jpg").unlink()
    expected = alone(model_file, folder, tmp_path / "alone")
    np.testing.assert_allclose(descriptors.open_store(out).float32, expected.descriptors, atol=0.01)
    assert main.main([*given, "float32"]) == 2
    assert "choose another folder" in capsys.readouterr().err
    assert main.main([*common[:5], "--images", str(folder), "--out", str(out), "--workers", "2"]) == 2
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
        with pytest.raises(FileNotFoundError):
            storage.read("absent")


@pytest.mark.parametrize(
    ("given", "error", "said"),
    [
        ({"threads": 0}, InputError, "expected 1 or more"),
        ({"view": "street"}, InputError, "no 'street' view"),
        ({"model": Path("m.safetensors")}, InputError, "make one with lpn export"),
        ({"pictures": "nowhere://bucket/tiles"}, InputError, "cannot be opened"),
        ({"pictures": "absent"}, DataError, "cannot be listed"),
        ({"pictures": "empty"}, DataError, "holds no pictures"),
    ],
    ids=lambda value: str(value) if isinstance(value, dict) else "",
)
def test_bad_options_are_refused(
    given: dict[str, Any],
    error: type[LPNError],
    said: str,
    model_file: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("empty").mkdir()
    options = {"model": model_file, "pictures": "empty", "view": "drone", "out": tmp_path / "out"} | given
    with pytest.raises(error, match=said):
        describe_on_workers(**options)
    assert not (tmp_path / "out").exists()
