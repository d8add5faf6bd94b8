"""SIGKILL at any moment: all files are whole, and the next run resumes or starts clean.

World is painted rather than rendered here; tests/tools_world/test_world.py renders, stops, and resumes one where Blender is.
"""

from __future__ import annotations

import csv
import json
import os
import shutil
import signal
import sys
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from random import Random

import numpy as np
import pytest

import lpn
from lpn import descriptors, index
from lpn.core.errors import DataError, StoreError
from lpn.core.images import load_picture
from lpn.datasets import open_dataset
from lpn.flight.files import write_flight
from tests.lpn.flight.locate.scenery import land, small_flight, write_map
from tools.fixtures import saves, small_models, small_worlds
from tools.fixtures.killed_commands import WORLD, Killer

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="SIGKILL is POSIX's")
# Kills of a command that takes a moment; half of them between two steps on the disk, half by time.
ROUNDS = int(os.environ.get("LPN_KILLS", "4"))
# Kills of a command that takes seconds. The first is between two steps on the disk: by time it would mostly come before any.
FEW = max(ROUNDS // 4, 1)


@dataclass(frozen=True)
class Command:
    """A command, its condition after any kill, and its final result.

    Attributes:
        arguments: of `lpn`.
        whole: raises where something under a final name cannot be read as whole.
        result: what an uninterrupted run makes, to be compared.
        again: the arguments of the run after a kill.
    """

    arguments: list[str]
    whole: Callable[[], object]
    result: Callable[[], object]
    again: Callable[[], list[str]] | None = None


@pytest.fixture(scope="module")
def places(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return small_worlds.make_dataset(tmp_path_factory.mktemp("few") / "places", train=4, test=4)


@pytest.fixture(scope="module")
def tiny(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A model that opens in milliseconds, for commands that are run a hundred times."""
    file = tmp_path_factory.mktemp("tiny") / "model.onnx"
    file.write_bytes(small_models.onnx_file(sealed=True))
    return file


@pytest.fixture
def killer(tmp_path: Path) -> Killer:
    return Killer(tmp_path)


def survives(command: Command, killer: Killer, out: Path, rounds: int = ROUNDS) -> None:
    """Kill a command again and again at other moments, going on each time; then compare with a run of its own."""
    status, seconds, steps = killer.run(command.arguments)
    assert status == 0, killer.log.read_text()
    expected = command.result()
    rng = Random(str(command.arguments[0]))
    for number in range(rounds):
        shutil.rmtree(out)
        by_time = number % 2 == 1
        after = rng.uniform(0, seconds) if by_time else None
        step = None if by_time else rng.randint(1, steps)
        status, _, _ = killer.run(command.arguments, after, step)
        assert status in (0, -signal.SIGKILL), killer.log.read_text()
        command.whole()
        following = command.again() if command.again and status else command.arguments
        if status:
            status, _, _ = killer.run(following)
            assert status == 0, f"{number}: {after or step}: {killer.log.read_text()}"
        command.whole()
        assert command.result() == expected, f"{number}: {after or step}"


def contents(out: Path) -> dict[str, bytes]:
    """The files that a command made, without its cache, and without parts that a killed process was writing."""
    files = {file.relative_to(out).as_posix(): file.read_bytes() for file in out.rglob("*") if file.is_file()}
    return {name: data for name, data in files.items() if not name.startswith("cache/") and ".part" not in name}


def opened(file: Path) -> bytes | None:
    """A model's descriptors of a picture, None where there is no model."""
    if not file.exists():
        return None
    model = lpn.load(file)
    return model.descriptors(np.ones((1, 3, *model.input_size), np.float32), model.views[0]).tobytes()


@pytest.mark.slow
def test_describe(tiny: Path, places: Path, tmp_path: Path, killer: Killer) -> None:
    out = tmp_path / "out"

    def whole() -> object:
        if not (out / "store.json").exists():
            with pytest.raises(StoreError, match=r"has no store\.json"):
                descriptors.open_store(out)
            return None
        store = descriptors.open_store(out)
        store.check()
        return np.array(store.descriptors).round(5).tobytes(), store.rows

    arguments = ["describe", "--model", str(tiny), "--images", str(places), "--view", "drone", "--out", str(out)]
    survives(Command(arguments, whole, whole), killer, out)


@pytest.mark.slow
def test_export(model_file: Path, tmp_path: Path, killer: Killer) -> None:
    file = tmp_path / "out" / "lpn.onnx"
    arguments = ["export", "--model", str(model_file.with_suffix(".safetensors")), "--out", str(file)]
    survives(Command(arguments, lambda: opened(file), lambda: opened(file)), killer, file.parent, FEW)


def test_index(tiny: Path, places: Path, tmp_path: Path, killer: Killer) -> None:
    out = tmp_path / "out"
    store = tmp_path / "store"
    files = descriptors.pictures_below(places)
    made = descriptors.describe(lpn.load(tiny), files, "drone", store, root=places)
    query = np.array(made.descriptors[3])

    def found() -> object:
        if not (out / "store.json").exists():
            return None
        opened = index.open_index(out)
        answer = opened.search(query, None, 3)
        # Nothing, or all: a store is added whole.
        assert opened.count() in (0, len(files))
        return opened.count(), [str(name) for name in answer.ids]

    arguments = ["index", "--descriptors", str(store), "--out", str(out)]
    survives(Command(arguments, found, found), killer, out)


@pytest.mark.slow
def test_train(places: Path, tmp_path: Path, killer: Killer) -> None:
    out = tmp_path / "out"
    settings = ["--epochs", "2", "--size", "32", "--batch", "4", "--warmup-epochs", "0", "--ema", "0"]
    arguments = ["train", "--data", str(places), "--out", str(out), "--recipe", "small", "--from-scratch", *settings]

    def whole() -> None:
        for file in (out / "last.safetensors", out / "best.safetensors"):
            opened(file)

    def losses() -> object:
        with (out / "log.csv").open(encoding="utf-8", newline="") as file:
            rows = [(row["epoch"], row["loss"]) for row in csv.DictReader(file)]
        return rows, opened(out / "last.safetensors")

    def again() -> list[str]:
        begun = any((out / name).exists() for name in ("state.pt", "last.safetensors", "log.csv"))
        return [*arguments, "--resume"] if begun else arguments

    survives(Command(arguments, whole, losses, again), killer, out)


@pytest.mark.slow
def test_locate(tiny: Path, tmp_path: Path, killer: Killer) -> None:
    """Retrieval, sequence, and registration, whose windows, map features, and photos are kept in the cache."""
    out = tmp_path / "out"
    town = write_map(tmp_path / "town.tif", land()[::2, ::2])
    (tmp_path / "photos").mkdir()
    flight = small_flight(tmp_path / "photos", town)
    write_flight(replace(flight, frames=flight.frames[:6]), tmp_path / "flight")
    where = ["--map", str(tmp_path / "town.tif"), "--flight", str(tmp_path / "flight"), "--out", str(out / "track.csv")]

    def track() -> bytes | None:
        return (out / "track.csv").read_bytes() if (out / "track.csv").exists() else None

    def whole() -> None:
        assert (track() or b"\n").endswith(b"\n")

    survives(Command(["locate", *where, "--model", str(tiny), "--matcher", "sift"], whole, track), killer, out)


@pytest.mark.slow
def test_world(tmp_path: Path, killer: Killer) -> None:
    out = tmp_path / "out"
    settings = ["--buildings", "3", "--views", "2", "--pixels", "32", "--tile-pixels", "32"]

    def whole() -> None:
        """Either it says that it is unfinished, or everything is there."""
        if not (out / "world.json").exists():
            return
        planned = json.loads((out / "world.json").read_bytes())["pictures"]
        there = [(out / picture["path"]).is_file() for picture in planned]
        if all(there):
            assert all(load_picture(out / picture["path"]).size for picture in planned)
        else:
            with pytest.raises(DataError, match="not rendered to its end; give the command that renders it again"):
                open_dataset(out)

    arguments = [WORLD, "--out", str(out), "--seed", "3", *settings]
    survives(Command(arguments, whole, lambda: contents(out)), killer, out, FEW)
    assert open_dataset(out).kind == "world"


@pytest.mark.slow
def test_a_store_read_while_it_is_written_is_none_or_whole(
    tiny: Path, places: Path, tmp_path: Path, killer: Killer
) -> None:
    """Every step on the disk of describing a second time, with one picture more, in turn."""
    out = tmp_path / "out"
    pictures = shutil.copytree(places / "test" / "query_drone", tmp_path / "pictures")
    arguments = ["describe", "--model", str(tiny), "--images", str(pictures), "--view", "drone", "--out", str(out)]
    assert killer.run(arguments)[0] == 0
    before = shutil.copytree(out, tmp_path / "before")
    small_worlds.write(pictures / "new.png", small_worlds.place(77))
    _, _, steps = killer.run(arguments)
    killed = 0
    for step in range(1, steps + 1):
        shutil.rmtree(out)
        shutil.copytree(before, out)
        killed += killer.run(arguments, step=step)[0] == -signal.SIGKILL
        if (out / "store.json").exists():
            store = descriptors.open_store(out)
            store.check()
            assert len(store.descriptors) == len(store.rows)
        assert killer.run(arguments)[0] == 0, killer.log.read_text()
        assert len(descriptors.open_store(out).descriptors) == len(descriptors.pictures_below(pictures))
    assert killed >= steps - 2, "a run may save once less than another"


def test_what_a_person_saves(tmp_path: Path, killer: Killer) -> None:
    """What was saved before the kill is there, and what was being saved is there whole or not at all."""
    out, journal = tmp_path / "out", tmp_path / "journal"
    out.mkdir()
    arguments = [saves.COMMAND, str(out), str(journal)]
    status, _, steps = killer.run(arguments)
    assert status == 0, killer.log.read_text()
    assert saves.saved(out) == dict.fromkeys(saves.SAVES, 3)
    rng = Random("saves")
    for step in sorted(rng.sample(range(1, steps + 1), min(steps, 3 * ROUNDS))):
        shutil.rmtree(out)
        out.mkdir()
        journal.write_text("")
        assert killer.run(arguments, step=step)[0] == -signal.SIGKILL
        reported = Counter(journal.read_text().split())
        pieces = saves.saved(out)
        more = {kind for kind in saves.SAVES if pieces[kind] != reported[kind]}
        assert all(pieces[kind] == reported[kind] + 1 for kind in more), step
        assert len(more) <= 1, step
    assert killer.run(arguments)[0] == 0, killer.log.read_text()
    assert saves.saved(out) == dict.fromkeys(saves.SAVES, 3)
