from __future__ import annotations

import csv
import io
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import lpn
from lpn import retrieval
from lpn.analysis import breakdown
from lpn.cli import main
from lpn.core.arrays import Float32Array
from lpn.core.errors import DataError, InputError
from lpn.core.tables import number_column, text_column
from lpn.datasets import Picture, Truth, geo, labels_of, open_dataset
from lpn.models.base import normalise
from lpn.retrieval import metrics, ranks, scoring
from lpn.tasks import notes
from lpn.tasks.query_outcomes import OUTCOME_COLUMNS, Outcomes, compared_ranks, picture_columns, table
from lpn.tasks.task import Task
from tests.conftest import Refused
from tools.fixtures import small_worlds
from tools.fixtures.tasks import descriptor_task


def descriptors(count: int, n: int = 4, size: int = 6, seed: int = 0) -> Float32Array:
    return normalise(np.random.default_rng(seed).standard_normal((count, n, size)).astype(np.float32))


def one_by_one(
    queries: Float32Array,
    gallery: Float32Array,
    query_labels: np.ndarray,
    labels: np.ndarray,
    weights: Float32Array,
    truth: list[Truth] | None = None,
) -> list[tuple[int, int, int, int, float, list[float], int]]:
    """The same outcomes from a whole ranking of each query, as the explorer makes it."""
    found = []
    for i, query in enumerate(queries):
        of = None if truth is None else truth[i]
        cosines = scoring.part_cosines(query.astype(np.float64), gallery.astype(np.float64))
        ranking = retrieval.rank(cosines, weights, labels, int(query_labels[i]), of)
        order = ranking.order.tolist()
        good = [position for position, index in enumerate(order) if ranking.relevant[index]]
        bad = [position for position, index in enumerate(order) if not ranking.relevant[index]]
        true, false = (order[at[0]] if at else -1 for at in (good, bad))
        parts, margin, decides = [np.nan] * len(weights), np.nan, -1
        if good and bad:
            parts = [float(2 * w * (a - b)) for w, a, b in zip(weights, cosines[true], cosines[false], strict=True)]
            margin = 2 * float(ranking.scores[true] - ranking.scores[false])
            decides = parts.index(max(parts) if good[0] == 0 else min(parts))
        found.append((good[0] if good else -1, order[0] if order else -1, true, false, margin, parts, decides))
    return found


def compare(outcomes: Outcomes, expected: list[tuple[int, int, int, int, float, list[float], int]]) -> None:
    names = ("rank", "answer", "true", "false", "margin", "parts", "deciding_part")
    for name, column in zip(names, zip(*expected, strict=True), strict=True):
        np.testing.assert_allclose(getattr(outcomes, name), column, atol=1e-7, err_msg=name)
    np.testing.assert_array_equal(outcomes.parts.sum(axis=1), outcomes.margin)
    found = outcomes.rank == 0
    assert (outcomes.margin[found & ~np.isnan(outcomes.margin)] >= 0).all()
    assert (outcomes.margin[outcomes.rank > 0] <= 0).all()


def build(
    queries: Float32Array,
    gallery: Float32Array,
    query_labels: object,
    labels: object,
    truth: list[Truth] | None = None,
    weights: list[float] | None = None,
) -> Outcomes:
    task = descriptor_task(queries, gallery, query_labels, labels, truth)
    return replace(task, weights=weights).outcomes


def random_task(root: Path, n: int = 4) -> Task:
    """A task of a data set's pictures with random descriptors."""
    queries, gallery = open_dataset(root).queries("drone"), open_dataset(root).gallery("satellite")
    sides = descriptors(len(queries), n), descriptors(len(gallery), n)
    task = descriptor_task(*sides, labels_of(queries), labels_of(gallery))
    return replace(task, root=root, queries=queries, gallery=gallery)


@pytest.mark.parametrize("block", [64_000_000, 700])
@pytest.mark.parametrize("weights", [None, [0.1, 0.0, 3, 1]])
def test_outcomes_are_those_of_each_query_ranked_alone(
    block: int, weights: list[float] | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ranks, "_BLOCK_BYTES", block)
    monkeypatch.setattr("lpn.tasks.query_outcomes._CHUNK_BYTES", block)
    rng = np.random.default_rng(1)
    queries, gallery = descriptors(50), descriptors(30, seed=1)
    labels, asked = rng.integers(-1, 9, 30), rng.integers(0, 11, 50)
    gallery[20] = gallery[4]
    queries[:15] = normalise(queries[:15] + 2 * gallery[rng.integers(0, 30, 15)])
    outcomes = build(queries, gallery, asked, labels, weights=weights)
    used = scoring.part_weights(4, weights).astype(np.float64)
    compare(outcomes, one_by_one(queries, gallery, asked, labels, used))
    assert {-1, 0, 2} <= set(outcomes.rank.tolist())
    if weights is None:
        np.testing.assert_array_equal(outcomes.rank, metrics.retrieve(queries, asked, gallery, labels).first)
        np.testing.assert_array_equal(outcomes.answer, metrics.retrieve(queries, asked, gallery, labels).best)


def test_true_matches_and_junk_may_come_from_lists() -> None:
    rng = np.random.default_rng(2)
    queries, gallery = descriptors(12), descriptors(20, seed=3)
    truth = []
    for count in range(12):
        drawn = rng.permutation(20)
        truth.append(Truth(np.sort(drawn[: count % 4]), np.sort(drawn[count % 4 : 2 * count])))
    outcomes = build(queries, gallery, None, None, truth)
    nothing = np.zeros(20, np.int64)
    compare(outcomes, one_by_one(queries, gallery, nothing, nothing, np.full(4, 0.25, np.float32), truth))
    np.testing.assert_array_equal(outcomes.rank, metrics.retrieve(queries, None, gallery, None, truth).first)


def test_where_nothing_is_false_or_all_is_junk_there_is_no_margin() -> None:
    queries, gallery = descriptors(2), descriptors(3, seed=1)
    alone = build(queries, gallery, [5, 6], [5, 5, 5])
    assert alone.rank.tolist() == [0, -1]
    assert alone.false.tolist()[0] == alone.true.tolist()[1] == -1
    assert np.isnan(alone.margin).all()
    assert alone.deciding_part.tolist() == [-1, -1]
    junk = build(queries, gallery, [5, 6], [-1, -1, -1])
    assert [junk.answer.tolist(), junk.rank.tolist()] == [[-1, -1], [-1, -1]]
    listed = build(queries, gallery, None, None, [Truth(np.zeros(0, np.int64), np.arange(3))] * 2)
    assert listed.answer.tolist() == [-1, -1]


def test_progress_is_told_and_can_end_the_work(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ranks, "_BLOCK_BYTES", 4 * 5 * 4)
    told: list[tuple[int, int]] = []
    sides = descriptors(10), np.arange(10), descriptors(5), np.arange(5)
    metrics.retrieve(*sides, progress=lambda done, of: told.append((done, of)))
    assert told == [(4, 10), (8, 10), (10, 10)]

    def stop(done: int, of: int) -> None:
        raise InterruptedError(f"{done} of {of}")

    with pytest.raises(InterruptedError, match="4 of 10"):
        metrics.retrieve(*sides, progress=stop)


def described(root: Path, model_file: Path) -> Task:
    return lpn.open_task(root, model=model_file)


def world_json(root: Path) -> None:
    """A plan with two districts; places with an even number have twins."""
    shown = [(file.relative_to(root).as_posix(), int(file.parent.name)) for file in sorted(root.rglob("*.png"))]
    ids = sorted({number for _, number in shown})
    plan = {
        "districts": [{"number": i, "name": f"Dock {i}", "character": "industry"} for i in range(2)],
        "buildings": [
            {"id": i, "district": i // 13, "kind": "hall", "height": i + 0.5, "twins": None if i % 2 else 1}
            for i in ids
        ],
        "pictures": [{"path": path, "id": number} for path, number in shown],
    }
    (root / "world.json").write_text(json.dumps(plan))


@pytest.fixture(scope="module")
def known(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A data set with everything that can be known of its pictures."""
    root = small_worlds.map_dataset(small_worlds.make_dataset(tmp_path_factory.mktemp("known") / "places"))
    world_json(root)
    lines = ["path,weather,Battery left,2nd"]
    files = sorted((root / "test" / "query_drone").rglob("*.png"))
    for i, file in enumerate(files[:-1]):
        lines.append(f"{file.relative_to(root).as_posix()},{('rain', '=sun', '')[i % 3]},{80 - i}.5,{i or ''}")
    (root / "metadata.csv").write_text("\n".join(lines) + "\n")
    return root


def test_a_table_has_a_row_for_each_query_and_a_column_for_all_that_is_known(known: Path, model_file: Path) -> None:
    task = described(known, model_file)
    queries, gallery, outcomes = task.queries, task.gallery, task.outcomes
    made = table(task, outcomes, ["1 centre", "2", "3", "4 outer"])
    assert list(made.columns)[:8] == [name for name in OUTCOME_COLUMNS if name not in ("rank A", "rank B")][:8]
    of_pictures = [column.name for column in picture_columns(made)]
    assert of_pictures == [
        *("latitude", "longitude", "altitude", "heading", "tilt", "fov"),
        *("district", "character", "kind", "height", "twins", "weather", "Battery left", "2nd"),
    ]
    where = geo.Positions(known)
    for i, query in enumerate(queries):
        row = {name: column.values[i] for name, column in made.columns.items()}
        answer, truth = gallery[outcomes.answer[i]], gallery[outcomes.true[i]]
        assert (row["name"], row["answer"], row["truth"]) == (query.name, answer.name, truth.name)
        assert row["rank"] == outcomes.rank[i] + 1
        assert row["part"].startswith(str(outcomes.deciding_part[i] + 1))
        assert row["distance"] == pytest.approx(geo.metres(where.of([query]), where.of([answer]))[0])
        assert row["altitude"] == 150
        assert sum(row[f"margin_{k}"] for k in range(1, 5)) == pytest.approx(row["margin"], abs=1e-12)
        assert (row["district"], row["height"]) == (f"Dock {query.label // 13}", query.label + 0.5)
        assert row["twins"] == ("no" if query.label % 2 else "yes")
    assert np.isnan(made.columns["Battery left"].values[-1])
    assert made.columns["Battery left"].values[:2].tolist() == [80.5, 79.5]
    assert made.columns["weather"].values[:4].tolist() == ["rain", "=sun", "", "rain"]


def test_metadata_may_have_columns_that_the_table_has_not(tmp_path: Path) -> None:
    root = small_worlds.make_dataset(tmp_path / "places", train=0)
    task = random_task(root, 1)
    names = ["part", "distance", "overlap", "semi", "margin_1", "margin_9"]
    path = task.queries[0].path.relative_to(root).as_posix()
    (root / "metadata.csv").write_text(f"path,{','.join(names)}\n{path},1,2,3,4,5,6\n")
    made = task.table
    assert [made.columns[name].values[0] for name in names] == [1, 2, 3, 4, 5, 6]


def test_a_data_set_of_which_nothing_is_known_has_its_outcomes_only(data: Path, model_file: Path) -> None:
    task = described(data, model_file)
    made = table(task, task.outcomes, ["1", "2", "3", "4"])
    assert picture_columns(made) == []
    assert "distance" not in made.columns
    assert set(made.columns["part"].values) <= {"1", "2", "3", "4"}


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "is empty; expected path"),
        ("name,x\n", "is name,x; expected path"),
        ("path\n", "is path; expected path and"),
        ("path,a,A\n", "'A', which exists already"),
        ("path,rank\n", "'rank', which exists already"),
        ("path,Rank B\n", "'Rank B', which exists already"),
        ("path,a<b\n", "without any of"),
        ("path,\n", "called ''"),
        ("path,a\nx.png,1,2\n", "Line 2 of metadata.csv should have 2 values, path,a, and has 3"),
        ("path,a\nx.png,1\n./x.png,1\n", "Line 3 of metadata.csv is"),
        ("path,a\nx.png,1\n", "names none of the 14 queries"),
        ("path,\xff", "not text in UTF-8"),
    ],
)
def test_metadata_that_cannot_be_used_is_one_sentence(tmp_path: Path, text: str, said: str) -> None:
    root = small_worlds.make_dataset(tmp_path / "places", train=0)
    task = random_task(root)
    (root / "metadata.csv").write_bytes(text.encode("latin-1"))
    with pytest.raises(DataError) as error:
        _ = task.table
    assert said in str(error.value)


def outcomes_of(rank: list[int], first: list[int], decides: list[int]) -> Outcomes:
    """Outcomes of which nothing else matters."""
    count = len(rank)
    columns = [np.array(values, np.int64) for values in (rank, first, [0] * count, [0] * count)]
    numbers = np.zeros((count, 3)), np.zeros(count), np.array(decides), np.ones(3) / 3
    return Outcomes(*columns, *numbers, np.ones(count, bool))


def test_confusions_and_blame_count_failures() -> None:
    outcomes = outcomes_of([0, 1, 4, 1, 2, -1, -1], [2, 1, 1, 0, 3, 3, -1], [2, 0, 1, 1, 1, -1, -1])
    places, tiles = np.array([3, 3, 3, 2, 3, 9, 9]), np.array([1, 2, 3, 2])
    found = breakdown.confusions(outcomes, places, tiles)
    listed = [(c.place, c.answered, c.queries.tolist(), c.tile) for c in found]
    assert listed == [(3, 2, [1, 2, 4], 1), (2, 1, [3], 0), (9, 2, [5], 3)]
    assert breakdown.blame(outcomes).tolist() == [1, 3, 0]
    chosen = np.array([4, 3, 0])
    assert [len(c.queries) for c in breakdown.confusions(outcomes, places, tiles, chosen)] == [1, 1]
    assert breakdown.blame(outcomes, chosen).tolist() == [0, 2, 0]
    assert breakdown.confusions(outcomes, places, tiles, np.array([0])) == []


def test_a_hub_is_a_tile_that_answers_queries_of_several_other_places() -> None:
    outcomes = outcomes_of([1, 1, 1, 1, 0], [2, 2, 0, 2, 1], [0] * 5)
    places = np.array([5, 5, 6, 7, 8])
    assert [(h.tile, h.queries.tolist(), h.places) for h in breakdown.hubs(outcomes, places)] == [(2, [0, 1, 3], 2)]
    assert breakdown.hubs(outcomes, places, np.array([0, 1, 2])) == []


def test_wilson_intervals_are_the_published_ones() -> None:
    # Newcombe, Statistics in Medicine 17 (1998), Table I, method 3.
    for hits, of, expected in [(81, 263, (0.2553, 0.3662)), (15, 148, (0.0624, 0.1605)), (0, 20, (0.0, 0.1611))]:
        assert breakdown.wilson(hits, of) == pytest.approx(expected, abs=1e-4)
    assert breakdown.wilson(29, 29) == pytest.approx((0.8830, 1.0), abs=1e-4)


def test_failure_rates_are_counted_in_quantile_bins() -> None:
    rng = np.random.default_rng(0)
    values = rng.permutation(100).astype(np.float64)
    failed = values >= 60
    values[values == 7] = np.nan
    found = breakdown.rates(failed, number_column("altitude", values, "m"))
    assert len(found) == 6
    assert (sum(rate.queries for rate in found), sum(rate.failures for rate in found)) == (100, 40)
    for rate in found[:-1]:
        within = (values >= rate.low) & (values <= rate.high)
        assert (rate.queries, rate.failures) == (within.sum(), failed[within].sum())
        assert 18 <= rate.queries <= 21
        assert rate.interval[0] <= rate.share <= rate.interval[1]
    assert (found[-1].name, found[-1].queries) == ("not known", 1)
    near = breakdown.rates(failed, number_column("time", 1.7e9 + np.arange(100) / 8, "s"))
    assert len({rate.name for rate in near}) == 5
    assert near[0].name == "1700000000 to 1700000002.4 s"
    tiny = breakdown.rates(failed, number_column("x", 1 + np.arange(100) * 1e-9))
    assert tiny[0].name == "1 to 1.000000019"
    # Equal values stay together, and few values have a bin each.
    tilt = np.repeat([-90.0, -50, -45], [5, 90, 5])
    assert [r.name for r in breakdown.rates(failed, number_column("tilt", tilt, "°"))] == ["-90°", "-50°", "-45°"]
    heading = number_column("heading", np.arange(0.0, 360.0, 10.0), "°")
    sectors = breakdown.rates(np.arange(36) < 3, heading)
    assert [r.name for r in sectors] == ["320 to 40°", "50 to 130°", "140 to 220°", "230 to 310°"]
    assert [(r.queries, int(r.holds(heading).sum())) for r in sectors] == [(9, 9)] * 4
    assert sectors[0].failures == 3
    # Ends are values of the column, whatever arithmetic rounds; headings of another range have common bins.
    rough = number_column("heading", np.random.default_rng(0).uniform(0, 360, 200).round(1), "°")
    for headings, count in ((rough, 200), (number_column("heading", np.arange(-170.0, 190.0, 40.0), "°"), 9)):
        found = breakdown.rates(np.zeros(count, bool), headings)
        assert [int(rate.holds(headings).sum()) for rate in found] == [rate.queries for rate in found]
        assert sum(rate.queries for rate in found) == count
    heavy = np.concatenate([np.zeros(80), np.arange(1, 21)])
    assert [r.queries for r in breakdown.rates(failed, number_column("x", heavy))] == [80, 20]
    chosen = np.arange(10)
    assert sum(r.queries for r in breakdown.rates(failed, number_column("x", heavy), rows=chosen)) == 10


def test_failure_rates_by_text_come_with_the_highest_first() -> None:
    failed = np.array([True, False, True, True, False])
    found = breakdown.rates(failed, text_column("district", ["a", "a", "b", "", "a"]))
    assert [(r.name, r.queries, r.failures) for r in found] == [("b", 1, 1), ("a", 3, 1), ("not known", 1, 1)]


def test_the_command_lists_failures_and_writes_them(
    known: Path, model_file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], refused: Refused
) -> None:
    own = tmp_path / "mine.csv"
    task = described(known, model_file)
    first = task.queries[3].path.relative_to(known).as_posix()
    notes.set_note(own, first, "odd", "-1 for the roof")
    common = ["failures", str(known), "--model", str(model_file), "--notes", str(own)]
    out = tmp_path / "out" / "failures.csv"
    chosen = ["--where", "district = 'no'", "--csv", str(out)]
    assert main.main([*common, *chosen]) == 0
    assert "0 of 14 queries" in capsys.readouterr().out
    assert main.main([*common, "--csv", str(out), "--top", "3"]) == 0
    said = capsys.readouterr().out
    for words in ("14 of 14 queries, 3 listed", "Failures by district", "1 centre", " taken for ", "Dock 1"):
        assert words in said
    rows = list(csv.DictReader(io.StringIO(out.read_text())))
    margins = [float(row["margin"]) for row in rows]
    assert margins == sorted(margins)
    np.testing.assert_allclose(margins, np.sort(task.outcomes.margin), atol=1e-6)
    by_path = {row["path"]: row for row in rows}
    assert (by_path[first]["tags"], by_path[first]["note"]) == ("odd", "'-1 for the roof")
    assert by_path[first]["weather"] in ("rain", "'=sun", "")
    for options, words in (
        (["--where", "hue > 1"], "'hue'"),
        (["--where", "rank B = 1"], "'rank B'"),
        (["--sort", "hue"], "'hue'"),
        (["--task", "street-to-satellite"], "drone-to-satellite"),
        (["--top", "0"], "1 or more"),
    ):
        assert words in refused(*common, *options)


def test_the_command_lists_the_ranks_of_two_models(
    known: Path, model_file: Path, one_part_model_file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "both.csv"
    command = ["failures", str(known), "--model", str(one_part_model_file), "--beside", str(model_file)]
    assert main.main([*command, "--where", "rank A > 1 and rank B = 1", "--sort", "rank A", "--csv", str(out)]) == 0
    printed = capsys.readouterr().out
    assert "rank A" in printed
    assert "┃ rank ┃" not in printed
    first, second = (described(known, file).outcomes.rank + 1 for file in (one_part_model_file, model_file))
    expected = np.sort(first[(first > 1) & (second == 1)])
    assert len(expected)
    rows = list(csv.DictReader(io.StringIO(out.read_text())))
    assert [row["rank A"] for row in rows] == [row["rank"] for row in rows] == [str(rank) for rank in expected]
    assert {row["rank B"] for row in rows} == {"1"}


def test_ranks_of_other_queries_are_refused() -> None:
    task = descriptor_task(descriptors(3), descriptors(4, seed=1), np.arange(3), np.arange(4))
    pictures = [Picture(Path(f"/data/{i}.jpg"), i, str(i)) for i in range(4)]
    made = replace(task, root=Path("/data"), queries=pictures[:3], gallery=pictures).table
    with pytest.raises(InputError, match="3 queries and 2 ranks"):
        compared_ranks(made, np.zeros(2, np.int64))
    other = compared_ranks(made, np.array([0, 5, -1]))[1]
    assert [other.text(row) for row in range(3)] == ["1", "6", ""]
