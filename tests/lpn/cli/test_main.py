from __future__ import annotations

import json
import os
import subprocess
import sys
from functools import partial
from pathlib import Path

import pytest

from explorer.cli import Explore
from lpn.cli import main
from lpn.core.errors import InputError
from lpn.core.files import check_ending
from lpn.core.views import TASKS
from lpn.descriptors import open_store
from lpn.descriptors.weather import WEATHERS
from tests.conftest import Refused
from tools.fixtures.without_torch import run_without_torch


def without_torch(*arguments: object) -> subprocess.CompletedProcess[str]:
    """The command where only the base packages are installed."""
    return run_without_torch("from lpn.cli.main import main\nsys.exit(main(sys.argv[1:]))", *arguments)


def test_evaluate_writes_the_promised_keys(data: Path, model_file: Path, tmp_path: Path) -> None:
    out = tmp_path / "deep" / "figures.json"
    common = ["evaluate", str(data), "--model", str(model_file), "--json", str(out)]
    assert main.main(common) == 0
    whole = json.loads(out.read_text())
    assert list(whole) == [
        *("recall@1", "recall@5", "recall@10", "recall@1%", "ap"),
        *("queries", "gallery", "galleries", "groups", "task", "rotate", "shift", "scale", "weather", "parts"),
        *("calibration", "csls", "cropped", "junk", "protocol", "seconds"),
    ]
    assert (whole["task"], whole["parts"], whole["queries"]) == ("drone-to-satellite", [1, 2, 3, 4], 14)
    changes = ["--rotate", "90", "--shift", "-3", "--scale", "1.5"]
    assert main.main([*common, "--task", "satellite-to-drone", *changes, "--parts", "2,4"]) == 0
    turned = json.loads(out.read_text())
    for said in ("turned 90°", "3 px to the left", "scaled by 1.5", "parts 2, 4 of 4"):
        assert said in turned["protocol"]
    assert (turned["task"], turned["rotate"], turned["parts"]) == ("satellite-to-drone", 90, [2, 4])
    assert turned["ap"] != whole["ap"]


def test_without_a_model_the_one_that_ships_is_measured_and_named(
    data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    figures = []
    for options, said in (([], True), (["--model", "city-lpn"], False)):
        out = tmp_path / f"{len(options)}.json"
        assert main.main(["evaluate", str(data), *options, "--json", str(out)]) == 0
        printed = capsys.readouterr()
        assert ("The model is city-lpn, which is shipped and knows only a rendered city" in printed.err) is said
        assert "city-lpn (LPN" in printed.out
        figures.append({key: value for key, value in json.loads(out.read_text()).items() if key != "seconds"})
    assert figures[0] == figures[1]
    capsys.readouterr()
    opens = Explore(source=str(data)).opens_data()
    assert isinstance(opens, partial)
    assert opens.args[1].model == Path("city-lpn")
    assert "The model is city-lpn" in capsys.readouterr().err


def test_everything_but_training_works_without_torch(data: Path, model_file: Path, tmp_path: Path) -> None:
    images, weights = data / "test" / "query_drone", model_file.with_suffix(".safetensors")
    given = [
        "--help",
        f"evaluate {data} --model {model_file}",
        f"describe --model {model_file} --images {images} --view drone --out {tmp_path}/s",
        f"train --data {data} --out {tmp_path}/run",
        f"evaluate {data} --model {weights}",
        f"export --model {weights} --out {tmp_path}/m.onnx",
    ]
    code = "from lpn.cli.main import main\nsys.exit(str([main(words.split()) for words in sys.argv[1:]]))"
    *errors, statuses = run_without_torch(code, *given).stderr.splitlines()
    assert statuses == "[0, 0, 0, 2, 2, 2]", errors
    assert open_store(tmp_path / "s").descriptors.shape == (14, 4, 512)
    assert len(errors) == 3
    assert all("lpn-explorer[train]" in error for error in errors)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("evaluate x.mat", "no saved result at x.mat"),
        ("evaluate x.mat --n-parts 0", "number of parts is 0"),
        ("export --model MODEL --out x.onnx", "already"),
        ("fly", "no command 'fly'"),
    ],
)
def test_mistakes_get_one_sentence(
    words: str,
    said: str,
    data: Path,
    model_file: Path,
    refused: Refused,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    names = {"DATA": data, "MODEL": model_file}
    assert said in refused(*(names.get(word, word) for word in words.split()))


@pytest.mark.skipif(sys.platform == "win32", reason="closed pipes are POSIX's")
@pytest.mark.parametrize("arguments", ["--help", "search --help", "doctor", "evaluate none --model none.pth"])
def test_a_closed_pipe_ends_a_command_in_silence(arguments: str) -> None:
    """One that prints, that prints by Rich, that prints tyro's help, and that prints an error."""
    reader, writer = os.pipe()
    os.close(reader)
    to_errors = "none" in arguments
    done = subprocess.run(
        [sys.executable, "-m", "lpn", *arguments.split()],
        stdout=subprocess.PIPE if to_errors else writer,
        stderr=writer if to_errors else subprocess.PIPE,
        check=False,
    )
    os.close(writer)
    assert (done.returncode, done.stdout or b"", done.stderr or b"") == (141, b"", b"")


def test_the_words_of_an_option_are_listed_in_their_order_and_without_none(capsys: pytest.CaptureFixture[str]) -> None:
    for option, value, words in (("--task", "both", TASKS), ("--weather", "hail", [*WEATHERS, "all"])):
        with pytest.raises(SystemExit):
            main.main(["evaluate", "d", "--model", "m", option, value])
        said = " ".join(capsys.readouterr().err.replace("│", " ").split())
        assert f"Expected one of ({', '.join(map(repr, words))})." in said


PAIR = "explain --model none.onnx --query a.jpg --match b.jpg"
COMPARED = "compare none --model none.onnx other.onnx"
TABLE = ".md, .tex, .csv, .html, or .htm"


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (f"{PAIR} --json why.json --png", ".png"),
        (f"{PAIR} --json", ".json"),
        ("explain none --model none.onnx --over rotation --query 0001/01 --csv", ".csv"),
        ("failures none --model none.onnx --csv", ".csv"),
        ("report none --model none.onnx --out", ".html or .htm"),
        ("models --json", ".json"),
        ("doctor --json", ".json"),
        ("search --index none --model none.onnx --picture a.jpg --view drone --json", ".json"),
        ("evaluate none --model none.onnx --json", ".json"),
        ("evaluate none --model none.onnx --per-query", ".csv"),
        ("locate --map none.tif --flight none --json", ".json"),
        ("locate --map none.tif --flight none --positions survey.csv --residuals", ".csv"),
        ("locate --map none.tif --flight none --out", ".geojson, .kml, or .csv"),
        (f"{COMPARED} --json", ".json"),
        (f"{COMPARED} --table", TABLE),
        (f"{COMPARED} --page", TABLE),
        ("export --model none.pth --out", ".onnx"),
    ],
)
def test_another_kind_of_file_is_refused_before_anything_is_opened(
    words: str, expected: str, refused: Refused, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("none.pth").touch()
    said = refused(*words.split(), "deep/out.xyz")
    assert "named out.xyz;" in said
    assert expected in said
    assert [file.name for file in tmp_path.iterdir()] == ["none.pth"]


def test_upper_case_endings_count_and_several_are_listed() -> None:
    check_ending(Path("OUT.PNG"), ".png")
    with pytest.raises(InputError, match=r"named a\.txt; expected a name that ends in \.b, \.c, or \.d\.$"):
        check_ending(Path("x/a.txt"), ".b", ".c", ".d")
