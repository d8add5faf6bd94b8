"""The program that compares measures with their baselines. Tests reach tools only as processes."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PRELUDE = """
import sys
from pathlib import Path
import tools.keep.__main__ as keep
from tools.keep.measures import Measure, NotMeasuredError, at_least, at_most, equal, reported, within
keep._state = lambda *_: "one state"
def run(figures, bounds):
    arguments = sys.argv[1:]
    made = Measure("made", (lambda: figures) if isinstance(figures, dict) else figures, bounds)
    sys.exit(keep.main(arguments, {"made": made}, Path("baseline")))
"""


def run(folder: Path, code: str, *arguments: str, baseline: dict[str, object] | None = None) -> tuple[int, str]:
    """Run measuring code in a folder beside a baseline; return its exit status and output."""
    if baseline is not None:
        (folder / "baseline").mkdir(exist_ok=True)
        (folder / "baseline" / "made.json").write_text(json.dumps({"commit": "before", "figures": baseline}))
    command = [sys.executable, "-c", f"import sys\nsys.path.insert(0, {str(ROOT)!r})\n{PRELUDE}{code}", *arguments]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    return done.returncode, done.stderr


def keep(*arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "tools.keep", *arguments], cwd=ROOT, capture_output=True, text=True, check=False
    )


@pytest.mark.parametrize(
    ("value", "bound", "error"),
    [
        ("3", "equal()", ""),
        ("4", "equal()", "found 4; the baseline has 3; expected equal"),
        ("3.25", "within(0.25)", ""),
        ("2.5", "within(0.25)", "found 2.5; the baseline has 3; expected within 0.25"),
        ("float('nan')", "within(0.25)", "found nan; the baseline has 3"),
        ("3", "at_most()", ""),
        ("4", "at_most()", "found 4, and the limit is 3; expected at most the baseline"),
        ("2", "at_most(1)", "found 2, and the limit is 1; expected at most 1"),
        ("[0, 2, 1]", "at_most(1)", "found 2, and the limit is 1"),
        ("2", "at_least(2)", ""),
        ("'two'", "at_least(2)", "found two; expected at least 2"),
        ("[3, 3]", "within(1)", "found 2 values; the baseline has 1"),
        ("9", "reported()", ""),
    ],
)
def test_a_broken_bound_ends_with_status_1_and_a_sentence(value: str, bound: str, error: str, tmp_path: Path) -> None:
    code = f"run({{'figure': {value}}}, {{'figure': {bound}}})"
    status, told = run(tmp_path, code, "--out", "out.json", baseline={"figure": 3})
    assert status == bool(error)
    assert ("made, figure: " in told) == bool(error)
    assert error in told
    figure = json.loads((tmp_path / "out.json").read_text())["measures"]["made"]["figures"]["figure"]
    assert (figure["verdict"] == "held") == (not error)
    assert figure["baseline"] == 3


def test_ranks_may_differ_where_the_baseline_s_gap_is_small_and_not_elsewhere(tmp_path: Path) -> None:
    baseline: dict[str, object] = {"ranks": [1, 2, 5], "gaps": [0.1, 2e-6, 2.1e-6]}
    code = "run({{'ranks': {}, 'gaps': [0, 0, 0]}}, {{'ranks': equal('gaps', 2e-6), 'gaps': reported()}})"
    assert run(tmp_path, code.format([1, 3, 5]), baseline=baseline)[0] == 0
    status, told = run(tmp_path, code.format([1, 3, 4]), baseline=baseline)
    assert status == 1
    assert "1 of 3 values differ; value 2 is 4, and the baseline has 5; expected equal where gaps > 2e-06" in told


@pytest.mark.parametrize(
    ("figures", "error"),
    [
        ({"one": 1.0}, "made, two: the figure was not measured."),
        ({"one": 1.0, "two": 2.0, "three": 3.0}, "made, three: the figure has no bound"),
        ({"one": 1.0, "two": 2.0, "part 2": 1.0}, "made, part 2: the baseline lacks it; write it by"),
        ({"one": 1.0, "two": 2.0}, "made, part *: the figure was not measured."),
    ],
)
def test_a_figure_without_its_bound_baseline_or_value_fails(
    figures: dict[str, float], error: str, tmp_path: Path
) -> None:
    code = f"run({figures}, {{'one': at_most(1), 'two': at_least(2), 'part *': within(1)}})"
    status, told = run(tmp_path, code, baseline={"one": 1, "two": 2})
    assert status == 1
    assert error in told


def test_what_cannot_be_measured_is_told_and_what_fails_breaks(tmp_path: Path) -> None:
    code = "def measure(): raise {}\nrun(measure, {{'one': equal()}})"
    missing = code.format("NotMeasuredError('LPN_FLIGHTS is not set')")
    status, told = run(tmp_path, missing, "--out", "out.json")
    assert status == 0
    assert "made was not measured: LPN_FLIGHTS is not set." in told
    assert "LPN_FLIGHTS" in json.loads((tmp_path / "out.json").read_text())["measures"]["made"]["not_measured"]
    status, told = run(tmp_path, missing, "--accept", "made")
    assert status == 1
    assert "nothing was measured, so its baseline stays as it is" in told
    assert not (tmp_path / "baseline").exists()
    status, told = run(tmp_path, code.format("KeyError('x')"))
    assert status == 1
    assert "made failed: KeyError: 'x'" in told


def test_a_run_that_was_killed_goes_on_in_the_same_state(tmp_path: Path) -> None:
    code = """
def first():
    with open("log", "a") as log:
        log.write("first ")
    return {"one": 1.0}
def second():
    if not Path("again").exists():
        import os
        os._exit(9)
    return {"two": 2.0}
measures = {"first": Measure("first", first, {"one": equal()}), "second": Measure("second", second, {"two": at_least(2)})}
sys.exit(keep.main(["--out", "out.json"], measures, Path("baseline")))
"""
    assert run(tmp_path, code)[0] == 9
    assert list(json.loads((tmp_path / "out.json").read_text())["measures"]) == ["first"]
    (tmp_path / "again").touch()
    (tmp_path / "baseline").mkdir()
    (tmp_path / "baseline" / "first.json").write_text('{"commit": "before", "figures": {"one": 1.0}}')
    assert run(tmp_path, code)[0] == 0  # measured figures are compared with the present baseline
    assert (tmp_path / "log").read_text() == "first "
    run(tmp_path, code.replace("sys.exit", 'keep._state = lambda *_: "another state"\nsys.exit'))
    assert (tmp_path / "log").read_text() == "first first "


def test_accept_writes_the_baseline_of_the_named_measure(tmp_path: Path) -> None:
    code = "run({'list': [1, 2.5], 'text': 'a'}, {'*': equal()})"
    assert run(tmp_path, code, baseline={"list": [1, 2], "text": "a"})[0] == 1
    assert run(tmp_path, code, "--accept", "made")[0] == 0
    text = (tmp_path / "baseline" / "made.json").read_text()
    assert json.loads(text) == {"commit": "one state", "figures": {"list": [1, 2.5], "text": "a"}}
    assert '\n  "list": [1,2.5],\n' in text  # a line for each figure, so that a change can be read
    assert run(tmp_path, code)[0] == 0


def test_files_that_are_none_of_this_program_are_refused_and_stay(tmp_path: Path) -> None:
    for content in ("[]", "{", '{"commit": "one state"}'):
        (tmp_path / "out.json").write_text(content)
        status, told = run(tmp_path, "run({'one': 1.0}, {'*': reported()})", "--out", "out.json")
        assert status == 1
        assert 'out.json is no JSON of tools.keep with "measures"' in told
        assert "Traceback" not in told
        assert (tmp_path / "out.json").read_text() == content


def test_the_quick_measures_have_baselines_and_an_unknown_one_is_named() -> None:
    done = keep("nothing")
    assert done.returncode == 1
    assert "There is no measure nothing; there are " in done.stderr
    names = set(done.stderr.partition("there are ")[2].strip().rstrip(".").split(", "))
    files = {file.stem: file.stat().st_size for file in (ROOT / "tools" / "keep" / "baseline").glob("*.json")}
    assert {"ranks", "described", "explained", "matches", "imports", "published", "methods", "calls"} <= set(files)
    assert set(files) <= names
    assert sum(files.values()) < 150_000


def test_the_demo_s_ranked_tiles_are_those_of_the_baseline() -> None:
    done = keep("matches")
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("held") == 3
