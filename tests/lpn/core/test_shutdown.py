"""Ctrl-C and SIGTERM: writes are finished, and one sentence tells how to resume."""

from __future__ import annotations

import os
import signal
import sys
import threading
import time
from pathlib import Path

import pytest

from lpn import descriptors
from lpn.cli import main
from lpn.cli.parsing import modes
from lpn.core import shutdown
from lpn.core.files import write_atomic
from lpn.core.shutdown import StopSignals, uninterrupted, writes_finished
from lpn.descriptors import open_store
from lpn.doctor.verify import verify
from tools.fixtures import small_worlds
from tools.fixtures.processes import Process

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="signals are POSIX's")

SLOW_DESCRIBING = """
import time, lpn.descriptors.writer as d
prepare_row = d.prepare_row
d.prepare_row = lambda *a: (time.sleep(0.15), prepare_row(*a))[1]
"""
# It ignores the first signal, as a callback of a library may, and then writes.
STUBBORN = """
import time, lpn.cli.doctor as v
from lpn.core.shutdown import uninterrupted
def run(self):
    try:
        print("computing", flush=True)
        time.sleep(600)
    except KeyboardInterrupt:
        with uninterrupted():
            print("going on", flush=True)
            time.sleep(600)
v.DoctorCommand.run = run
"""


def last_line(process: Process) -> str:
    lines = [line for line in process.err.splitlines() if line.startswith("lpn: ")]
    assert len(lines) == 1, process.err
    return lines[0]


def half_written(folder: Path) -> list[Path]:
    return [*folder.rglob("*.part")]


def training(data: Path, out: Path) -> list[object]:
    """The arguments of a small training."""
    options: list[object] = ["--recipe", "small", "--size", 64, "--batch", 4, "--from-scratch"]
    return ["train", "--data", data, "--out", out, *options]


@pytest.mark.slow
def test_a_training_keeps_whole_epochs_and_says_how_to_go_on(tmp_path: Path) -> None:
    data, out = small_worlds.make_dataset(tmp_path / "places", train=4, test=2), tmp_path / "run"
    given = [*training(data, out), "--epochs", 1000, "--n-parts", 2]
    with Process(given, tmp_path / "cache") as process:
        process.until((out / "state.pt").is_file)
        process.interrupt()
        status, _ = process.ended()
        assert status == 130
        assert last_line(process) == (
            f"lpn: Stopped. The finished epochs in {out} are kept; go on with lpn train --out {out} --resume."
        )
        assert not half_written(out)
        assert all(verdict.healthy for verdict in verify(out))
        with Process(["train", "--out", out, "--resume"], tmp_path / "again") as again:
            again.until(lambda: "Resuming after epoch" in again.out and "Epoch" in again.out)
            again.terminate()
            assert again.ended()[0] == 143
            assert last_line(again).endswith(f"go on with lpn train --out {out} --resume.")


@pytest.mark.parametrize("how", ["interrupt", "terminate"])
def test_a_description_goes_on_where_it_was_stopped(how: str, model_file: Path, data: Path, tmp_path: Path) -> None:
    out = tmp_path / "store"
    pictures = data / "test"
    given: list[object] = ["describe", "--model", model_file, "--images", pictures, "--view", "drone", "--out", out]
    with Process(given, tmp_path / "cache", SLOW_DESCRIBING) as process:
        process.until(lambda: any(out.glob("*/rows.json")))
        getattr(process, how)()
        assert process.ended()[0] == (130 if how == "interrupt" else 143)
        assert last_line(process) == f"lpn: Stopped. The descriptors in {out} are kept; the same command goes on."
        assert not half_written(out)
        assert not (out / "store.json").exists()
        assert main.main([str(one) for one in given]) == 0
        assert len(open_store(out).descriptors) == len(descriptors.pictures_below(data / "test"))


def test_a_second_signal_ends_at_once_whatever_is_being_written(tmp_path: Path) -> None:
    with Process(["doctor"], tmp_path / "cache", STUBBORN) as process:
        process.until(lambda: "computing" in process.out)
        process.terminate()
        process.until(lambda: "going on" in process.out)
        process.interrupt()
        status, _ = process.ended()
        assert status == 143
        assert process.err == ""


def test_a_file_is_written_to_its_end_before_the_stop(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    replace = os.replace

    def slow(*given: Path) -> None:
        os.kill(os.getpid(), signal.SIGINT)
        time.sleep(0.05)
        replace(*given)

    monkeypatch.setattr(os, "replace", slow)
    stop = StopSignals(lambda _: 0)
    with stop.listening(), pytest.raises(KeyboardInterrupt):
        write_atomic(tmp_path / "file", b"whole")
    assert (tmp_path / "file").read_bytes() == b"whole"
    assert stop.signal == signal.SIGINT
    assert writes_finished(0)


def test_files_that_belong_together_are_written_together(tmp_path: Path) -> None:
    def write() -> None:
        with uninterrupted():
            os.kill(os.getpid(), signal.SIGTERM)
            for name in ("one", "two"):
                write_atomic(tmp_path / name, b"whole")

    with StopSignals(lambda _: 0).listening(), pytest.raises(KeyboardInterrupt):
        write()
    assert (tmp_path / "two").read_bytes() == b"whole"


def test_what_another_thread_writes_is_waited_for() -> None:
    begun = threading.Event()

    def write() -> None:
        with uninterrupted():
            begun.set()
            time.sleep(0.3)

    thread = threading.Thread(target=write)
    thread.start()
    begun.wait()
    assert not writes_finished(0.01)
    assert writes_finished(5)
    thread.join()


def test_afterwards_signals_do_what_they_did(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before = [signal.getsignal(number) for number in shutdown.SIGNALS]
    assert main.main(["doctor", str(tmp_path / "absent")]) == 2

    def interrupted(_: object) -> int:
        raise KeyboardInterrupt

    monkeypatch.setattr(main.commands()["doctor"], "run", interrupted)
    assert main.main(["doctor"]) == 130
    assert [signal.getsignal(number) for number in shutdown.SIGNALS] == before


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["train", "--data", "x", "--out", "OUT"], "No epoch was finished yet, so nothing is kept; give the same"),
        (["reproduce", "table1", "--data", "x", "--out", "OUT"], "Whole epochs and measurements in OUT are kept"),
        (["index", "--descriptors", "s", "--out", "OUT"], "The tiles that OUT has by now are kept; the same command"),
        (["export", "--model", "m", "--out", "OUT"], "Nothing is half-written; give the same command again."),
    ],
)
def test_every_command_says_how_to_go_on(
    arguments: list[str], said: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(_: object) -> int:
        raise KeyboardInterrupt

    command = main.commands()[arguments[0]]
    chosen = next((mode for option, mode in modes(command).items() if option in arguments), command)
    monkeypatch.setattr(chosen, "run", interrupted)
    assert main.main(arguments) == 130
    assert capsys.readouterr().err.startswith(f"lpn: Stopped. {said}")
