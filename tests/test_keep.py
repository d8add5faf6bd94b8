"""The program that compares measures with their baselines, and what its slow measures do apart from the measuring."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from lpn.core.errors import DataError
from lpn.core.numbers import wrap_degrees
from lpn.flight.locate.surveyed import read_surveyed
from lpn.flight.maps.frame import LocalFrame
from tools.fixtures.parity import ParityCase
from tools.keep import __main__ as keep
from tools.keep import _resumable, flights, published
from tools.keep._maps import RENDERED, forged, open_pair
from tools.keep.measures import (
    Bound,
    Measure,
    NotMeasuredError,
    Value,
    all_measures,
    at_least,
    at_most,
    equal,
    errors,
    reported,
    within,
)
from tools.keep.training import training_figures

Run = Callable[..., tuple[int, str]]
KNOWN = all_measures()


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Run:
    """A function that runs the program for one measure beside a baseline, and returns its status and errors."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(keep, "_state", lambda *_: "one state")

    def measure(
        figures: Mapping[str, Any] | Callable[[], Any],
        bounds: Mapping[str, Bound],
        *arguments: str,
        baseline: Mapping[str, Any] | None = None,
    ) -> tuple[int, str]:
        if baseline is not None:
            Path("baseline").mkdir(exist_ok=True)
            Path("baseline/made.json").write_text(json.dumps({"commit": "before", "figures": baseline}))
        made = Measure("made", figures if callable(figures) else lambda: figures, bounds)
        return keep.main(arguments, {"made": made}, Path("baseline")), capsys.readouterr().err

    return measure


def fails(error: Exception) -> Callable[[], Any]:
    def measure() -> None:
        raise error

    return measure


@pytest.mark.parametrize(
    ("value", "bound", "error"),
    [
        (3, equal(), ""),
        (4, equal(), "found 4; the baseline has 3; expected equal"),
        (3.25, within(0.25), ""),
        (2.5, within(0.25), "found 2.5; the baseline has 3; expected within 0.25"),
        (float("nan"), within(0.25), "found nan; the baseline has 3"),
        (3, at_most(), ""),
        (4, at_most(), "found 4, and the limit is 3; expected at most the baseline"),
        (2, at_most(1), "found 2, and the limit is 1; expected at most 1"),
        ([0, 2, 1], at_most(1), "found 2, and the limit is 1"),
        (2, at_least(2), ""),
        ("two", at_least(2), "found two; expected at least 2"),
        ([3, 3], within(1), "found 2 values; the baseline has 1"),
        (9, reported(), ""),
    ],
)
def test_a_broken_bound_ends_with_status_1_and_a_sentence(value: Any, bound: Bound, error: str, run: Run) -> None:
    status, told = run({"figure": value}, {"figure": bound}, "--out", "out.json", baseline={"figure": 3})
    assert status == bool(error)
    assert ("made, figure: " in told) == bool(error)
    assert error in told
    figure = json.loads(Path("out.json").read_text())["measures"]["made"]["figures"]["figure"]
    assert (figure["verdict"] == "held") == (not error)
    assert figure["baseline"] == 3


def test_ranks_may_differ_where_the_baseline_s_gap_is_small_and_not_elsewhere() -> None:
    made = Measure("made", dict, {"ranks": equal("gaps", 2e-6), "gaps": reported()})
    baseline: dict[str, Value] = {"ranks": [1, 2, 5], "gaps": [0.1, 2e-6, 2.1e-6]}
    assert errors(made, {"ranks": [1, 3, 5], "gaps": [0, 0, 0]}, baseline) == {}
    (told,) = errors(made, {"ranks": [1, 3, 4], "gaps": [0, 0, 0]}, baseline).values()
    assert told == "1 of 3 values differ; value 2 is 4, and the baseline has 5; expected equal where gaps > 2e-06"


@pytest.mark.parametrize(
    ("figures", "error"),
    [
        ({"one": 1.0}, "made, two: the figure was not measured."),
        ({"one": 1.0, "two": 2.0, "three": 3.0}, "made, three: the figure has no bound"),
        ({"one": 1.0, "two": 2.0, "part 2": 1.0}, "made, part 2: the baseline lacks it; write it by"),
        ({"one": 1.0, "two": 2.0}, "made, part *: the figure was not measured."),
    ],
)
def test_a_figure_without_its_bound_baseline_or_value_fails(figures: dict[str, float], error: str, run: Run) -> None:
    bounds = {"one": at_most(1), "two": at_least(2), "part *": within(1)}
    status, told = run(figures, bounds, baseline={"one": 1, "two": 2})
    assert status == 1
    assert error in told


def test_what_cannot_be_measured_is_told_and_what_fails_breaks(run: Run) -> None:
    missing, bounds = fails(NotMeasuredError("LPN_FLIGHTS is not set")), {"one": equal()}
    status, told = run(missing, bounds, "--out", "out.json")
    assert status == 0
    assert "made was not measured: LPN_FLIGHTS is not set." in told
    assert "LPN_FLIGHTS" in json.loads(Path("out.json").read_text())["measures"]["made"]["not_measured"]
    status, told = run(missing, bounds, "--accept", "made")
    assert status == 1
    assert "nothing was measured, so its baseline stays as it is" in told
    assert not Path("baseline").exists()
    status, told = run(fails(KeyError("x")), bounds)
    assert status == 1
    assert "made failed: KeyError: 'x'" in told


@pytest.mark.usefixtures("run")
def test_a_run_that_was_killed_goes_on_in_the_same_state(monkeypatch: pytest.MonkeyPatch) -> None:
    measured = []

    def first() -> dict[str, float]:
        measured.append("first")
        return {"one": 1.0}

    def second() -> dict[str, float]:
        if measured[-1] != "again":
            raise KeyboardInterrupt
        return {"two": 2.0}

    both = {
        "first": Measure("first", first, {"one": equal()}),
        "second": Measure("second", second, {"two": at_least(2)}),
    }
    with pytest.raises(KeyboardInterrupt):
        keep.main(["--out", "out.json"], both, Path("baseline"))
    assert list(json.loads(Path("out.json").read_text())["measures"]) == ["first"]
    measured.append("again")
    Path("baseline").mkdir()
    Path("baseline/first.json").write_text('{"commit": "before", "figures": {"one": 1.0}}')
    # Measured figures are compared with the present baseline.
    assert keep.main(["--out", "out.json"], both, Path("baseline")) == 0
    assert measured == ["first", "again"]
    monkeypatch.setattr(keep, "_state", lambda *_: "another state")
    with pytest.raises(KeyboardInterrupt):
        keep.main(["--out", "out.json"], both, Path("baseline"))
    assert measured == ["first", "again", "first"]


def test_accept_writes_the_baseline_of_the_named_measure(run: Run) -> None:
    given: tuple[Any, ...] = ({"list": [1, 2.5], "text": "a"}, {"*": equal()})
    assert run(*given, baseline={"list": [1, 2], "text": "a"})[0] == 1
    assert run(*given, "--accept", "made")[0] == 0
    text = Path("baseline/made.json").read_text()
    assert json.loads(text) == {"commit": "one state", "figures": given[0]}
    assert '\n  "list": [1,2.5],\n' in text  # a line for each figure, so that a change can be read
    assert run(*given)[0] == 0


@pytest.mark.parametrize("content", ["[]", "{", '{"commit": "one state"}'])
def test_a_file_that_is_none_of_this_program_is_refused_and_stays(content: str, run: Run) -> None:
    Path("out.json").write_text(content)
    status, told = run({"one": 1.0}, {"*": reported()}, "--out", "out.json")
    assert status == 1
    assert 'out.json is no JSON of tools.keep with "measures"' in told
    assert Path("out.json").read_text() == content


def test_the_quick_measures_have_baselines_and_an_unknown_one_is_named(capsys: pytest.CaptureFixture[str]) -> None:
    assert keep.main(["nothing"]) == 1
    assert "There is no measure nothing; there are " in capsys.readouterr().err
    files = {file.stem: file.stat().st_size for file in keep.BASELINE.glob("*.json")}
    assert {name for name, one in KNOWN.items() if not one.slow} <= set(files) <= set(KNOWN)
    assert sum(files.values()) < 150_000


def test_the_demo_s_ranked_tiles_are_those_of_the_baseline() -> None:
    assert keep.main(["matches"]) == 0


# The figures of slow measures, and their bounds.


def test_errors_of_the_rendered_flight_may_not_grow() -> None:
    point = {"photos": 34, "median": 1.0, "ce95": 1.7, "largest": 3.0, "within": {"1": 94.1, "2": 100.0, "3": 100.0}}
    measured = {"frames": 40, "surveyed": {"registration": {"camera": point, "ground": point}}}
    figures = flights.rendered_figures(measured)
    assert (figures["photos"], figures["placed"], figures["middle within 1 radii"]) == (40, 34, 94.1)
    assert errors(KNOWN["rendered"], figures, figures) == {}
    worse = {"placed": 33, "camera largest m": 5.1, "middle within 2 radii": 93.0, "camera within 3 radii": 97.1}
    assert set(errors(KNOWN["rendered"], {**figures, **worse}, figures)) == set(worse)


def track(*rows: tuple[str, object, object, str]) -> Mapping[str, Any]:
    """The figures of a real flight of 30 photos; `rows` sets names, metres east and north, and states of some photos."""
    filled = [(str(i), i, i, "accepted") for i in range(30 - len(rows))]
    return flights.real_figures(
        [
            {"frame": name, "state": state, "easting_m": str(x), "northing_m": str(y), "radius_on_map_m": "6.0"}
            for name, x, y, state in [*rows, *filled]
        ]
    )


@pytest.mark.parametrize(
    ("first", "second", "wrong"),
    [
        ((108, 208, "accepted"), (300, 400, "accepted"), set()),  # 11.3 m off, and 2 radii are 12 m
        ((109, 209, "accepted"), (300, 400, "accepted"), {"places"}),
        ((float("nan"), 200, "accepted"), (300, 400, "accepted"), {"places"}),
        ((100, 200, "accepted"), ("", "", "refused"), {"placed", "placed photos", "places"}),
    ],
)
def test_places_of_the_real_flight_may_move_by_two_radii(first: Any, second: Any, wrong: set[str]) -> None:
    before = track(("a", 100, 200, "accepted"), ("b", 300, 400, "contradicted"))
    assert before["placed"] == 30
    assert errors(KNOWN["real"], before, before) == {}
    assert set(errors(KNOWN["real"], track(("a", *first), ("b", *second)), before)) == wrong


@pytest.mark.parametrize(
    ("elsewhere", "coarse", "beyond", "wrong"),
    [
        (0, 5, 0, set()),
        (1, 4, 0, {"over caliterra accepted"}),
        (0, 3, 0, {"own, 1 m a pixel accepted"}),
        (0, 4, 1, {"own, 1 m a pixel beyond"}),
    ],
)
def test_nothing_more_is_accepted_over_a_wrong_map(elsewhere: int, coarse: int, beyond: int, wrong: set[str]) -> None:
    def figures(elsewhere: int, coarse: int, beyond: int) -> Mapping[str, Any]:
        names = "brighton, mirrored", "caliterra", "own, 1 m a pixel"
        counts = (0, 0), (elsewhere, elsewhere), (coarse, beyond)
        return flights.wrong_map_figures(
            [
                {"map": name, "photos": 18, "accepted": accepted, "beyond": off}
                for name, (accepted, off) in zip(names, counts, strict=True)
            ]
        )

    before = figures(0, 4, 0)
    assert errors(KNOWN["wrong-brighton"], before, before) == {}
    assert set(errors(KNOWN["wrong-brighton"], figures(elsewhere, coarse, beyond), before)) == wrong


@pytest.mark.slow
def test_a_gpu_is_compared_in_each_precision_and_by_each_provider_where_there_is_one(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(NotMeasuredError, match=r"^torch .* finds no GPU here$"):
        published.on_gpu()
    tiny = ParityCase("vgg16_bn", 3, 1, ("drone",), size=64, options=True)
    figures = published.of_case(tiny, "cpu", ("bfloat16",))
    figures = {f"{tiny}{precision}": value for precision, value in figures.items()} | published.of_providers(tiny)
    assert set(figures) >= {str(tiny), f"{tiny}, bfloat16", "exported, cpu"}
    # Mixed precision differs, and is only reported.
    assert figures[f"{tiny}, bfloat16"] > published.ON_GPU
    assert errors(KNOWN["gpu"], figures, {}) == {}
    assert set(errors(KNOWN["gpu"], {**figures, str(tiny): 1.1e-4}, {})) == {str(tiny)}


def test_three_trainings_are_reduced_to_their_mean_and_half_their_range() -> None:
    found = training_figures([{"R@1": 77.1}, {"R@1": 78.0}, {"R@1": 78.35}])
    assert found == {"R@1 mean": 77.82, "R@1 half range": 0.62, "R@1 by seed": [77.1, 78.0, 78.35]}


def test_the_truth_of_a_rendered_flight_is_surveyed_at_camera_and_middle(tmp_path: Path) -> None:
    truth, out = tmp_path / "truth.csv", tmp_path / "positions.csv"
    truth.write_text("file,latitude,longitude,middle_latitude,middle_longitude\na.webp,46.1,-31.1,46.2,-31.2\n")
    flights.write_positions(truth, out)
    frame = LocalFrame(46.1, -31.1)
    camera, ground = read_surveyed(out, frame)
    assert (camera.photo, ground.photo, camera.point, ground.point) == ("a.webp", "a.webp", "camera", "ground")
    found = frame.degrees(np.array([camera[1:3], ground[1:3]]))
    np.testing.assert_allclose(found, [(46.1, -31.1), (46.2, -31.2)], atol=1e-6)


@pytest.mark.slow
def test_forged_tags_are_those_of_the_flight_turned_and_moved() -> None:
    flight, own = open_pair(RENDERED, Path())
    moved = forged(flight, own, own, 3)
    before, after = own.frame.xy(*flight.degrees.T), own.frame.xy(*moved.degrees.T)
    steps, turned = np.diff(before, axis=0), np.diff(after, axis=0)
    np.testing.assert_allclose(np.linalg.norm(turned, axis=1), np.linalg.norm(steps, axis=1), atol=0.05)
    long = np.linalg.norm(steps, axis=1) > 5
    turns = wrap_degrees(np.degrees(np.arctan2(*turned.T) - np.arctan2(*steps.T)))[long]
    np.testing.assert_allclose(wrap_degrees(turns - turns[0]), 0, atol=0.5)
    headings = np.array([[frame.heading for frame in one.frames] for one in (moved, flight)], float)
    np.testing.assert_allclose(wrap_degrees(headings[0] - headings[1] - turns[0]), 0, atol=0.5)
    west, south, east, north = own.bounds
    assert ((after >= (west, south)) & (after <= (east, north))).all()
    assert np.linalg.norm(after.mean(axis=0) - before.mean(axis=0)) > 5


def test_a_killed_measure_goes_on_with_its_rows_unless_the_code_has_changed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(_resumable, "_ROOT", tmp_path)
    monkeypatch.setenv("LPN_CACHE", "the user's")
    source = tmp_path / "lpn" / "one.py"
    source.parent.mkdir()
    source.write_text("1")
    measured = []

    def measure(name: str) -> list[str]:
        measured.append(name)
        return [name]

    def rows(names: str, killed: bool = False) -> list[list[str]]:
        with _resumable.resumable("rows") as work:
            assert os.environ["LPN_CACHE"] == str(work / "cache")
            found = [_resumable.keep_row(work / "rows.json", name, lambda name=name: measure(name)) for name in names]
            if killed:
                raise KeyboardInterrupt
        assert not work.exists()
        return found

    for _ in range(2):
        with pytest.raises(KeyboardInterrupt):
            rows("a", killed=True)
    assert os.environ["LPN_CACHE"] == "the user's"
    assert rows("ab") == [["a"], ["b"]]
    assert measured == ["a", "b"]
    with pytest.raises(KeyboardInterrupt):
        rows("a", killed=True)
    source.write_text("2")
    rows("ab")
    assert measured == ["a", "b", "a", "a", "b"], "rows of other code do not count"


def test_a_command_that_fails_is_named_with_its_sentence(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"^lpn locate ended with status 2: .*none\.tif.*$"):
        _resumable.run_lpn("locate", "--map", tmp_path / "none.tif", "--flight", tmp_path, "--out", tmp_path / "t.csv")
