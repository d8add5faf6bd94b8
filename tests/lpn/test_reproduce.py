from __future__ import annotations

import csv
import io
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console

from lpn.errors import InputError
from lpn.recipes import METHODS
from lpn.reproduce import paper, report
from lpn.reproduce.command import KEYS, Reproduction
from lpn.reproduce.tables import SCALES, find, tables
from tests import worlds

QUICK = {"size": 64, "epochs": 1, "batch": 4, "precision": "float32"}


@pytest.fixture(scope="module")
def places(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return worlds.make_dataset(tmp_path_factory.mktemp("reproduce") / "places", train=4, test=6)


def reproduction(places: Path, out: Path, **options: Any) -> Reproduction:
    values: dict[str, Any] = {
        "data": [str(places)],
        "out": out,
        "models": {},
        "init": None,
        "seeds": (0,),
        "scale": SCALES["reduced"],
        "changes": QUICK,
        "console": Console(file=io.StringIO(), width=200),
    }
    return Reproduction(**{**values, **options})


def said(made: Reproduction) -> str:
    assert isinstance(made.console.file, io.StringIO)
    return made.console.file.getvalue()


def test_every_row_names_a_method_and_carries_the_paper_s_values() -> None:
    for scale in SCALES.values():
        for table in tables(scale).values():
            for row in table.rows:
                assert row.training is None or row.training.method in METHODS
                assert len(row.paper) in (0, len(table.columns))
                if row.training:
                    scale.recipe(row.training, 0, {})
            labels = {row.label for row in table.rows}
            for claim in paper.CLAIMS.get(table.key, ()):
                assert {claim.better, *claim.worse} <= labels
    assert {f"table{i}" for i in range(1, 7)} | {"figure5", "figure7", "figure8"} == set(KEYS)


def test_at_the_paper_s_scale_the_recipes_are_the_paper_s() -> None:
    scale = SCALES["paper"]
    recipes = {
        training.name: scale.recipe(training, 0, {}) for table in tables(scale).values() for training in table.trainings
    }
    assert (recipes["lpn"].backbone, recipes["lpn"].n_parts, recipes["lpn"].google) == ("resnet50", 4, True)
    assert not recipes["lpn-without-google"].google
    assert (recipes["lpn-512-pixels"].size, recipes["lpn-8-parts"].n_parts) == (512, 8)
    assert (recipes["panorama-lpn"].backbone, recipes["panorama-lpn"].n_parts) == ("vgg16_bn", 8)
    assert (recipes["panorama-safa-lpn"].pooling, recipes["panorama-safa-lpn"].optimizer) == ("safa", "adam")
    assert recipes["panorama-safa-lpn"].input_size == (112, 616)


def test_a_table_is_trained_measured_and_written_and_not_trained_again(places: Path, tmp_path: Path) -> None:
    made = reproduction(places, tmp_path, seeds=(0, 1))
    files = made.run(["table4", "table5", "figure8"])
    assert [file.name for file in files] == [
        "table4.md", "table4.csv", "table4.png", "table5.md", "table5.csv", "table5.png", "figure8.png",
    ]  # fmt: skip
    text = (tmp_path / "table4.md").read_text()
    assert "| 75.93 |" in text
    assert "Mean of 2 seeds" in text
    assert "Protocol: descriptors of picture and mirror added" in text
    assert "epochs = 1" in text
    with (tmp_path / "table4.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 5 * 4
    assert all(0 <= float(row["seed 1"]) <= 100 for row in rows)
    assert (tmp_path / "table4.png").read_bytes()[:4] == b"\x89PNG"
    assert "2 of 2 trainings; about 1 min left" in said(made)
    # The rotation of 0 degrees and all parts are the same measurement.
    by_angle = text.split("| 0 |")[1].split("\n")[0]
    assert by_angle == (tmp_path / "table5.md").read_text().split("| 1+2+3+4 |")[1].split("\n")[0]

    again = reproduction(places, tmp_path, seeds=(0, 1))
    again.run(["table4"])
    assert "Epoch" not in said(again)
    assert (tmp_path / "table4.md").read_text() == text
    with pytest.raises(InputError, match="another epochs"):
        reproduction(places, tmp_path, changes={**QUICK, "epochs": 2}).run(["table4"])


def test_given_models_stand_for_trainings(places: Path, tmp_path: Path) -> None:
    model = worlds.make_model(tmp_path)
    made = reproduction(places, tmp_path / "out", models={"": model}, train=False)
    made.run(["table1", "table4"])
    text = (tmp_path / "out" / "table1.md").read_text()
    assert text.count("| not run |") == 6 * 4
    assert "not known; " in text
    assert "Models given: model.onnx" in text
    assert not (tmp_path / "out" / "runs").exists()
    with pytest.raises(InputError, match="--model names 'nobody'"):
        reproduction(places, tmp_path / "out", models={"nobody": model}).run(["table1"])
    with pytest.raises(InputError, match="figure7 needs the network instance"):
        reproduction(places, tmp_path / "out", models={"": model}, train=False).run(["figure7"])
    reproduction(places, tmp_path / "out", models={"": model, "instance": model}, train=False).run(["figure7"])
    assert (tmp_path / "out" / "figure7.png").is_file()


def test_what_cannot_be_made_is_said_before_anything_is_trained(places: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"Table II.* needs panoramas"):
        reproduction(places, tmp_path).run(["table1", "table2"])
    with pytest.raises(InputError, match="needs landmarks"):
        reproduction(places, tmp_path).run(["table6"])
    with pytest.raises(InputError, match="There is no 'table9'"):
        reproduction(places, tmp_path).run(["table9"])
    assert not (tmp_path / "runs").exists()


def test_claims_are_judged_by_the_figures_and_the_seeds_spread() -> None:
    table = find("table1", SCALES["paper"])

    def verdict(lpn: list[float], baseline: list[float]) -> str:
        measured = {
            row.label: [(value,) * 4 for value in (lpn if row.label == "LPN without google" else baseline)]
            for row in table.rows
        }
        return report.verdicts(table, measured, table.columns)[0]

    assert "**held** (drone → satellite R@1 70.0 against Instance loss (baseline) 50.0)" in verdict([70], [50])
    assert "**did not hold**" in verdict([50], [50])
    assert "within the spread" in verdict([49, 55], [47, 53])
