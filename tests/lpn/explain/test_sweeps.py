from __future__ import annotations

import csv
import io
from collections.abc import Iterator
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lpn import retrieval
from lpn.cli import main
from lpn.core import images
from lpn.core.arrays import Float32Array, UInt8Array
from lpn.core.errors import InputError
from lpn.core.views import View
from lpn.datasets import Truth
from lpn.descriptors.transforms import Change
from lpn.descriptors.weather import WEATHERS, Weather
from lpn.explain import sweeps
from lpn.explain.sweeps import SweepPoint, SweepResult, changes_over, sweep_points
from lpn.models.base import Model
from lpn.retrieval import scoring
from tools.fixtures import small_worlds
from tools.fixtures.tasks import match, ranked_in


@pytest.fixture(scope="module")
def tiles(model: Model) -> Float32Array:
    """Descriptors of places 0 to 5."""
    prepared = np.stack([model.prepare(small_worlds.place(label), "satellite") for label in range(6)])
    return model.descriptors(prepared, "satellite")


def test_a_rotation_shows_its_shape_early_and_goes_once_around() -> None:
    angles = [change.rotate for change in changes_over("rotation")]
    assert angles[:5] == [0, 180, 90, 270, 45]
    assert sorted(angles) == [15 * i for i in range(24)]
    assert sorted(change.rotate for change in changes_over("rotation", 100)) == [0, 100, 200, 300]


def test_shifts_and_zooms_go_both_ways_from_the_query_as_it_is() -> None:
    shifts = [change.shift for change in changes_over("shift", 10, 35, 64)]
    assert shifts[:3] == [0, -30, 30]
    assert sorted(shifts) == [-30, -20, -10, 0, 10, 20, 30]
    assert sorted(change.down for change in changes_over("shift-down", side=64)) == list(range(-16, 17, 2))
    zooms = [change.scale for change in changes_over("zoom", 2**0.5, 2)]
    assert zooms[0] == 1
    np.testing.assert_allclose(sorted(zooms), [0.5, 0.5**0.5, 1, 2**0.5, 2])


@pytest.mark.parametrize(
    ("given", "said"),
    [
        (("tilt",), "expected one of rotation, shift, shift-down, zoom"),
        (("rotation", 0), "step is 0"),
        (("rotation", float("nan")), "step is nan"),
        (("rotation", 0.01), "36000 points"),
        (("rotation", 15, 90), "leave its reach out"),
        (("shift", 1.5), "expected whole pixels"),
        (("shift", 8, 64, 64), "reach is 64"),
        (("zoom", 1.0), "step is 1"),
        (("zoom", 1.1, 99), "reach is 99"),
        (("weather", 1.0), "Weathers have no step"),
        (("weather", None, 0.0), "at which all are alike"),
        (("weather", None, 1.5), "strength is 1.5"),
    ],
)
def test_sweeps_that_mean_nothing_are_refused(given: tuple[object, ...], said: str) -> None:
    with pytest.raises(InputError, match=said):
        changes_over(*given)


def test_points_are_what_describing_and_ranking_gives(model: Model, tiles: Float32Array) -> None:
    picture, weights = small_worlds.from_drone(small_worlds.place(2), 3), scoring.part_weights(4, [1, 2, 1, 0])
    labels = np.array([5, 9, 2, 2, -1, 7])
    changes = [Change(rotate=90), Change(shift=9), Change(down=-7), Change(scale=1.5)]
    points = list(sweep_points(model, picture, "drone", changes, ranked_in(tiles, weights, labels, 2)))
    truth_list = Truth(np.array([2, 3]), np.array([4]))
    by_list = sweep_points(model, picture, "drone", changes, ranked_in(tiles, weights, truth=truth_list))
    for change, point, listed in zip(changes, points, by_list, strict=True):
        shaped = change.move(model.to_input_size(change.apply(picture), "drone"))
        direct = model.descriptors(images.normalise(shaped)[None], "drone")[0]
        ranking = retrieval.rank(scoring.part_cosines(direct, tiles), weights, labels, 2)
        truth, top = ranking.positive(), ranking.match(0)
        assert point.change == change
        for one in (point, listed):
            found = one.followed
            assert (found.index, found.rank, found.true, one.top.index) == (truth.index, truth.rank, True, top.index)
        assert point.followed.score == pytest.approx(truth.score, abs=1e-5)
        assert point.top.score == pytest.approx(top.score, abs=1e-5)
        np.testing.assert_allclose(point.followed.cosines, truth.cosines, atol=1e-5)
        assert point.followed.cosines @ weights == pytest.approx(point.followed.score, abs=1e-6)


def test_without_a_truth_a_chosen_tile_or_the_top_match_is_followed(model: Model, tiles: Float32Array) -> None:
    weights, changes = scoring.part_weights(4), [Change(), Change(rotate=180)]

    def points(view: View = "satellite", follow: int | None = None, **truth: Any) -> Iterator[SweepPoint]:
        return sweep_points(model, small_worlds.place(1), view, changes, ranked_in(tiles, weights, **truth), follow)

    chosen, top = list(points(follow=3)), list(points())
    assert [(point.followed.index, point.followed.true) for point in chosen] == [(3, None)] * 2
    assert [point.followed.index for point in top] == [point.top.index for point in top]
    assert {point.followed.rank for point in top} == {1}
    assert (top[0].top.index, top[0].followed.score) == (1, pytest.approx(1, abs=1e-5))
    with pytest.raises(InputError, match="Gallery picture 6 is not in the ranking"):
        next(points(follow=6))
    with pytest.raises(InputError, match="no tile to rank"):
        next(points(labels=np.full(6, -1)))
    with pytest.raises(InputError, match="no 'street' view"):
        next(points("street"))


def test_a_sweep_computes_no_further_than_it_is_asked(
    model: Model, tiles: Float32Array, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[Change] = []
    describe = retrieval.describe_picture

    def counted(model: Model, picture: UInt8Array, view: View, change: Change) -> retrieval.DescribedPicture:
        asked.append(change)
        return describe(model, picture, view, change)

    monkeypatch.setattr(retrieval, "describe_picture", counted)
    changes = changes_over("rotation", 30)
    points = sweep_points(model, small_worlds.place(1), "drone", changes, ranked_in(tiles, scoring.part_weights(4)))
    assert [point.change for point in islice(points, 3)] == changes[:3] == asked


def point(change: Change, score: float, rank: int, top_score: float) -> SweepPoint:
    return SweepPoint(change, match(4, rank, score, True), match(5, 1, top_score, False))


def test_a_profile_tells_the_best_change_and_what_it_gains() -> None:
    points = [
        point(Change(rotate=180), 0.5, 3, 0.9),
        point(Change(rotate=-90), 0.7, 2, 0.8),
        point(Change(), 0.6, 6, 0.65),
        point(Change(rotate=90), 0.7, 1, 0.9),
    ]
    turned = SweepResult("rotation", tuple(points))
    assert [round(sweeps.swept_value("rotation", p.change)) for p in turned.points] == [0, 90, 180, 270]
    assert turned.best.change.rotate == 90
    assert turned.best_top_match.change.rotate == 90
    assert SweepResult("rotation", tuple(points[:3])).best_rank.change.rotate == -90
    assert turned.gain(turned.best) == (5, pytest.approx(0.1))
    assert turned.heading() == 270
    rows = list(csv.DictReader(io.StringIO(turned.to_csv().decode())))
    assert [row["rank"] for row in rows] == ["6", "1", "3", "2"]
    assert list(rows[0]) == [
        *("rotation", "score", "rank", "cosine 1", "cosine 2"),
        *("tile", "true", "top", "top score"),
    ]
    so_far = SweepResult("rotation", tuple(points[:2]))
    assert so_far.unchanged is None
    assert so_far.gain(so_far.best) is None
    zoomed = SweepResult("zoom", (point(Change(scale=2), 0.8, 1, 0.8), point(Change(scale=0.8), 0.8, 1, 0.8)))
    assert zoomed.best.change.scale == 0.8
    assert zoomed.heading() is None


def test_a_tile_turned_as_a_drone_of_some_heading_sees_it_has_that_heading(model: Model, tiles: Float32Array) -> None:
    # Flying east, the east is at the top: the north-up tile is turned counter-clockwise by the heading.
    seen = images.rotate(small_worlds.place(3), 90)
    labels = np.arange(6)
    turned = changes_over("rotation", 90)
    points = tuple(sweep_points(model, seen, "satellite", turned, ranked_in(tiles, scoring.part_weights(4), labels, 3)))
    found = SweepResult("rotation", points)
    assert found.heading() == 90
    assert found.best.followed.score == pytest.approx(1, abs=1e-4)


def test_the_command_prints_a_table_and_writes_csv(
    data: Path, model_file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    table = tmp_path / "out" / "sweep.csv"
    common = ["explain", str(data), "--model", str(model_file), "--query", "0009"]
    files = ["--csv", str(table)]
    assert main.main([*common, "--over", "zoom", "--step", "1.4", "--weights", "1,1,0,0", *files]) == 0
    rows = list(csv.DictReader(io.StringIO(table.read_text())))
    assert [float(row["zoom"]) for row in rows] == sorted(1.4**power for power in range(-2, 3))
    said = capsys.readouterr().out
    assert "The true match scores highest" in said
    assert all(row["rank"] in said for row in rows)
    assert main.main([*common, "--over", "rotation", "--step", "90"]) == 0
    assert "clockwise from north" in capsys.readouterr().out
    assert main.main([*common, "--over", "weather", "--reach", "0.5", *files]) == 0
    rows = list(csv.DictReader(io.StringIO(table.read_text())))
    assert [row["weather"] for row in rows] == list(WEATHERS)
    said = capsys.readouterr().out
    assert all(f" {row['weather']} " in said and f"{float(row['score']):.3f}" in said for row in rows)


def test_a_sweep_over_weather_keeps_the_turn_and_begins_in_the_weather_there_is() -> None:
    base = Change(rotate=30, weather=Weather("rain", 0.5))
    changes = sweeps.apply_to_base("weather", base, sweeps.changes_over("weather", reach=0.5))
    assert changes[0] == base
    others = [name for name in WEATHERS if name != "rain"]
    assert changes[1:] == [Change(rotate=30, weather=Weather(name, 0.5)) for name in others]


def test_a_sweep_goes_away_from_what_is_done_to_the_query_already() -> None:
    base = Change(rotate=-90, shift=5)
    turns = sweeps.apply_to_base("rotation", base, sweeps.changes_over("rotation", 90))
    assert turns[0] == base
    # 270 degrees is -90 again.
    assert turns[1:] == [Change(rotate=angle, shift=5) for angle in (0, 180, 90)]
    shifts = sweeps.apply_to_base("shift", base, sweeps.changes_over("shift", 10, 10))
    assert [change.shift for change in shifts] == [5, 0, -10, 10]
    assert {change.rotate for change in shifts} == {-90.0}
    points = tuple(point(change, 0.1 * i, 1 + i, 0.5) for i, change in enumerate(turns))
    assert SweepResult("rotation", points, base).unchanged is points[0]
    assert SweepResult("rotation", points).unchanged is None
