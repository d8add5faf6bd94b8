from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.io import savemat

import lpn
from lpn.cli import main
from lpn.core.errors import DataError, InputError, LPNError
from lpn.datasets import open_dataset
from lpn.descriptors.transforms import Change
from lpn.retrieval.saved import load_saved
from lpn.tasks.changes import averaged, centred, changed, with_parts
from lpn.tasks.measure import measure
from lpn.tasks.opening import lazy_task
from lpn.tasks.saved import saved_task
from lpn.tasks.task import Task
from tools.fixtures import seeded, small_worlds
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


def test_a_saved_result_gives_the_figures_of_its_model(data: Path, model_file: Path, tmp_path: Path) -> None:
    savemat(tmp_path / "pytorch_result.mat", contents(data, model_file))
    model, dataset = lpn.load(model_file), open_dataset(data)
    steps: list[tuple[int, Callable[[Task], Task]]] = [
        (1, lambda task: task),
        (4, lambda task: with_parts(task, (1, 3))),
        (4, averaged),
        (4, centred),
    ]
    for n, step in steps:
        saved = load_saved(tmp_path / "pytorch_result.mat", n)
        found = measure(step(saved_task(saved)))
        expected = measure(step(lazy_task(model, dataset, "drone-to-satellite")))
        assert (found.recall, found.task, found.queries) == (expected.recall, "drone-to-satellite", 14)
        assert found.ap == pytest.approx(expected.ap, abs=1e-9)
        assert "descriptors as saved" in found.sentence


def test_the_command_reads_it_without_model_and_data(data: Path, model_file: Path, tmp_path: Path) -> None:
    savemat(tmp_path / "r.mat", contents(data, model_file))
    figures = []
    for arguments in (
        [str(tmp_path / "r.mat"), "--n-parts", "4", "--parts", "2"],
        [str(data), "--model", str(model_file), "--parts", "2"],
    ):
        assert main.main(["evaluate", *arguments, "--json", str(tmp_path / "f.json")]) == 0
        figures.append(json.loads((tmp_path / "f.json").read_text()))
    one, other = ({k: v for k, v in f.items() if k not in ("seconds", "protocol", "ap")} for f in figures)
    assert one == other
    assert figures[0]["ap"] == pytest.approx(figures[1]["ap"], abs=1e-9)


def test_a_saved_result_is_centred_part_by_part_only(
    data: Path, model_file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    savemat(tmp_path / "r.mat", contents(data, model_file))
    arguments = ["evaluate", str(tmp_path / "r.mat"), "--centre"]
    assert main.main(arguments) == 2
    assert "--n-parts" in capsys.readouterr().err
    assert main.main([*arguments, "--n-parts", "4"]) == 0


def test_its_pictures_are_found_by_path_or_by_label(data: Path, model_file: Path, tmp_path: Path) -> None:
    values, dataset = contents(data, model_file), open_dataset(data)
    savemat(tmp_path / "r.mat", values)
    views, queries, gallery = load_saved(tmp_path / "r.mat").pictures(dataset)
    assert views == VIEWS
    assert queries == dataset.queries("drone")
    assert gallery == dataset.gallery("satellite")[::-1]
    for key in ("gallery_f", "gallery_label"):
        values[key] = values[key][::-1]
    savemat(tmp_path / "r.mat", {key: value for key, value in values.items() if "path" not in key})
    saved = load_saved(tmp_path / "r.mat")
    assert saved.task == "saved"
    assert saved.pictures(dataset)[2] == dataset.gallery("satellite")
    values["gallery_label"] = np.where(
        np.isin(values["gallery_label"], values["query_label"]), values["gallery_label"], -1
    )
    savemat(tmp_path / "r.mat", {key: value for key, value in values.items() if "path" not in key})
    assert load_saved(tmp_path / "r.mat").pictures(dataset)[2] == dataset.gallery("satellite")
    values["query_label"] = np.array(values["query_label"]) + 1
    savemat(tmp_path / "r.mat", {key: value for key, value in values.items() if "path" not in key})
    with pytest.raises(DataError, match="in the order of their labels"):
        load_saved(tmp_path / "r.mat").pictures(dataset)


def test_pictures_of_another_data_set_are_not_taken(data: Path, model_file: Path, tmp_path: Path) -> None:
    savemat(tmp_path / "r.mat", contents(data, model_file))
    other = small_worlds.make_dataset(tmp_path / "other", train=1, test=3)
    with pytest.raises(DataError, match="/home/someone/test/query_drone/0007"):
        load_saved(tmp_path / "r.mat").pictures(open_dataset(other))


def test_what_needs_pictures_is_refused(data: Path, model_file: Path, tmp_path: Path) -> None:
    savemat(tmp_path / "r.mat", contents(data, model_file))
    with pytest.raises(InputError, match="descriptors without their network"):
        changed(saved_task(load_saved(tmp_path / "r.mat")), Change(shift=3))


def test_without_pictures_nothing_is_named_or_paired(
    data: Path, model_file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    values = contents(data, model_file)
    for name in ("r.mat", "s.mat"):
        savemat(tmp_path / name, {key: value for key, value in values.items() if "path" not in key})
    files = [str(tmp_path / name) for name in ("r.mat", "s.mat")]
    for words in (["compare", *files], ["evaluate", files[0], "--per-query", str(tmp_path / "q.csv")]):
        assert main.main(words) == 2
        assert (
            "r.mat holds no pictures; give the data set that it was computed on as --data." in capsys.readouterr().err
        )
    task = saved_task(load_saved(tmp_path / "r.mat"))
    steps: list[Callable[[], object]] = [lambda: task.table, lambda: measure(task, 3), measure(task).ranked]
    for step in steps:
        with pytest.raises(InputError, match=r"r\.mat holds no pictures; give the data set"):
            step()
    assert "14 queries" in task._repr_html_()


def test_csls_and_the_title_need_no_pictures(
    data: Path, model_file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    savemat(tmp_path / "r.mat", contents(data, model_file))
    assert main.main(["evaluate", str(tmp_path / "r.mat"), "--csls", "3", "--json", str(tmp_path / "f.json")]) == 0
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


def test_damaged_files_get_a_sentence(tmp_path: Path) -> None:
    savemat(tmp_path / "r.mat", small(), do_compression=True)
    whole = (tmp_path / "r.mat").read_bytes()
    rng = np.random.default_rng(0)
    damaged = [b"", b"\0" * 10, b"MATLAB 7.3 MAT-file" + b" " * 105 + b"\0\2IM" + b"\0" * 99, whole[: len(whole) // 2]]
    for _ in range(8):
        flipped = np.frombuffer(whole, np.uint8).copy()
        flipped[rng.integers(128, len(whole), 8)] ^= 0xFF
        damaged.append(flipped.tobytes())
    said = []
    for data in damaged:
        (tmp_path / "r.mat").write_bytes(data)
        try:
            load_saved(tmp_path / "r.mat")
        except LPNError as error:
            said.append(str(error))
    assert len(said) > 7
    assert all("r.mat" in sentence for sentence in said)


def test_labels_that_fit_nothing_are_no_result_of_zero_percent(tmp_path: Path) -> None:
    savemat(tmp_path / "r.mat", small() | {"query_label": np.arange(3) + 1000})
    with pytest.raises(
        DataError, match=r"None of the query labels of r\.mat, such as 1000, is a gallery label, such as 0"
    ):
        saved_task(load_saved(tmp_path / "r.mat"))
