"""A file whose name is of another kind is refused in one sentence, before a model or a data set is opened."""

from __future__ import annotations

from pathlib import Path

import pytest

from lpn.cli import main
from lpn.core.errors import InputError
from lpn.core.files import check_ending

PAIR = ["explain", "--model", "none.onnx", "--query", "a.jpg", "--match", "b.jpg"]
MODEL = ["none", "--model", "none.onnx"]
COMPARED = ["compare", "none", "--model", "none.onnx", "other.onnx"]
FLOWN = ["--map", "none.tif", "--flight", "none"]
SURVEYED = ["locate", *FLOWN, "--positions", "survey.csv"]
SEARCH = ["search", "--index", "none", "--model", "none.onnx", "--picture", "a.jpg", "--view", "drone"]


@pytest.mark.parametrize(
    ("arguments", "option", "name", "expected"),
    [
        *((PAIR, "--png", name, ".png") for name in ("out.pdf", "out.svg", "out.jpg", "out")),
        (PAIR, "--json", "why.csv", ".json"),
        (["explain", *MODEL, "--over", "rotation", "--query", "0001/01"], "--csv", "t.json", ".csv"),
        (["failures", *MODEL], "--csv", "f.xlsx", ".csv"),
        (["report", *MODEL], "--out", "r.pdf", ".html or .htm"),
        (["models"], "--json", "m.txt", ".json"),
        (["doctor"], "--json", "d.txt", ".json"),
        (SEARCH, "--json", "s.csv", ".json"),
        (["evaluate", *MODEL], "--json", "e.csv", ".json"),
        (["evaluate", *MODEL, "--weather", "all"], "--json", "e.csv", ".json"),
        (["evaluate", *MODEL], "--per-query", "q.json", ".csv"),
        (["locate", *FLOWN], "--json", "e.csv", ".json"),
        (SURVEYED, "--residuals", "r.json", ".csv"),
        (COMPARED, "--json", "t.csv", ".json"),
        (COMPARED, "--table", "t.pdf", ".md, .tex, .csv, .html, or .htm"),
        (
            ["compare", "a.mat", "b.mat", "--data", "none"],
            "--table",
            "t.pdf",
            ".md, .tex, .csv, .html, or .htm",
        ),
        (COMPARED, "--page", "page.pdf", ".md, .tex, .csv, .html, or .htm"),
        (
            ["compare", "none", "--map", "none.tif", "--model", "none.onnx", "other.onnx"],
            "--table",
            "t.pdf",
            ".md, .tex, .csv, .html, or .htm",
        ),
        (["locate", *FLOWN], "--out", "track.shp", ".geojson, .kml, or .csv"),
        (["export", "--model", "none.pth"], "--out", "model.pt", ".onnx"),
    ],
)
def test_another_kind_of_file_is_refused_before_anything_is_opened(
    arguments: list[str],
    option: str,
    name: str,
    expected: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("none.pth").touch()
    assert main.main([*arguments, option, f"deep/{name}"]) == 2
    error = capsys.readouterr().err
    assert f"named {name};" in error
    assert expected in error
    assert len(error.splitlines()) == 1
    assert not Path("deep").exists()


def test_all_names_are_checked_before_a_folder_is_made(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main.main([*PAIR, "--json", "deep/why.json", "--png", "deep/out.pdf"]) == 2
    assert "expected a name that ends in .png" in capsys.readouterr().err
    assert not Path("deep").exists()


def test_upper_case_endings_count_and_several_are_listed() -> None:
    check_ending(Path("OUT.PNG"), ".png")
    with pytest.raises(InputError, match=r"named a\.txt; expected a name that ends in \.b, \.c, or \.d\.$"):
        check_ending(Path("x/a.txt"), ".b", ".c", ".d")
