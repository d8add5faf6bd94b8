"""The matrix of sources and commands: each command takes a task from each source, or says in one sentence why it cannot."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import explorer.app
from explorer.workspace import Workspace
from lpn import descriptors
from lpn.cli import by_source
from lpn.cli.main import commands, main
from lpn.core.views import views_of
from lpn.datasets import open_dataset
from lpn.flights import write_flight
from lpn.models.onnx_engine import Engine
from lpn.sources import Arrays
from tests.lpn.locate.scenery import land, small_flight, write_map
from tools.fixtures.published_results import save_result

TASK = "drone-to-satellite"
SOURCES = ("data", "published", "arrays", "index", "flight")
COMMANDS = ("evaluate", "compare", "failures", "report", "sweep", "explore")


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
) -> Callable[[str, str], list[str]]:
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
    write_flight(small_flight(flight, ground), flight)
    model = ["--model", model_file]
    arrays = ["--queries", folder / "query.npy", "--gallery", folder / "gallery.npy", "--paths", folder / "paths.csv"]
    flown = ["--map", folder / "ground.tif", "--flight", flight]
    each: dict[str, list[str | Path]] = {
        "data": ["--data", data, *model],
        "published": ["published", "--saved", saved, "--data", data, "--n-parts", "4"],
        "arrays": ["arrays", *arrays, "--data", data],
        "index": ["index", "--index", index, "--data", data, *model],
        "flight": ["flight", *flown, *model],
    }
    special: dict[tuple[str, str], list[str | Path]] = {
        ("compare", "data"): [model_file, one_part_model_file, "--data", data],
        ("compare", "published"): ["published", saved, folder / "again.mat", "--data", data],
        ("compare", "arrays"): [
            "arrays",
            *arrays[:2],
            folder / "query.npz",
            *arrays[2:4],
            folder / "gallery.npz",
            *arrays[4:],
        ],
        ("compare", "index"): ["index", index, folder / "again", "--data", data, *model],
        ("compare", "flight"): ["flight", model_file, one_part_model_file, *flown, "--page", folder / "page.html"],
        ("evaluate", "published"): ["published", "--saved", saved, "--n-parts", "4"],
        ("evaluate", "flight"): ["flight", *flown, *model, "--no-register"],
        ("explore", "flight"): ["flight", *flown, *model, "--no-register"],
    }
    (folder / "again.mat").write_bytes(saved.read_bytes())
    for side in ("query", "gallery"):
        np.savez(folder / f"{side}.npz", np.load(folder / f"{side}.npy"))
    (folder / "again").symlink_to(index)
    return lambda command, source: [str(one) for one in special.get((command, source), each[source])]


def _output(command: str, source: str, folder: Path) -> tuple[list[str], Path]:
    """Return further options of a command, and the file that they make it write."""
    # A flight's comparison writes a page, which has tables of its own.
    table = [] if source == "flight" else ["--table", str(folder / "table.md")]
    query = {"flight": "05.png", "arrays": "0009/image-01"}.get(source, "0009")
    return {
        "evaluate": (["--json"], folder / "figures.json"),
        "compare": (["--resamples", "20", *table, "--json"], folder / "figures.json"),
        "failures": (["--csv"], folder / "failures.csv"),
        "report": (["--query", query, "--out"], folder / "report.html"),
        "sweep": (["--query", query, "--step", "90", "--csv"], folder / "sweep.csv"),
        "explore": ([], folder),
    }[command]


@pytest.mark.parametrize("source", SOURCES)
@pytest.mark.parametrize("command", COMMANDS)
def test_each_command_takes_a_task_from_each_source(
    command: str,
    source: str,
    options: Callable[[str, str], list[str]],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    opened: list[Workspace] = []
    monkeypatch.setattr(explorer.app, "serve", lambda open_workspace, *_: opened.append(open_workspace()))
    more, file = _output(command, source, tmp_path)
    arguments = [command, *options(command, source), *more, *([] if command == "explore" else [str(file)])]
    status = main(arguments)
    told = capsys.readouterr()
    if command == "sweep" and source in ("published", "arrays"):
        assert status == 2
        assert "holds descriptors and no network" in told.err
        assert not file.exists()
    elif command == "explore":
        assert (status, len(opened)) == (0, 1), told.err
        assert len(next(iter(opened[0].tasks.values())).queries) == (21 if source == "flight" else 14)
    else:
        assert status == 0, told.err
        assert file.stat().st_size > 100
        tables = [one for one in tmp_path.glob("table.md") if "| A | B | only A |" in one.read_text("utf-8")]
        assert len(tables) == (command == "compare" and source != "flight")


def test_sources_of_one_model_have_the_same_figures(options: Callable[[str, str], list[str]], tmp_path: Path) -> None:
    recalls, ranks = [], []
    for source in ("data", "published", "arrays", "index"):
        assert main(["evaluate", *options("evaluate", source), "--json", str(tmp_path / "figures.json")]) == 0
        figures = json.loads((tmp_path / "figures.json").read_text())
        recalls.append(
            [figures["queries"], figures["gallery"], *(figures[f"recall@{k}"] for k in (1, 5, 10)), figures["ap"]]
        )
        assert main(["failures", *options("failures", source), "--csv", str(tmp_path / "f.csv"), "--sort", "name"]) == 0
        lines = (tmp_path / "f.csv").read_text().splitlines()
        column = lines[0].split(",").index("rank")
        ranks.append([line.split(",")[column] for line in lines[1:]])
    assert all(figures == recalls[0] for figures in recalls)
    assert ranks[0] == ranks[1] == ranks[2] == ranks[3]


def test_an_option_of_another_source_names_that_source(capsys: pytest.CaptureFixture[str]) -> None:
    for command, option, word in (
        ("evaluate", "--saved", "published"),
        ("explore", "--map=a.tif", "flight"),
        ("failures", "--index", "index"),
        ("report", "--queries", "arrays"),
    ):
        assert main([command, "--data", "places", option, "x"]) == 2
        assert f"lpn {command} {word}" in capsys.readouterr().err


@pytest.mark.parametrize("command", COMMANDS)
def test_few_options_are_seen_at_once(command: str) -> None:
    default = commands()[command]
    most = 15 if command == "evaluate" else 20
    for one in (default, *default.SOURCES.values()):
        assert len(set(by_source.options(one))) <= most, one


def test_queries_without_a_label_and_part_weights_do_not_count(tmp_path: Path) -> None:
    both = np.eye(4, dtype=np.float32).reshape(4, 2, 2)
    for name in ("q", "g"):
        np.save(tmp_path / f"{name}.npy", both + 0.01)
    lines = [f"q{i},query,{i if i < 2 else ''}" for i in range(4)] + [f"g{i},gallery,{i}" for i in range(4)]
    (tmp_path / "paths.csv").write_text("\n".join(["file,side,label", *lines]))
    source = Arrays(queries=tmp_path / "q.npy", gallery=tmp_path / "g.npy", paths=tmp_path / "paths.csv")
    task = source.open().task
    result = task.evaluate()
    assert (result.queries, result.recall["1"]) == (2, 100.0)
    assert replace(task, weights=[1, 0]).evaluate().recall == result.recall
    assert "Recall@1" in task._repr_html_()


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("published --saved FOLDER --data FOLDER", "is a folder; give the file that the published test code wrote"),
        ("arrays --queries FOLDER --gallery FOLDER --paths FOLDER", "is a folder; give the file of query descriptors"),
        ("index --index FILE --data FOLDER --model city-lpn", "is a file; expected the folder of an index"),
        (
            "flight --flight FOLDER --map FILE --model city-lpn",
            "file.mp4 is a video or its subtitles; make a flight of it",
        ),
    ],
)
def test_a_folder_in_place_of_a_file_is_named(
    words: str, message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "file.mp4").write_bytes(b"\0\0\0\x18ftypmp42")
    names = {"FOLDER": str(tmp_path), "FILE": str(tmp_path / "file.mp4")}
    assert main(["failures", *(names.get(word, word) for word in words.split())]) == 2
    assert message in capsys.readouterr().err


def test_a_word_that_is_no_source_is_named(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["evaluate", "indx", "--index", "tiles"]) == 2
    assert "no source indx; it has data, published, arrays, index, flight" in capsys.readouterr().err
