"""The matrix of sources and commands: each command takes a task from each source, or says in one sentence why it cannot."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest

import explorer.app
from explorer.workspace import Workspace
from lpn import descriptors
from lpn.cli import parsing
from lpn.cli.compare import CompareCommand
from lpn.cli.main import commands, main
from lpn.core.demo import DEMO
from lpn.core.views import views_of
from lpn.datasets import open_dataset
from lpn.flight.files import write_flight
from lpn.models.onnx_engine import Engine
from lpn.sources import OpenedSource, SourceOptions, TaskSource, known_kinds, recognise, source_of
from tests.conftest import Refused
from tests.lpn.flight.locate.scenery import land, small_flight, write_map
from tools.fixtures.published_results import save_result

Options = Callable[[str, str], list[str]]
TASK = "drone-to-satellite"
SOURCES = ("data", "published", "arrays", "index", "flight")
COMMANDS = ("evaluate", "compare", "failures", "report", "explain", "explore")


def _save_arrays(folder: Path, data: Path, model_file: Path) -> None:
    """Write both sides of `TASK`, and the list of their pictures, as plain arrays."""
    model, dataset = Engine(model_file), open_dataset(data)
    lines = ["file,side,label"]
    for side, view, pictures in zip(
        ("query", "gallery"), views_of(TASK), (dataset.queries("drone"), dataset.gallery("satellite")), strict=True
    ):
        np.save(folder / f"{side}.npy", descriptors.cached_descriptors(model, pictures, view))
        lines += [f"{one.path.relative_to(data)},{side},{one.label}" for one in pictures]
    (folder / "paths.csv").write_text("\n".join(lines))


@pytest.fixture(scope="module")
def options(
    data: Path, model_file: Path, one_part_model_file: Path, tmp_path_factory: pytest.TempPathFactory
) -> Options:
    """Returns the options by which a command opens a source; the first two are of one model's descriptors."""
    folder = tmp_path_factory.mktemp("sources")
    saved, index, flight = folder / "pytorch_result.mat", folder / "index", folder / "monday"
    save_result(saved, data, model_file)
    _save_arrays(folder, data, model_file)
    tiles = data / "test" / "gallery_satellite"
    described = ["describe", "--model", model_file, "--images", tiles, "--view", "satellite", "--out", folder / "store"]
    for arguments in (described, ["index", "--descriptors", folder / "store", "--out", index]):
        assert main([str(argument) for argument in arguments]) == 0
    ground = write_map(folder / "ground.tif", land()[::2, ::2])
    flight.mkdir()
    monday = small_flight(flight, ground)
    write_flight(replace(monday, frames=monday.frames[:8]), flight)
    model = ["--model", model_file]
    arrays = ["--gallery", folder / "gallery.npy"], ["--paths", folder / "paths.csv", "--data", data]
    over_map = [flight, "--map", folder / "ground.tif"]
    each: dict[str, list[str | Path]] = {
        "data": [data, *model],
        "published": [saved, "--data", data, "--n-parts", "4"],
        "arrays": [folder / "query.npy", *arrays[0], *arrays[1]],
        "index": [index, "--data", data, *model],
        "flight": [*over_map, *model],
    }
    special: dict[tuple[str, str], list[str | Path]] = {
        ("compare", "data"): [data, *model, one_part_model_file],
        ("compare", "published"): [saved, folder / "again.mat", "--data", data],
        ("compare", "arrays"): [
            folder / "query.npy",
            folder / "query.npz",
            *arrays[0],
            folder / "gallery.npz",
            *arrays[1],
        ],
        ("compare", "index"): [index, folder / "again", "--data", data, *model],
        ("compare", "flight"): [*over_map, *model, one_part_model_file],
        ("evaluate", "published"): [saved, "--n-parts", "4"],
        ("explore", "flight"): [*over_map, *model, "--no-register"],
        ("report", "flight"): [*over_map, *model, "--no-register"],  # test_grades has a report with registration
    }
    (folder / "again.mat").write_bytes(saved.read_bytes())
    for side in ("query", "gallery"):
        np.savez(folder / f"{side}.npz", np.load(folder / f"{side}.npy"))
    (folder / "again").symlink_to(index)
    return lambda command, source: [str(one) for one in special.get((command, source), each[source])]


def _output(command: str, source: str, folder: Path) -> tuple[list[str], Path]:
    """Return further options of a command, and the file that they make it write."""
    query = {"flight": "05.png", "arrays": "0009/image-01"}.get(source, "0009")
    return {
        "evaluate": (["--json"], folder / "figures.json"),
        "compare": (["--resamples", "20", "--table", str(folder / "table.md"), "--json"], folder / "figures.json"),
        "failures": (["--csv"], folder / "failures.csv"),
        "report": (["--query", query, "--out"], folder / "report.html"),
        "explain": (["--over", "rotation", "--query", query, "--step", "90", "--csv"], folder / "sweep.csv"),
        "explore": ([], folder),
    }[command]


@pytest.mark.parametrize("source", SOURCES)
@pytest.mark.parametrize("command", COMMANDS)
def test_each_command_takes_a_task_from_each_source(
    command: str,
    source: str,
    options: Options,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    opened: list[Workspace] = []
    monkeypatch.setattr(explorer.app, "serve", lambda opening, *_: opened.append(opening.open_workspace()))
    more, file = _output(command, source, tmp_path)
    arguments = [command, *options(command, source), *more, *([] if command == "explore" else [str(file)])]
    status = main(arguments)
    told = capsys.readouterr()
    if command == "explain" and source in ("published", "arrays"):
        assert status == 2
        assert "has descriptors and no network" in told.err
        assert not file.exists()
    elif command == "explore":
        assert (status, len(opened)) == (0, 1), told.err
        assert len(next(iter(opened[0].tasks.values())).queries) == (8 if source == "flight" else 14)
    else:
        assert status == 0, told.err
        assert file.stat().st_size > 100
        tables = [one for one in tmp_path.glob("table.md") if "| A | B | figure |" in one.read_text("utf-8")]
        assert len(tables) == (command == "compare")


def test_sources_of_one_model_have_the_same_figures_and_tables_of_queries(options: Options, tmp_path: Path) -> None:
    files = "--json", str(tmp_path / "figures.json"), "--per-query", str(tmp_path / "queries.csv")
    found = []
    for source in ("data", "published", "arrays", "index"):
        given = ["evaluate", *options("failures", source), *files]
        assert main([*given, "--task", TASK] if source == "data" else given) == 0
        figures = json.loads((tmp_path / "figures.json").read_text())
        lines = (tmp_path / "queries.csv").read_text().splitlines()
        assert len(lines) == 15
        assert lines[1].split(",")[3]
        names = ("queries", "gallery", "recall@1", "recall@5", "recall@10", "ap")
        found.append(([figures[name] for name in names], [line.split(",")[1:3] for line in lines]))
    assert all(one == found[0] for one in found)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("DATA DATA2 --page page.md", "A page is about one data set, and 2 are given; give one, or leave --page out."),
        ("DATA INDEX --data DATA --page page.md", "A page is about a data set, and an index is given; write a --table"),
        ("DATA SAVED --calibrate", "result of the published test code, and --calibrate fits a data set; leave it out."),
        ("DATA INDEX --data DATA --calibrate --page page.md", "an index, and --calibrate fits a data set; leave it"),
        ("DATA ARRAYS --gallery ARRAYS ARRAYS", "and --gallery names 2; give one for each .npy, .npz, or .mat"),
    ],
)
def test_what_would_be_compared_unlike_is_refused(
    words: str, said: str, options: Options, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, refused: Refused
) -> None:
    monkeypatch.chdir(tmp_path)
    root, *model = options("failures", "data")
    (tmp_path / "other").symlink_to(root)
    names = {"DATA": root, "DATA2": "other", "SAVED": options("failures", "published")[0]}
    names |= {"INDEX": options("failures", "index")[0], "ARRAYS": options("failures", "arrays")[0]}
    assert said in refused("compare", *(names.get(word, word) for word in words.split()), *model)
    assert not (tmp_path / "page.md").exists()


def test_the_model_that_ships_is_told_once(options: Options, capsys: pytest.CaptureFixture[str]) -> None:
    sources = [options("failures", one)[0] for one in ("data", "index")]
    for source in CompareCommand(source=tuple(sources))._sources().values():
        assert source.options.load().n_parts == 4
    told = capsys.readouterr()
    assert (told.out + told.err).count("The model is city-lpn, which is shipped") == 1


@pytest.mark.parametrize("source", SOURCES)
def test_an_option_that_does_not_fit_names_the_kind_and_those_that_take_it(
    source: str, options: Options, refused: Refused
) -> None:
    noun, option, fitting = {
        "data": ("a data set", "--map", "an index of a map's windows and a flight"),
        "published": ("a result of the published test code", "--model", "a data set"),
        "arrays": ("arrays of descriptors", "--pictures", "an index"),
        "index": ("an index", "--gallery", "arrays of descriptors"),
        "flight": ("a flight", "--task", "a data set"),
    }[source]
    value = "drone-to-satellite" if option == "--task" else "x"
    given = [word for word in options("failures", source) if option != "--gallery" or word != "--paths"]
    for command in ("failures", "report", "explore"):
        more = ["--out", "r.html"] if command == "report" else []
        said = refused(command, *given, *more, option, value)
        assert f" is {noun}, and {option} fits " in said
        assert fitting in said


def test_another_package_brings_a_kind_of_source(
    monkeypatch: pytest.MonkeyPatch, options: Options, tmp_path: Path
) -> None:
    class ListSource(TaskSource):
        noun = "a list"
        takes = frozenset(("data",))

        @classmethod
        def recognises(cls, options: SourceOptions) -> bool:
            return options.path.suffix == ".list"

        def open(self, *given: Any) -> OpenedSource:
            return source_of(SourceOptions(source=self.options.path.read_text(), data=self.options.data)).open(*given)

    point = Mock(load=lambda: ListSource)
    monkeypatch.setattr(recognise, "entry_points", lambda group: [point] if group == recognise.GROUP else [])
    known_kinds.cache_clear()
    try:
        saved, _, data, *_ = options("failures", "published")
        (tmp_path / "one.list").write_text(saved)
        assert main(["failures", str(tmp_path / "one.list"), "--data", data, "--csv", str(tmp_path / "f.csv")]) == 0
        assert (tmp_path / "f.csv").stat().st_size > 100
    finally:
        known_kinds.cache_clear()


def test_seventeen_commands_at_most_show_fifteen_options_each_and_take_all(capsys: pytest.CaptureFixture[str]) -> None:
    assert len(commands()) <= 17
    for name, command in commands().items():
        for option, mode in {"": command, **parsing.modes(command)}.items():
            counts = []
            for flag in ("--help", "--help-all"):
                with pytest.raises(SystemExit) as ended:
                    main([name, *([option] if option else []), flag])
                assert ended.value.code == 0
                said = capsys.readouterr().out
                shown = set(re.findall(r"^(?:│ |  )(--[a-z][a-z-]+)", said, re.MULTILINE))
                assert shown <= set(parsing.options(mode)), name
                counts.append(len(shown))
                more = re.search(r"--help-all shows (\d+) more option", said)
                assert (more is None) == (flag == "--help-all" or counts[0] == len(set(parsing.options(mode)))), name
            assert counts[0] <= 15, name
            assert counts[1] == len(set(parsing.options(mode))), name


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("failures FILE --data FOLDER", "file.mp4 is a file; expected a data set's folder, so make a flight of it"),
        ("failures FOLDER --map FILE", "; make a flight of it with lpn flight."),
        ("failures FLIGHT", "flight is a flight; give the map under it as --map"),
        ("failures", "There is no SOURCE; give its path first"),
        ("evaluate nowhere", "There is no data set folder at nowhere; check the path."),  # and no model is named first
        ("evaluate FOLDER --gallery FILE", "folder is a data set, and --gallery fits arrays of descriptors; leave it"),
        ("evaluate RESULT --gallery RESULT --centre", "Plain arrays are measured with their list of pictures"),
        ("compare RESULT FOLDER RESULT", "r.mat is compared with itself; give each source once, and each model"),
        ("compare RESULT RESULT --gallery FILE RESULT", "Plain arrays are measured with their list of pictures"),
        ("compare FOLDER --kind dac", "--kind needs --model; give both, or leave it out."),
        ("compare FOLDER --model bare.pth lpn.onnx --kind dac", "Found 1 kind for 2 models"),
        ("doctor --kind dac", "--kind needs --model; give both, or leave it out."),
        ("locate --map FILE --flight FLIGHT --kind dac", "--kind needs --model; give both, or leave it out."),
        ("compare FOLDER --pooling mean", "--pooling needs --model; give both, or leave it out."),
        ("explore --map a.tif --model m.onnx", "--map needs a source; name it: lpn explore SOURCE."),
        ("explore DEMO --no-register", "demo is a data set, and --no-register fits a flight; leave it out."),
        ("explore FLIGHT --map a.tif --model m.onnx", "There is no file a.tif"),
        ("explore FLIGHT --map a.tif --model m.onnx --map-error -1", "The map's error is -1 m; expected 0 or more"),
        ("evaluate FLIGHT --map nowhere --rotate 10", "flight is a flight, whose queries are cut out of photos"),
    ],
)
def test_a_source_that_cannot_be_opened_gets_one_sentence(
    words: str, message: str, tmp_path: Path, refused: Refused
) -> None:
    (tmp_path / "file.mp4").write_bytes(b"\0\0\0\x18ftypmp42")
    (tmp_path / "folder").mkdir()
    (tmp_path / "flight").mkdir()
    (tmp_path / "flight" / "flight.json").touch()
    names = {"FOLDER": "folder", "FILE": "file.mp4", "FLIGHT": "flight", "RESULT": "r.mat", "DEMO": DEMO}
    assert message in refused(*(tmp_path / names[word] if word in names else word for word in words.split()))
