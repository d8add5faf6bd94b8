"""A full disk while a person's work is saved: the old file stays whole, one sentence says so, and saving again works."""

from __future__ import annotations

import os
import resource
import shutil
import subprocess
import sys
from collections.abc import Iterator
from contextlib import suppress
from multiprocessing import get_context
from pathlib import Path

import pytest

from lpn.core.errors import OutputError
from lpn.flight.locate.located import StageRecord
from lpn.flight.locate.registered_stage import append_record, read_records
from lpn.flight.locate.tracks import write_track
from tests.conftest import Refused
from tools.fixtures import saves


@pytest.fixture
def disk(tmp_path: Path) -> Iterator[Path]:
    """A disk of 256 kB."""
    folder = tmp_path / "disk"
    folder.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=256k", "tmpfs", str(folder)]
    if not shutil.which("mount") or subprocess.run(mount, capture_output=True, check=False).returncode:
        pytest.skip("a small disk can be mounted by root alone")
    yield folder
    subprocess.run(["umount", "-l", str(folder)], check=True)


def fill(folder: Path) -> Path:
    """Fill the disk of a folder to its last byte, and return the file that does; deleting it frees the disk."""
    file = folder / "filler"
    with file.open("wb", buffering=0) as stream:
        for size in (65536, 4096, 1):
            with suppress(OSError):
                while stream.write(bytes(size)) == size:
                    pass
    return file


@pytest.mark.parametrize("kind", saves.SAVES)
def test_what_was_saved_stays_whole_and_saving_again_works(kind: str, disk: Path) -> None:
    for save in saves.SAVES.values():
        save(disk, 0)
    before = {file: file.read_bytes() for file in disk.rglob("*") if file.is_file()}
    filler = fill(disk)
    with pytest.raises(OutputError, match=r"cannot be written \(No space left on device\); free space or choose"):
        saves.SAVES[kind](disk, 1)
    assert {file: file.read_bytes() for file in disk.rglob("*") if file.is_file() and file != filler} == before
    filler.unlink()
    saves.SAVES[kind](disk, 1)
    assert saves.saved(disk) == dict.fromkeys(saves.SAVES, 1) | {kind: 2}


POINT = {"frame": "a.jpg", "stage": "retrieval", "state": "accepted", "latitude": 46.0, "longitude": 7.0}


@pytest.mark.skipif(sys.platform == "win32", reason="limits of a process are POSIX's")
def test_a_disk_that_fills_up_within_a_file_leaves_the_old_one(tmp_path: Path) -> None:
    """As a quota does, in a process of its own: the limit holds for every file that it writes."""
    track = tmp_path / "track.kml"
    write_track(track, "monday", [POINT])
    before = track.read_bytes()
    process = get_context("fork").Process(target=_write_beyond_the_limit, args=(track,))
    process.start()
    process.join()
    assert process.exitcode == 0
    assert {file: file.read_bytes() for file in tmp_path.iterdir()} == {track: before}


def _write_beyond_the_limit(track: Path) -> None:
    resource.setrlimit(resource.RLIMIT_FSIZE, (10_000, 10_000))
    points = [POINT | {"frame": f"{i}.jpg"} for i in range(999)]
    try:
        write_track(track, "monday", points)
    except OutputError as error:
        os._exit(0 if "cannot be written (File too large)" in str(error) else 1)
    os._exit(2)


def test_answers_of_a_flight_that_cannot_be_kept_are_told_and_those_before_stay(disk: Path) -> None:
    file, answer = disk / "answers.jsonl", StageRecord("accepted", "40 matches agree. " * 400)
    append_record(file, "a.jpg", answer)
    filler = fill(disk)
    with pytest.raises(
        OutputError, match=r"cannot be written \(No space left on device\); free space or set LPN_CACHE"
    ):
        append_record(file, "b.jpg", answer)
    filler.unlink()
    append_record(file, "c.jpg", answer)
    assert read_records(file) == {"a.jpg": answer, "c.jpg": answer}


def test_a_full_disk_is_one_sentence_and_leaves_nothing_whole(
    disk: Path, model_file: Path, data: Path, refused: Refused
) -> None:
    """In a process of its own: a mapped file on a full disk would end it without a word."""
    given = ["--model", str(model_file), "--images", str(data), "--view", "drone", "--out", str(disk / "s")]
    done = subprocess.run(
        [sys.executable, "-m", "lpn", "describe", *given], capture_output=True, text=True, check=False
    )
    assert done.returncode == 2, done.stderr
    assert "cannot be written (No space left on device); free space or choose another folder." in done.stderr
    assert "Traceback" not in done.stderr
    assert not [file for file in disk.rglob("*") if file.name == "store.json"]
    checkpoint = model_file.with_suffix(".safetensors")
    assert "free space" in refused("export", "--model", checkpoint, "--out", disk / "m.onnx")
    assert not list(disk.glob("m.onnx*"))
