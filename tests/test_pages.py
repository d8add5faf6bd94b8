"""The pages of measured figures are rendered from their data."""

from __future__ import annotations

import dataclasses
import io
import json
import re
import runpy
import shutil
import sys
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass
from pathlib import Path

import msgspec
import numpy as np
import pytest
from safetensors.numpy import save_file

from lpn.reproduce.measure import MeasurementStore
from lpn.reproduce.record import Provenance, TableRecord, row_record
from lpn.training.recipes import RECIPES

ROOT = Path(__file__).parents[1]


@dataclass(frozen=True)
class Done:
    """The exit status and the output of a run."""

    returncode: int
    stdout: str
    stderr: str


def pages(*arguments: str) -> Done:
    """Run `python -m tools.pages` in this process."""
    output, errors = io.StringIO(), io.StringIO()
    with pytest.MonkeyPatch.context() as patch, redirect_stdout(output), redirect_stderr(errors):
        patch.setattr(sys, "argv", ["pages", *arguments])
        with pytest.raises(SystemExit) as ended:
            runpy.run_path(str(ROOT / "tools" / "pages.py"), run_name="__main__")
    assert isinstance(ended.value.code, int)
    return Done(ended.value.code, output.getvalue(), errors.getvalue())


@pytest.fixture
def docs(tmp_path: Path) -> Path:
    shutil.copytree(ROOT / "docs" / "measured", tmp_path / "measured")
    for file in (ROOT / "docs").glob("*.*"):
        if file.suffix in (".md", ".png", ".jpg"):
            shutil.copy(file, tmp_path)
    return tmp_path


def test_pages_are_what_their_data_say() -> None:
    done = pages("--check")
    assert done.returncode == 0, done.stdout + done.stderr


def test_a_figure_that_no_data_file_has_is_found(docs: Path) -> None:
    page = docs / "evaluation.md"
    page.write_text(page.read_text("utf-8").replace("60.00", "61.00", 1), "utf-8")
    template = docs / "measured" / "reproduction.md.j2"
    lines = [
        "| n = 4 | 71 |",
        "LPN gains 19.4 points.",
        "Version `1.2` and table | `n` | of {{ (1 / 2) | figure }} are none.",
    ]
    template.write_text(template.read_text("utf-8") + "\n".join(lines) + "\n", "utf-8")
    done = pages("--check", "--docs", str(docs))
    assert done.returncode == 1
    said = done.stdout.splitlines()
    assert [line.endswith(text) for line, text in zip(said[:2], lines, strict=False)] == [True, True]
    assert said[2:] == [
        f"docs/{page}.md differs from its data in docs/measured; run python -m tools.pages."
        for page in ("reproduction", "evaluation")
    ]


def test_a_run_s_tables_replace_the_page_s(docs: Path, tmp_path: Path) -> None:
    made = Provenance("lpn reproduce figure7", "7.7", "CPU, 1 cores", "2026-11-22")
    rows = tuple(
        row_record(label, {"seed 0": (value, value)}, trained={"seed 0": made}, measured={"seed 0": made})
        for label, value in (("Baseline, n = 1", 41.25), ("LPN, n = 4", 31.5))
    )
    columns = ("drone pictures, % of activation", "satellite tiles, % of activation")
    run = tmp_path / "run"
    run.mkdir()
    world = tmp_path / "world"
    for folder in ("train/satellite/1", "test/query_satellite/2", "test/query_satellite/3", "test/query_drone/2"):
        (world / folder).mkdir(parents=True)
    (world / "test/query_drone/2/a.jpg").touch()
    (world / "world.json").write_text('{"settings": {"seed": 5, "tile_pixels": 99}}')
    (run / "runs" / "lpn-seed0").mkdir(parents=True)
    job = {"identity": {"size": 77, "epochs": 3}, "made": {"command": "lpn reproduce figure7 --epochs 3"}}
    (run / "runs" / "lpn-seed0" / "job.json").write_text(json.dumps(job))
    MeasurementStore(run / "measured.json").keep(TableRecord("figure7", "Figure 7: new", columns, (None, None), rows))
    done = pages("--run", str(run), "--world", str(world), "--docs", str(docs))
    assert done.returncode == 0, done.stderr
    text = (docs / "reproduction.md").read_text("utf-8")
    assert "| Baseline, n = 1 | 41.25 | 41.25 |" in text
    assert "Trained and measured (seed 0) by `lpn reproduce figure7`, lpn 7.7, on CPU, 1 cores, 2026-11-22." in text
    assert (
        "LPN to its surroundings too (Figure 7): **held** (drone pictures, % of activation: Baseline, n = 1 41.2"
        in text
    )
    assert "### Table I:" not in text  # of another run
    assert "short trials" not in text
    assert not (docs / "figure8.webp").exists()
    assert "    lpn world --seed 5 --tile-pixels 99 --out world\n    lpn reproduce figure7 --epochs 3\n" in text
    assert "77 pixels, 3 epochs, one seed of each network" in text
    assert "The world has 1\nplaces to train on and 2 to test on: 1 drone pictures" in text
    assert pages("--check", "--docs", str(docs)).returncode == 0

    # Another run of several seeds stands beside the tables, and stays when they are replaced.
    for options in (("--seeds", str(run)), ("--run", str(run))):
        assert pages(*options, "--world", str(world), "--docs", str(docs)).returncode == 0
        text = (docs / "reproduction.md").read_text("utf-8")
        _, page, seeds = re.split("^# .*rendered world$|^# Several seeds$", text, flags=re.MULTILINE)
        assert "| Baseline, n = 1 | 41.25 | 41.25 |" in page
        assert "| Baseline, n = 1 | 41.25 | 41.25 |" in seeds
        assert "python -m tools.pages --seeds run --world world" in seeds
    (run / "tuning.json").touch()
    done = pages("--seeds", str(run), "--world", str(world), "--docs", str(docs))
    assert done.returncode == 2
    assert "tuning.json says that networks of the run were tuned" in done.stderr


def test_the_ablation_takes_seeds_that_both_methods_have(docs: Path, tmp_path: Path) -> None:
    for name, value in (
        ("lpn-seed0", 40),
        ("lpn-seed1", 50),
        ("lpn-seed2", 99),
        ("instance-seed0", 30),
        ("instance-seed1", 20),
    ):
        folder = tmp_path / "runs" / name
        folder.mkdir(parents=True)
        (folder / "log.csv").touch()
        save_file({"a": np.zeros(1)}, folder / "last.safetensors", metadata={"recipe": '{"epochs": 7}'})
        for task in ("drone-to-satellite", "satellite-to-drone"):
            (folder / f"{task}.json").write_text(json.dumps({"recall@1": value, "ap": value + 1}))
    made = Provenance("lpn reproduce figure7", "7.7", "CPU, 1 cores", "2026-11-22")
    for seed, shares in enumerate(((40.0, 30.0), (50.0, 20.0))):
        rows = tuple(
            row_record(label, {"given": (value, 25.0)}, measured={"given": made})
            for label, value in zip(("LPN, n = 4", "Baseline, n = 1"), shares, strict=True)
        )
        (tmp_path / "runs" / f"figure7-seed{seed}").mkdir()
        MeasurementStore(tmp_path / "runs" / f"figure7-seed{seed}" / "measured.json").keep(
            TableRecord("figure7", "Figure 7: new", ("drone", "satellite"), (None, None), rows)
        )
    done = pages("--ablation", str(tmp_path / "runs"), "--commit", "abc", "--docs", str(docs))
    assert done.returncode == 0, done.stderr
    text = (docs / "evaluation.md").read_text("utf-8")
    assert "| n = 4 (LPN) | 45.00 ± 5.00 | 46.00 ± 5.00 | 45.00 ± 5.00 | 46.00 ± 5.00 | 45.0 ± 5.0 | 25.0 |" in text
    assert "| gain | 20.00 | 20.00 | 20.00 | 20.00 | 20.0 | 0.0 |" in text
    assert "2 seeds each (0, 1)" in text
    assert (
        "surroundings too (Figure 7): **did not hold, but within the interval of the seeds** (drone: Baseline, n = 1 25.0, "
        "LPN, n = 4 45.0; satellite" in text
    )
    assert "Measured (seed 1) by `lpn reproduce figure7`, lpn 7.7, on CPU, 1 cores, 2026-11-22." in text
    assert "--method lpn --infonce 0 --ema 0 --label-smoothing 0 --epochs 7" in text


def test_the_table_of_a_cross_validation_joins_the_page(docs: Path, tmp_path: Path) -> None:
    def figures(mean: float, spread: float | None) -> dict[str, object]:
        one = {"R@1": {"mean": mean, "spread": spread, "runs": [mean]}}
        return {"drone-to-satellite": {"plain": one, "centred": one}}

    trials = {
        "base": {"changes": {}, "figures": figures(60.0, None), "runs": 1, "training seconds of a run": 90.0},
        "rings": {
            "changes": {"mining": "hardest"},
            "figures": figures(61.5, 2.0),
            "runs": 2,
            "training seconds of a run": 66.0,
        },
    }
    differs = {"R@1": {"difference": 1.5, "interval": [-3.0, 6.0]}}
    source = {"command": "lpn crossval --trial base", "version": "7.7", "machine": "CPU, 1 cores", "date": "2026-11-23"}
    split = {"data": "pairs", "places": 320, "folds": 5, "trained folds": 2, "seeds": [0, 1]}
    values = {
        **source, **split, "recipe": {"size": 160, "epochs": 15}, "trials": trials, "against": "base",
        "differences": {"rings": {"drone-to-satellite": {"plain": differs, "centred": differs}}},
    }  # fmt: skip
    (tmp_path / "first-look.json").write_text(json.dumps(values))
    done = pages("--crossval", str(tmp_path / "first-look.json"), "--docs", str(docs))
    assert done.returncode == 0, done.stderr
    text = (docs / "strong.md").read_text("utf-8")
    assert "**first-look**: pairs, 320 training places, 2 of 5 folds, seeds 0, 1" in text
    assert "| base | those of the recipe | 60.0 | 60.0 | 1 | 1.5 |" in text
    beside = "61.5 ± 2.0 (+1.5; -3.0 to +6.0)"
    assert f"| rings | `mining` hardest | {beside} | {beside} | 2 | 1.1 |" in text
    assert "By `lpn crossval --trial base`, lpn 7.7, on CPU, 1 cores, 2026-11-23." in text
    assert pages("--check", "--docs", str(docs)).returncode == 0


def test_networks_that_were_measured_on_the_test_split_join_the_page(docs: Path, tmp_path: Path) -> None:
    recipe = msgspec.to_builtins(dataclasses.replace(RECIPES["small"], metric_per_part=True, epochs=7))
    for seed, value in ((0, 60.0), (2, 64.0)):
        folder = tmp_path / f"alone-seed{seed}"
        folder.mkdir()
        (folder / "log.csv").touch()
        metadata = {"recipe": json.dumps(recipe | {"seed": seed})}
        save_file({"a": np.zeros(1)}, folder / "last.safetensors", metadata=metadata)
        for number, task in enumerate(("drone-to-satellite", "satellite-to-drone")):
            for more, reading in enumerate(("", "-calibrated", "-csls")):
                at = value + 10 * number + 5 * more
                (folder / f"{task}{reading}.json").write_text(json.dumps({"recall@1": at, "ap": at + 1}))
    done = pages("--trained", str(tmp_path), "--commit", "abc", "--docs", str(docs))
    assert done.returncode == 0, done.stderr
    text = (docs / "strong.md").read_text("utf-8")
    for more, reading in enumerate(("plain", "calibrated", "calibrated, CSLS")):
        cells = " | ".join(f"{mean + 5 * more:.1f} ± 2.0" for mean in (62, 63, 72, 73))
        assert f"| alone | {reading} | 2 | {cells} |" in text
    assert "| n4 | calibrated | 3 |" in text
    assert (
        "--recipe small --init city-lpn --epochs 7 --metric-per-part --seed 2`, and the other seeds alike (0, 2)"
        in text
    )
    assert pages("--check", "--docs", str(docs)).returncode == 0


def test_every_set_of_figures_names_its_source() -> None:
    def made(value: dict[str, object]) -> bool:
        return {"command", "version", "machine", "date"} <= set(value)

    data = json.loads((ROOT / "docs" / "measured" / "reproduction.json").read_bytes())
    for table in data["tables"].values():
        rows = [row for row in table["rows"] if row.get("mean")]
        assert rows
        assert all(row["measured"] and all(map(made, row["measured"].values())) for row in rows)
    trials = json.loads((ROOT / "docs" / "measured" / "strong.json").read_bytes())["crossval"]
    assert trials
    assert all(map(made, trials.values()))
    for page in ("evaluation", "recipes"):
        for name, figures in json.loads((ROOT / "docs" / "measured" / f"{page}.json").read_bytes()).items():
            if name in ("format", "paper") or not figures.get("runs", True):
                continue
            assert {"command", "seed", "commit", "machine", "date"} <= set(figures["source"]), name
