from __future__ import annotations

import json
import re
import tracemalloc
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.io import savemat

import lpn
from lpn.cli.main import main
from lpn.core.errors import DataError, InputError, LPNError
from lpn.datasets import open_dataset
from lpn.datasets.geo import Position, metres
from lpn.retrieval import metrics
from lpn.retrieval.saved import load_saved
from lpn.tasks.changes import averaged, centred, with_parts
from lpn.tasks.measure import measure
from lpn.tasks.opening import lazy_task
from lpn.tasks.saved import array_task, saved_task
from lpn.tasks.task import Task
from tests.conftest import Refused
from tools.fixtures import layouts, seeded, small_worlds
from tools.fixtures.published_results import contents

VIEWS = ("drone", "satellite")


def test_parts_lie_in_the_file_as_the_published_code_lays_them(tmp_path: Path) -> None:
    published = np.load(seeded.DATA / "parity_n4.npz")
    labels = [1, 2]
    values = {f"{side}_f": published["descriptor"] for side in ("query", "gallery")}
    savemat(tmp_path / "r.mat", values | {f"{side}_label": labels for side in ("query", "gallery")})
    saved = load_saved(tmp_path / "r.mat", 4)
    assert saved.query.shape == (2, 4, 512)
    np.testing.assert_allclose(np.linalg.norm(saved.query, axis=2), 0.5, atol=1e-6)
    # A part of the descriptor points where the sum of the raw parts of picture and mirror does; both are of one part.
    raw = published["raw"].transpose(0, 2, 1)
    cosines = np.einsum("bnd,bmd->bnm", saved.query, raw) / np.linalg.norm(raw, axis=2)[:, None] / 0.5
    assert (cosines.argmax(axis=2) == np.arange(4)).all()


@pytest.fixture(scope="module")
def of_model(data: Path, model_file: Path) -> dict[str, Any]:
    """The entries of a result of the small model."""
    return contents(data, model_file)


@pytest.fixture
def values(of_model: dict[str, Any]) -> dict[str, Any]:
    return dict(of_model)


@pytest.fixture
def result(values: dict[str, Any], tmp_path: Path) -> Path:
    savemat(tmp_path / "r.mat", values)
    return tmp_path / "r.mat"


def save_without_paths(file: Path, values: dict[str, Any]) -> Path:
    savemat(file, {key: value for key, value in values.items() if "path" not in key})
    return file


def test_a_saved_result_gives_the_figures_of_its_model(data: Path, model_file: Path, result: Path) -> None:
    model, dataset = lpn.load(model_file), open_dataset(data)
    steps: list[tuple[int, Callable[[Task], Task]]] = [
        (1, lambda task: task),
        (4, lambda task: with_parts(task, (1, 3))),
        (4, averaged),
        (4, centred),
    ]
    for n, step in steps:
        found = measure(step(saved_task(load_saved(result, n))))
        expected = measure(step(lazy_task(model, dataset, "drone-to-satellite")))
        assert (found.recall, found.task, found.queries) == (expected.recall, "drone-to-satellite", 14)
        assert found.ap == pytest.approx(expected.ap, abs=1e-9)
        assert "descriptors as saved" in found.sentence


def test_a_saved_result_is_centred_part_by_part_only(result: Path, refused: Refused) -> None:
    assert "--n-parts" in refused("evaluate", result, "--centre")


def test_its_pictures_are_found_by_path_or_by_label(data: Path, values: dict[str, Any], result: Path) -> None:
    dataset = open_dataset(data)
    views, queries, gallery = load_saved(result).pictures(dataset)
    assert views == VIEWS
    assert queries == dataset.queries("drone")
    assert gallery == dataset.gallery("satellite")[::-1]
    for key in ("gallery_f", "gallery_label"):
        values[key] = values[key][::-1]
    saved = load_saved(save_without_paths(result, values))
    assert saved.task == "saved"
    assert saved.pictures(dataset)[2] == dataset.gallery("satellite")
    known = np.isin(values["gallery_label"], values["query_label"])
    values["gallery_label"] = np.where(known, values["gallery_label"], -1)
    assert load_saved(save_without_paths(result, values)).pictures(dataset)[2] == dataset.gallery("satellite")
    values["query_label"] = np.array(values["query_label"]) + 1
    with pytest.raises(DataError, match="in the order of their labels"):
        load_saved(save_without_paths(result, values)).pictures(dataset)


def test_pictures_of_another_data_set_are_not_taken(result: Path, tmp_path: Path) -> None:
    other = small_worlds.make_dataset(tmp_path / "other", train=1, test=3)
    with pytest.raises(DataError, match="/home/someone/test/query_drone/0007"):
        load_saved(result).pictures(open_dataset(other))


def test_without_pictures_nothing_is_named_or_paired(values: dict[str, Any], tmp_path: Path, refused: Refused) -> None:
    files = [save_without_paths(tmp_path / name, values) for name in ("r.mat", "s.mat")]
    for words in (["compare", *files], ["evaluate", files[0], "--per-query", tmp_path / "q.csv"]):
        assert "r.mat holds no pictures; give the data set that it was computed on as --data." in refused(*words)
    task = saved_task(load_saved(files[0]))
    steps: list[Callable[[], object]] = [lambda: task.table, lambda: measure(task, 3), measure(task).ranked]
    for step in steps:
        with pytest.raises(InputError, match=r"r\.mat holds no pictures; give the data set"):
            step()
    assert "14 queries" in task._repr_html_()


def test_csls_and_the_title_need_no_pictures(
    data: Path, model_file: Path, result: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["evaluate", str(result), "--csls", "3", "--json", str(tmp_path / "f.json")]) == 0
    assert capsys.readouterr().out.splitlines()[0].strip() == "r.mat"
    alone = lpn.evaluate(model_file, data, "drone-to-satellite", csls=3)
    found = json.loads((tmp_path / "f.json").read_text())
    assert [found[f"recall@{k}"] for k in (1, 5, 10)] == [alone.recall[k] for k in ("1", "5", "10")]
    assert found["ap"] == pytest.approx(alone.ap)


def small() -> dict[str, Any]:
    rng = np.random.default_rng(0)
    made: dict[str, Any] = {}
    for side, count in (("query", 3), ("gallery", 5)):
        made[f"{side}_f"] = rng.standard_normal((count, 8)).astype(np.float32)
        made[f"{side}_label"] = np.arange(count)
    return made


@pytest.mark.parametrize(
    ("change", "n_parts", "said"),
    [
        ({"gallery_label": None}, 1, "has no gallery_label; it holds"),
        ({"query_f": np.zeros((3, 4), np.float32)}, 1, "of 4 numbers"),
        ({"query_f": np.zeros((3, 2, 2), np.float32)}, 1, "shape \\(3, 2, 2\\)"),
        ({"query_f": np.zeros((3, 8), np.int16)}, 1, "int16"),
        ({"query_f": np.full((3, 8), np.nan, np.float32)}, 1, "not finite"),
        ({"query_label": np.arange(4)}, 1, "has 4 entries"),
        ({"query_label": np.array([0.5, 1, 2])}, 1, "expected one whole number"),
        ({"query_path": ["a", "b"]}, 1, "query_path .* 2 entries"),
        ({}, 3, "which are not 3 equal parts"),
        ({}, 2, "2 parts of norm"),
    ],
)
def test_files_that_do_not_fit_get_a_sentence(tmp_path: Path, change: dict[str, Any], n_parts: int, said: str) -> None:
    values = {key: value for key, value in (small() | change).items() if value is not None}
    savemat(tmp_path / "r.mat", values)
    with pytest.raises(LPNError, match=said):
        load_saved(tmp_path / "r.mat", n_parts)


def test_labels_that_fit_nothing_are_no_result_of_zero_percent(tmp_path: Path) -> None:
    savemat(tmp_path / "r.mat", small() | {"query_label": np.arange(3) + 1000})
    with pytest.raises(DataError, match=r"the query labels of r\.mat, such as 1000, is a gallery label, such as 0"):
        saved_task(load_saved(tmp_path / "r.mat"))


Q, G, N, D = 5, 7, 3, 4


@pytest.fixture
def arrays() -> tuple[np.ndarray, np.ndarray]:
    """Descriptors (Q, n, D) and (G, n, D) with parts of norm 1/sqrt(n)."""
    rng = np.random.default_rng(0)
    sides = (rng.standard_normal((Q, N, D)), rng.standard_normal((G, N, D)))
    query, gallery = (
        (side / np.linalg.norm(side, axis=2, keepdims=True) / np.sqrt(N)).astype(np.float32) for side in sides
    )
    return query, gallery


def write_list(folder: Path, positions: bool = True, unlabelled: tuple[int, ...] = ()) -> Path:
    """Write paths.csv; gallery row 6 is junk, and half of the pictures are there."""
    lines = ["file,side,label,latitude,longitude"]
    for row in range(Q):
        label = "" if row in unlabelled else f"place {row}"
        lines.append(f"q/{row}.png,query,{label},{f'46.{row}00,7.{row}' if positions else ','}")
    for row in range(G):
        label = "-1" if row == 6 else f"place {row % 5}"
        lines.append(f"g/{row}.png,gallery,{label},{f'46.{row}01,7.{row}' if positions else ','}")
        if row % 2:
            small_worlds.write(folder / "g" / f"{row}.png", layouts.small(row))
    (folder / "paths.csv").write_text("\n".join(lines) + "\n")
    return folder / "paths.csv"


def save(folder: Path, kind: str, side: str, array: np.ndarray) -> Path:
    file = folder / f"{side}.{kind}"
    if kind == "npy":
        np.save(file, array)
    elif kind == "npz":
        np.savez(file, **{side: array})
    else:
        savemat(file, {f"{side}_f": array})
    return file


@pytest.fixture
def files(tmp_path: Path, arrays: tuple[np.ndarray, np.ndarray]) -> list[Path]:
    return [save(tmp_path, "npy", side, array) for side, array in zip(("query", "gallery"), arrays, strict=True)]


@pytest.mark.parametrize(
    ("kind", "order"), [("npy", "parts-first"), ("npy", "parts-last"), ("npz", "parts-last"), ("mat", "parts-last")]
)
def test_every_form_gives_the_same_descriptors(
    tmp_path: Path, arrays: tuple[np.ndarray, np.ndarray], kind: str, order: str
) -> None:
    shaped = [side if order == "parts-first" else side.transpose(0, 2, 1) for side in arrays]
    files = [save(tmp_path, kind, side, array.copy()) for side, array in zip(("query", "gallery"), shaped, strict=True)]
    found = array_task(*files, write_list(tmp_path), N, order)
    for got, expected in zip((found.query_descriptors, found.gallery_descriptors), arrays, strict=True):
        np.testing.assert_allclose(got, expected, atol=1e-7)
    for side, array in zip(("query", "gallery"), shaped, strict=True):
        save(tmp_path, kind, side, array.reshape(len(array), -1))
    again = array_task(*files, n_parts=N, order=order)
    np.testing.assert_allclose(again.gallery_descriptors, arrays[1], atol=1e-7)


def test_rows_are_scaled_and_ranked_by_label(tmp_path: Path, arrays: tuple[np.ndarray, np.ndarray]) -> None:
    np.savez(tmp_path / "both.npz", query=3.0 * arrays[0].astype(np.float16), gallery=arrays[1].astype(np.float64))
    both = tmp_path / "both.npz"
    task = found = array_task(both, both, write_list(tmp_path))
    norms = np.linalg.norm(found.query_descriptors, axis=2)
    np.testing.assert_allclose(norms, 1 / np.sqrt(N), rtol=1e-6)
    labels = np.array([0, 1, 2, 3, 4, 0, -1])
    expected = metrics.evaluate(found.query_descriptors, np.arange(5), found.gallery_descriptors, labels)
    assert task.metrics == expected
    assert task.contract.claim == "parts only: the model gives no cells"
    assert task.geometry is not None
    order = np.argsort(
        -(found.query_descriptors.reshape(Q, -1) @ found.gallery_descriptors.reshape(G, -1).T)[:, :6], axis=1
    )
    assert task.outcomes.answer.tolist() == order[:, 0].tolist()
    assert len(task.table) == Q
    assert (task.gallery[1].cut is None, task.gallery[0].note) == (True, "no picture")
    assert task.gallery[0].load().shape == (256, 256, 3)


def test_queries_without_a_label_are_ranked_and_not_counted(tmp_path: Path, files: list[Path]) -> None:
    task = array_task(*files, write_list(tmp_path, positions=False, unlabelled=(1, 4)))
    assert task.known.tolist() == [True, False, True, True, False]
    assert task.outcomes.failed.sum() + task.outcomes.hits.sum() == 3
    assert task.geometry is None
    alone = array_task(*files)
    assert not alone.known.any()
    assert [picture.name for picture in alone.gallery][:2] == ["1", "2"]


def test_names_leave_out_the_folders_that_all_pictures_of_a_side_share(tmp_path: Path, files: list[Path]) -> None:
    lines = [f"test/query_drone/{row // 2}/{row}.jpg,query" for row in range(Q)]
    lines += [f"test/gallery_satellite/{row}.tile.png,gallery" for row in range(G)]
    (tmp_path / "paths.csv").write_text("\n".join(["file,side", *lines]))
    found = array_task(*files, tmp_path / "paths.csv")
    assert [picture.name for picture in found.queries] == ["0/0", "0/1", "1/2", "1/3", "2/4"][:Q]
    assert found.gallery[3].name == "3.tile"
    assert found.gallery[3].path == tmp_path / "test/gallery_satellite/3.tile.png"


def test_the_command_evaluates_plain_arrays(
    tmp_path: Path,
    arrays: tuple[np.ndarray, np.ndarray],
    files: list[Path],
    capsys: pytest.CaptureFixture[str],
    refused: Refused,
) -> None:
    given = ["evaluate", str(files[0]), "--gallery", str(files[1])]
    out = tmp_path / "figures.json"
    assert main([*given, "--paths", str(write_list(tmp_path)), "--json", str(out)]) == 0
    expected = metrics.evaluate(arrays[0], np.arange(5), arrays[1], np.array([0, 1, 2, 3, 4, 0, -1]))
    figures = json.loads(out.read_text())
    assert figures["ap"] == pytest.approx(expected["ap"])
    places = np.array([[46 + 0.1 * row, 7 + 0.1 * row] for row in range(G)])
    best = np.argmax(arrays[0].reshape(Q, -1) @ arrays[1].reshape(G, -1)[:6].T, axis=1)
    asked, shown = places[:Q], places[best] + (0.001, 0)
    steps = metres([Position(*place) for place in asked], [Position(*place) for place in shown])
    assert figures["median error m"] == pytest.approx(np.median(steps), rel=1e-6)
    assert figures["within 25 m"] == 100 * np.mean(np.array(steps) <= 25)
    assert main([*given, "--paths", str(write_list(tmp_path, positions=False)), "--json", str(out)]) == 0
    assert "median error m" not in json.loads(out.read_text())
    assert "have no position" not in capsys.readouterr().err
    some = write_list(tmp_path)
    some.write_text(some.read_text().replace("46.300,7.3", ",", 1))
    assert main([*given, "--paths", str(some), "--json", str(out)]) == 0
    assert "median error m" not in json.loads(out.read_text())
    assert "1 of 12 pictures in paths.csv have no position" in capsys.readouterr().err
    assert "1 of 5 queries have no label" in refused(*given, "--paths", write_list(tmp_path, unlabelled=(2,)))
    assert "give it as --paths" in refused(*given)


@pytest.mark.parametrize("label", ["", "-1"])
def test_labels_of_queries_alone_tell_nothing(
    tmp_path: Path, files: list[Path], label: str, caplog: pytest.LogCaptureFixture
) -> None:
    paths = write_list(tmp_path, positions=False)
    paths.write_text(re.sub("gallery,[^,\n]*", f"gallery,{label}", paths.read_text()))
    found = array_task(*files, paths)
    assert not found.known.any()
    assert [lists.known for lists in found.truth or []] == [False] * 5
    assert "No picture of the gallery has a label" in caplog.text


@pytest.mark.parametrize("label", ["query,own ", "query,"])
def test_complete_positions_measure_metres_without_labels(
    tmp_path: Path, files: list[Path], label: str, capsys: pytest.CaptureFixture[str]
) -> None:
    out, paths = tmp_path / "figures.json", write_list(tmp_path)
    given = ["evaluate", str(files[0]), "--gallery", str(files[1]), "--paths", str(paths)]
    assert main([*given, "--json", str(out)]) == 0
    labelled = json.loads(out.read_text())
    own = label != "query,"
    paths.write_text(
        "\n".join(
            line.replace("query,place ", label) if own else re.sub("query,place .", "query,", line)
            for line in paths.read_text().splitlines()
        )
    )
    capsys.readouterr()
    assert main([*given, "--json", str(out)]) == 0
    assert ("None of the queries has a label of the gallery" in capsys.readouterr().err) == own
    figures = json.loads(out.read_text())
    assert figures["recall@1"] is figures["ap"] is None
    assert figures["median error m"] == labelled["median error m"]


def edited(*changes: tuple[str, str]) -> Callable[[Path], None]:
    def write(folder: Path) -> None:
        file = folder / "paths.csv"
        text = file.read_text()
        for old, new in changes:
            text = re.sub(old, new, text)
        file.write_text(text)

    return write


def put(name: str, content: Callable[[], object]) -> Callable[[Path], None]:
    def write(folder: Path) -> None:
        value = content()
        if isinstance(value, bytes):
            (folder / name).write_bytes(value)
        else:
            np.save(folder / name, value)

    return write


@pytest.mark.parametrize(
    ("harm", "message"),
    [
        (edited(("query,place 3", "quary,place 3")), "Line 5 of paths.csv has the side 'quary'"),
        (edited(("file,side", "path,side")), "expected file,side"),
        (edited(("q/1.png", "../1.png")), "without '..'"),
        (edited(("46.100", "461")), "Line 3 of paths.csv has the position"),
        (edited((r"\Z", "g/8.png,gallery,1,,\n")), "8 lines of the side gallery, and the array 7 rows"),
        (edited((r"\Z", "g/8.png,gallery\n")), "should have 5 values, .*, and has 2"),
        (edited(("query,place ", "query,0"), ("46.100,7.1", ",")), "the first of their labels are '00' and 'place 0'"),
        (edited(("46.100,7.1", "0.0,0")), "Line 3 of paths.csv .* both empty where they are unknown"),
        (put("query.npy", lambda: b"nonsense"), "query.npy is no array that NumPy saved"),
        (put("query.npy", lambda: np.array([{}], object)), r"query.npy holds Python objects.*'float32'"),
        (put("query.npy", lambda: np.ones((Q, N, D), np.int64)), "int64 of shape"),
        (put("query.npy", lambda: np.ones((Q, N, D + 1), np.float32)), "rows of 3 x 5, and gallery.npy of 3 x 4"),
        (put("query.npy", lambda: np.zeros((Q, N, D), np.float32)), "5 rows of query.npy, the first being row 1"),
        (put("query.npy", lambda: np.full((Q, N, D), np.nan, np.float32)), "not finite or a part that is zero"),
    ],
)
def test_what_does_not_fit_is_told_in_one_sentence(
    tmp_path: Path, files: list[Path], harm: Callable[[Path], None], message: str
) -> None:
    paths = write_list(tmp_path)
    harm(tmp_path)
    with pytest.raises(LPNError, match=message) as raised:
        array_task(*files, paths)
    assert "\n" not in str(raised.value)


def test_an_array_is_scaled_in_little_memory(tmp_path: Path) -> None:
    gallery = np.random.default_rng(2).standard_normal((512, 2, 2048)).astype(np.float32)
    files = save(tmp_path, "npy", "query", gallery[:2]), save(tmp_path, "npy", "gallery", gallery)
    array_task(files[0], files[0])
    tracemalloc.start()
    found = array_task(*files)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 2 * gallery.nbytes
    norms = np.linalg.norm(gallery.astype(np.float64), axis=2, keepdims=True) * np.sqrt(2)
    np.testing.assert_array_equal(found.gallery_descriptors, (gallery / norms).astype(np.float32))


def test_labels_are_texts(tmp_path: Path, files: list[Path]) -> None:
    for labels, same, junk in (
        (["7", "007", "7", "8", "", "-1", "-01"], [True, False, True, False, False, False, False], 1),
        (["3", "-01", "3", "-1", "-1", "0", "4"], [True, False, True, False, False, False, False], 2),
        (["-2", "-3", "-2", "-4", "", "-5", "-1"], [True, False, True, False, False, False, False], 1),
        (["0003", "5", "0003", "-1", "", "6", "9"], [True, False, True, False, False, False, False], 1),
    ):
        lines = ["file,side,label", *(f"q/{row},query,{labels[0]}" for row in range(Q))]
        lines += [f"g/{row},gallery,{label}" for row, label in enumerate(labels)]
        (tmp_path / "paths.csv").write_text("\n".join(lines) + "\n")
        found = array_task(*files, tmp_path / "paths.csv")
        assert (found.gallery_labels == found.query_labels[0]).tolist() == same
        assert int((found.gallery_labels == -1).sum()) == junk
    assert found.query_labels.tolist() == [3] * Q


def test_other_files_and_wrong_numbers_of_parts_are_refused(
    tmp_path: Path, arrays: tuple[np.ndarray, np.ndarray], files: list[Path]
) -> None:
    (tmp_path / "query.txt").write_text("1 2")
    with pytest.raises(InputError, match=r"query.npy has 3 parts of 4 numbers .* expected 4 parts"):
        array_task(*files, n_parts=4)
    with pytest.raises(DataError, match=r"query.txt is no array file; expected one that ends in .npy, .npz, .mat"):
        array_task(tmp_path / "query.txt", files[1])
    with pytest.raises(DataError, match=r"no file of gallery descriptors at absent.npy"):
        array_task(files[0], "absent.npy")
    np.savez(tmp_path / "odd.npz", a=arrays[0], b=arrays[1])
    with pytest.raises(DataError, match="holds a, b; expected one array, or query"):
        array_task(tmp_path / "odd.npz", files[1])
    for kind, other in (("npy", "npz"), ("npz", "npy")):
        (tmp_path / f"swapped.{kind}").write_bytes(
            (tmp_path / ("odd.npz" if other == "npz" else "query.npy")).read_bytes()
        )
        with pytest.raises(DataError, match=rf"swapped.{kind} is no a\w+ that NumPy saved, or damaged"):
            array_task(tmp_path / f"swapped.{kind}", files[1])
    savemat(tmp_path / "odd.mat", {"x": arrays[0]})
    with pytest.raises(DataError, match="none of the variables query_f"):
        array_task(tmp_path / "odd.mat", files[1])
