"""The page about several models, against the figures of each one."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path

import pytest

import lpn
from lpn.analysis.leaderboard import Leaderboard, ModelFacts, leaderboard
from lpn.cli.main import main
from lpn.core.text_tables import latex_page, markdown_page
from lpn.descriptors.transforms import Change
from lpn.descriptors.weather import WEATHERS
from lpn.report import table_page
from lpn.sources import SourceOptions, open_source
from tests.conftest import Refused
from tools.fixtures import small_worlds

TASK = "drone-to-satellite"


@pytest.fixture(scope="module")
def page(model_file: Path, one_part_model_file: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[str, dict]:
    folder = tmp_path_factory.mktemp("leaderboard")
    data = small_worlds.make_dataset(folder / "places", train=1, test=4)
    files = [str(folder / name) for name in ("page.md", "page.json")]
    models = [str(model_file), str(one_part_model_file)]
    options = ["--turns", "90", "--weathers", "--resamples", "20", "--page", files[0], "--json", files[1]]
    assert main(["compare", str(data), "--model", *models, *options]) == 0
    return Path(files[0]).read_text("utf-8"), json.loads(Path(files[1]).read_text("utf-8"))


@pytest.mark.slow
def test_a_page_is_ranked_as_its_options_say(model_file: Path, one_part_model_file: Path, tmp_path: Path) -> None:
    data = small_worlds.make_dataset(tmp_path / "places", train=1, test=24)
    out, files = tmp_path / "page.json", [str(model_file), str(one_part_model_file)]
    options = ["--calibrate", "--csls", "3", "--turns", "90", "--resamples", "20"]
    pages = ["--page", str(tmp_path / "page.md"), "--json", str(out)]
    assert main(["compare", str(data), "--model", *files, *options, *pages]) == 0
    values = json.loads(out.read_text("utf-8"))
    stem = model_file.name.removesuffix(".onnx")
    name = next(one for one in values["models"] if stem in one)
    assert all(one.endswith(", calibrated, CSLS") for one in values["models"])
    for figures, changes in (
        (values["parts"][TASK][name]["all"], {}),
        (values["parts"][TASK][name]["2"], {"parts": (2,)}),
        (values["turns"][TASK][name]["90.0"], {"change": Change(rotate=90.0)}),
    ):
        alone = lpn.evaluate(model_file, data, TASK, **changes, calibrate=True, csls=3)
        assert figures == [alone.recall["1"], alone.ap]
    assert values["models"][name]["megabytes"] == model_file.stat().st_size / 1e6
    table = next(one for one in values["tables"] if one["task"] == TASK)
    assert [row["R@1"]["value"] for row in table["models"] if row["name"] == name] == pytest.approx(
        [lpn.evaluate(model_file, data, TASK, calibrate=True, csls=3).recall["1"]]
    )


def test_a_page_of_one_opened_task_has_the_figures_of_the_data_set(model_file: Path, data: Path) -> None:
    model, dataset = lpn.load(model_file), lpn.open_dataset(data)
    task = open_source(SourceOptions(source=str(data), model=model_file)).task
    tasks = {"a": task, "b": replace(task, weights=(1, 0, 0, 0))}
    models = dict.fromkeys(tasks, model)
    board = leaderboard("data", models, {}, [TASK], lambda name, _: tasks[name], resamples=20, groups=("LPN", "LPN"))
    assert board.tables[0].groups == {"LPN": [0, 1]}
    for part, parts in (("all", None), ("2", (2,))):
        result = lpn.evaluate(model, dataset, TASK, parts=parts)
        assert board.parts[TASK]["a"][part] == pytest.approx((result.recall["1"], result.ap))
    assert board.parts[TASK]["a"]["all"] != board.parts[TASK]["a"]["2"]
    assert board.parts[TASK]["a"] == board.parts[TASK]["b"]


def test_the_page_has_a_table_for_each_measure_and_no_parts_of_a_model_with_one(page: tuple[str, dict]) -> None:
    text, values = page
    parts = text.split(f"## Each part alone: {TASK}")[1].split("## ")[0]
    assert parts.count("\n| ") == 3  # head, rule, and one model
    ((name, figures),) = values["parts"][TASK].items()
    assert values["weathers"][name]["weathers"]["normal"][TASK]["ap"] == figures["all"][1]
    assert values["models"][name]["milliseconds"] > 0
    assert f"## Turned queries, degrees: {TASK}" in text
    weathers = text.split(f"## Weathers: {TASK}")[1].split("## ")[0]
    assert [name for name in (*WEATHERS, "mean") if f"| {name} " not in weathers] == []


def test_a_page_of_html_has_the_tables_of_the_markdown_and_escapes_names() -> None:
    facts = ModelFacts("LPN", "exact", (64, 64), 8, None, 1.0, 1.0)
    turns = {TASK: {"<b>.onnx": {90.0: (50.0, 62.5)}}}
    board = Leaderboard("a|b", {"<b>.onnx": facts}, [], {}, turns, {})
    page = table_page(board.title, board.printed).decode()
    assert page.count('<th scope="row">&lt;b&gt;.onnx</th>') == 2
    assert '<td class="r">50.00 / 62.50</td>' in page
    assert "| &lt;b&gt;.onnx | 50.00 / 62.50 |" in markdown_page(board.printed, board.title)
    assert not re.search(r"<script|https?:|<b>", page)
    _, _, latex = latex_page(board.printed).partition("Turned queries")
    assert r"\textless{}b\textgreater{}.onnx & 50.00 / 62.50 \\" in latex


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--turns", "90"], "belong to a page"),
        (["--page", "{}/page.md", "--task", "drone-to-satellite"], "all tasks and galleries"),
        (["--page", "{}/page.md"], "takes two models or more; found 1."),
        (["--page", "{}/page.md", "--table", "{}/table.csv"], "leave one of them out"),
    ],
)
def test_options_that_do_not_go_together_are_refused(
    options: list[str], message: str, model_file: Path, data: Path, tmp_path: Path, refused: Refused
) -> None:
    given = [option.format(tmp_path) for option in options]
    assert message in refused("compare", data, "--model", model_file, *given)
    assert not list(tmp_path.iterdir())
