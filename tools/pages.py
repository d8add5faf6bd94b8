"""The pages with measured figures, rendered from their data: `python -m tools.pages [--run RUN --world WORLD] [--check]`.

`docs/measured/<page>.md.j2` is the page's text, and `docs/measured/<page>.json` holds its figures, each with its command, seed,
version, machine, and date. Those of docs/shipped.md are in the cards of the models that ship. The tables of docs/recipes.md come
from `lpn.training.recipe_sources`. With `--run` and `--world`, the tables and drawings of a run of `lpn reproduce`, and the
counts of the world that it ran on, replace the page's own first. With `--seeds` and `--world`, the tables of a run of several
seeds stand beside them. With `--crossval`, the table of an `lpn crossval` joins those
of docs/strong.md. With `--check`, nothing is written: a page that differs from its data, and a figure in the text alone, end
with status 1.
"""

from __future__ import annotations

import argparse
import json
import re
import statistics
import sys
import time
from pathlib import Path
from typing import Any, cast

import cv2
import msgspec
from jinja2 import Environment, FileSystemLoader, StrictUndefined
from safetensors import safe_open

from lpn.core.arrays import UInt8Array
from lpn.core.files import write_atomic, write_json
from lpn.datasets.rendered import PLAN
from lpn.models.shipped import model_cards
from lpn.reproduce import claims, report
from lpn.reproduce.measure import read_measurements
from lpn.reproduce.paper_values import largest_drop
from lpn.reproduce.record import Provenance, TableRecord, machine, row_record
from lpn.training import recipe_sources, recipes

PAGES = ("reproduction", "evaluation", "recipes", "shipped", "strong")
FORMAT = "lpn-page/1"

# Drawings of a run, and the pictures of the page.
_DRAWINGS = {
    "figure1": "figure1.webp",
    "figure5": "figure5.png",
    "figure7a": "figure7.webp",
    "figure7b": "figure7b.webp",
    "figure8": "figure8.webp",
    "figure8-panoramas": "figure8-panoramas.webp",
}
_SOURCE = "<!-- Rendered from docs/measured by python -m tools.pages; edit the template and the data there. -->\n"


def render(page: str, docs: Path) -> str:
    """Return the text of a page."""
    file = docs / "measured" / f"{page}.json"
    data = json.loads(file.read_bytes()) if file.is_file() else {}
    environment = Environment(
        loader=FileSystemLoader(docs / "measured"), undefined=StrictUndefined, keep_trailing_newline=True, trim_blocks=True,
        lstrip_blocks=True,
    )  # fmt: skip
    environment.filters |= {
        "figure": _figure,
        "mean": _mean,
        "mean_of": statistics.fmean,
        "cells": _cells,
        "verdicts": _verdicts,
        "origins": _origins,
        "trials": _trials,
    }
    records = {key: _record(value) for key, value in data.pop("tables", {}).items()}
    seeded = {key: _record(value) for key, value in data.get("seeds", {}).get("tables", {}).items()}
    drawings = [picture for picture in _DRAWINGS.values() if (docs / picture).is_file()]
    environment.globals |= {"recipe_table": recipe_sources.table, "source": recipe_sources.source, "find": recipes.find}
    text = environment.get_template(f"{page}.md.j2").render(
        **data,
        tables=records,
        table=lambda key: table(records[key]),
        seeded_table=lambda key: table(seeded[key]),
        cards=model_cards(),
        drawings=drawings,
        limits=[largest_drop(column) for column in range(4)],
    )
    return text.rstrip("\n") + "\n\n" + _SOURCE


def table(record: TableRecord) -> str:
    """Format a measured table as `lpn reproduce` writes it, and where its figures come from."""
    return report.markdown(record).rstrip("\n") + "\n\n" + "".join(f"{line}  \n" for line in origins(record))


def origins(record: TableRecord) -> list[str]:
    """Say where the figures of a table come from, each place once."""
    places: dict[tuple[Provenance, str], dict[str, None]] = {}
    for row in record.rows:
        for verb, found in (("trained", row.trained), ("measured", row.measured)):
            for network, made in found.items():
                places.setdefault((made, "" if network == "given" else f" ({network})"), {})[verb] = None
    return [
        f"{' and '.join(verbs).capitalize()}{seed} by `{made.command}`, lpn {made.version}, on {made.machine}, {made.date}."
        for (made, seed), verbs in places.items()
    ]


def copy_run(run: Path, world: Path, docs: Path) -> None:
    """Replace the page's data and drawings by those of a finished run of `lpn reproduce` on a rendered world."""
    target = docs / "measured" / "reproduction.json"
    before = json.loads(target.read_bytes()) if target.is_file() else {}
    tuning = run / "tuning.json"
    data = {
        "format": FORMAT,
        **_measured(run, world, "run"),
        "tuning": json.loads(tuning.read_bytes()) if tuning.is_file() else None,
    }
    write_json(target, data | {key: before[key] for key in ("seeds",) if key in before}, ensure_ascii=False)
    for name, picture in _DRAWINGS.items():
        if (drawn := run / f"{name}.png").is_file():
            cv2.imwrite(str(docs / picture), cast(UInt8Array, cv2.imread(str(drawn))), [cv2.IMWRITE_WEBP_QUALITY, 60])
        else:
            (docs / picture).unlink(missing_ok=True)


def copy_seeds(run: Path, world: Path, docs: Path) -> None:
    """Put the tables of a run of several seeds beside the page's own, which stay."""
    target = docs / "measured" / "reproduction.json"
    data = json.loads(target.read_bytes())
    write_json(target, data | {"seeds": _measured(run, world, "seeds")}, ensure_ascii=False)


def _measured(run: Path, world: Path, option: str) -> dict[str, Any]:
    """Return the tables of a run on a rendered world, and the world's commands and counts."""
    tables = json.loads(msgspec.json.encode(read_measurements(run / "measured.json").tables))
    jobs = [json.loads(file.read_bytes()) for file in sorted((run / "runs").glob("lpn-seed*/job.json"))]
    settings = json.loads((world / PLAN).read_bytes())["settings"]
    flags = " ".join(_flag(name, value) for name, value in settings.items() if value != [])
    return {
        "tables": dict(sorted(tables.items(), key=lambda item: (item[0].startswith("figure"), item[0]))),
        "world": {
            "commands": [
                f"lpn world {flags} --out {world.name}",
                jobs[0]["made"]["command"],
                f"python -m tools.pages --{option} {run.name} --world {world.name}",
            ],
            "train": len(list((world / "train/satellite").iterdir())),
            "test": len(list((world / "test/query_satellite").iterdir())),
            "drone": len(list((world / "test/query_drone").glob("*/*"))),
            "size": jobs[0]["identity"]["size"],
            "epochs": jobs[0]["identity"]["epochs"],
            "seeds": len(jobs),
        },
    }


def copy_ablation(runs: Path, commit: str, docs: Path) -> None:
    """Take the runs of the ablation over into the page's data: the folders `<method>-seed<k>` that have both tasks' JSON files.

    Only seeds that both methods have are taken. `figure7-seed<k>` is the folder of `lpn reproduce figure7` on a seed's networks.
    """
    of_seed: dict[int, dict[str, list[float]]] = {}
    for folder in sorted(runs.glob("*-seed*")):
        method, _, seed = folder.name.partition("-seed")
        tasks = [folder / f"{task}.json" for task in ("drone-to-satellite", "satellite-to-drone")]
        if all(file.is_file() for file in tasks):
            found = [json.loads(file.read_bytes()) for file in tasks]
            values = [task[key] for task in found for key in ("recall@1", "ap")]
            of_seed.setdefault(int(seed), {})[method] = values
    seeds = sorted(seed for seed, methods in of_seed.items() if len(methods) == 2)
    centre = _centre(runs, seeds)
    for label, method in (("LPN, n = 4", "lpn"), ("Baseline, n = 1", "instance")):
        row = centre.row(label)
        assert row is not None
        for number in seeds:
            of_seed[number][method] += row.values[f"seed {number}"]
    with safe_open(runs / f"lpn-seed{seeds[0]}" / "last.safetensors", "np") as file:
        recipe = json.loads(file.metadata()["recipe"])
    path = docs / "measured" / "evaluation.json"
    data = json.loads(path.read_bytes())
    command = (
        "lpn train --data university1652-mini --out runs/lpn-seed0 --recipe small --method lpn --infonce 0 --ema 0 "
        f"--label-smoothing 0 --epochs {recipe['epochs']} --seed 0 --init resnet18_imagenet_to_layer3.safetensors"
    )
    data["ablation"] = {
        "source": {
            "command": [
                command,
                command.replace("lpn-seed0", "instance-seed0").replace("method lpn", "method instance"),
            ],
            "seed": seeds,
            "commit": commit,
            "machine": machine(),
            "date": time.strftime("%Y-%m-%d", time.gmtime((runs / f"lpn-seed{seeds[-1]}" / "log.csv").stat().st_mtime)),
            "epochs": recipe["epochs"],
        },
        "seeds": seeds,
        "runs": {
            method: [list(column) for column in zip(*(of_seed[seed][method] for seed in seeds), strict=True)]
            for method in ("lpn", "instance")
        },
        "figure7": json.loads(msgspec.json.encode(centre)),
    }
    write_json(path, data, ensure_ascii=False)


def copy_crossval(file: Path, docs: Path) -> None:
    """Put the table of an `lpn crossval` among those of docs/strong.md, under the name of its file."""
    target = docs / "measured" / "strong.json"
    data: dict[str, Any] = json.loads(target.read_bytes()) if target.is_file() else {"format": FORMAT}
    data["crossval"] = {**data.get("crossval", {}), file.stem: json.loads(file.read_bytes())}
    write_json(target, data)


def copy_trained(runs: Path, commit: str, docs: Path) -> None:
    """Take networks that were measured on the test split over into the data of docs/strong.md.

    Each is a folder `<name>-seed<k>` of `lpn train --recipe small --init city-lpn` with the files `<task>.json`,
    `<task>-calibrated.json`, and `<task>-csls.json` of `lpn evaluate`. Networks of other names stay.
    """
    tasks = ("drone-to-satellite", "satellite-to-drone")
    readings = {"plain": "", "calibrated": "-calibrated", "calibrated, CSLS": "-csls"}
    trained: dict[str, Any] = {}
    for folder in sorted(runs.glob("*-seed*")):
        name, _, seed = folder.name.partition("-seed")
        with safe_open(folder / "last.safetensors", "np") as file:
            recipe = json.loads(file.metadata()["recipe"])
        changed = msgspec.to_builtins(recipes.RECIPES["small"]).items() - recipe.items()
        flags = [_flag(key, recipe[key]) for key, _ in sorted(changed) if key != "seed"]
        network = trained.setdefault(
            name, {"seeds": [], "figures": {title: [[] for _ in range(4)] for title in readings}}
        )
        start = f"lpn train --data university1652-mini --out runs/{folder.name} --recipe small --init city-lpn"
        network |= {
            "command": " ".join([start, *flags, f"--seed {seed}"]),
            "commit": commit,
            "machine": machine(),
            "date": time.strftime("%Y-%m-%d", time.gmtime((folder / "log.csv").stat().st_mtime)),
        }
        network["seeds"].append(int(seed))
        for title, ending in readings.items():
            files = [json.loads((folder / f"{task}{ending}.json").read_bytes()) for task in tasks]
            values = [file[key] for file in files for key in ("recall@1", "ap")]
            for column, value in zip(network["figures"][title], values, strict=True):
                column.append(value)
    target = docs / "measured" / "strong.json"
    data = json.loads(target.read_bytes())
    write_json(target, data | {"trained": data.get("trained", {}) | trained})


def _flag(name: str, value: object) -> str:
    flag = name.replace("_", "-")
    return f"--{flag}" if value is True else f"--no-{flag}" if value is False else f"--{flag} {value}"


def _centre(runs: Path, seeds: list[int]) -> TableRecord:
    """Join the tables of Figure 7 that were measured on the networks of each seed alone."""
    tables = {
        f"seed {seed}": read_measurements(runs / f"figure7-seed{seed}" / "measured.json").tables["figure7"]
        for seed in seeds
    }
    first = next(iter(tables.values()))
    rows = []
    for index, row in enumerate(first.rows):
        of_seed = {seed: table.rows[index] for seed, table in tables.items()}
        values = {seed: each.mean for seed, each in of_seed.items()}
        made = {seed: next(iter(each.measured.values())) for seed, each in of_seed.items()}
        rows.append(row_record(row.label, values, measured=made))
    return TableRecord("figure7", first.title, first.columns, first.beside, tuple(rows), first.notes)


def stray_figures(template: str) -> list[str]:
    """Return lines of a template with a figure of its own: a decimal number outside of code, or a number in a table."""
    text = re.sub(r"\{\{.*?\}\}|\{%.*?%\}|\{#.*?#\}", "", template, flags=re.DOTALL)
    text = re.sub(r"^    .*$", "", text, flags=re.MULTILINE)
    text = re.sub(r"`[^`\n]*`", "", text)
    wrong = []
    for line in text.splitlines():
        cells = line.split("|")[2:-1] if line.startswith("|") else []
        numbers = any(re.fullmatch(r"[\s*]*[-+]?\d[\d.,]*[\s*%]*", cell) for cell in cells)
        if numbers or re.search(r"(?<![\d.])\d+\.\d(?!\.)", line):
            wrong.append(line)
    return wrong


def _record(value: Any) -> TableRecord:
    # JSON knows no keys but strings, which msgspec reads back.
    return msgspec.json.decode(msgspec.json.encode(value), type=TableRecord)


def _verdicts(value: Any) -> str:
    """Judge the claims on a table's record."""
    return " ".join(claims.verdicts(_record(value)))


def _origins(value: Any) -> str:
    return " ".join(origins(_record(value)))


def _trials(value: Any) -> str:
    """Return the Markdown table of a cross-validation: R@1 of each trial, and its difference from the first trial."""
    tasks = list(dict.fromkeys(task for trial in value["trials"].values() for task in trial["figures"]))
    read = [trial["figures"][tasks[0]] for trial in value["trials"].values() if trial["figures"]]
    common = [reading for reading in read[0] if all(reading in one for one in read)]
    columns = [(task, reading) for task in tasks for reading in common]
    titles = [f"{task}, {reading}" for task, reading in columns]
    rows = [f"| trial | settings | {' | '.join(titles)} | runs | minutes a run |", "|---" * (len(columns) + 4) + "|"]
    for name, trial in value["trials"].items():
        cells = []
        for task, reading in columns:
            if not trial["figures"]:
                cells.append("")
                continue
            one = trial["figures"][task][reading]["R@1"]
            spread = "" if one["spread"] is None else f" ± {_figure(one['spread'])}"
            differs = value["differences"].get(name, {}).get(task, {}).get(reading, {}).get("R@1")
            low, high = differs["interval"] if differs else (0.0, 0.0)
            beside = f" ({differs['difference']:+.1f}; {low:+.1f} to {high:+.1f})" if differs else ""
            cells.append(f"{_figure(one['mean'])}{spread}{beside}")
        settings = ", ".join(f"`{key}` {changed}" for key, changed in trial["changes"].items()) or "those of the recipe"
        # A trial whose runs all diverged has neither figures nor a time.
        minutes = _figure(trial["training seconds of a run"] / 60) if trial["runs"] else ""
        rows.append(f"| {name} | {settings} | {' | '.join(cells)} | {trial['runs']} | {minutes} |")
    return "\n".join(rows)


def _figure(value: Any, digits: int = 1) -> str:
    """Format a number, or numbers with commas between them."""
    if isinstance(value, list):
        return ", ".join(_figure(single, digits) for single in value)
    return f"{value:.{digits}f}"


def _cells(values: list[float], digits: int = 1) -> str:
    """Format numbers as the cells of a table's row."""
    return " | ".join(_figure(value, digits) for value in values)


def _mean(values: list[float], digits: int = 1) -> str:
    """Format the mean of seeds, with half of the distance between the lowest and the highest if they differ."""
    if len(set(values)) == 1:
        return _figure(values[0], digits)
    return f"{sum(values) / len(values):.{digits}f} ± {(max(values) - min(values)) / 2:.{digits}f}"


def errors(page: str, docs: Path) -> list[str]:
    """Return what keeps a page from being its data: a difference, or figures in the text alone."""
    stray = stray_figures((docs / "measured" / f"{page}.md.j2").read_text(encoding="utf-8"))
    found = [f"docs/measured/{page}.md.j2 has a figure of its own; move it into {page}.json: {line}" for line in stray]
    if (docs / f"{page}.md").read_text(encoding="utf-8") != render(page, docs):
        found.append(f"docs/{page}.md differs from its data in docs/measured; run python -m tools.pages.")
    return found


def main() -> int:
    """Render the pages, after taking over a run, or check them."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--run", type=Path, help="folder of a finished lpn reproduce")
    parser.add_argument("--seeds", type=Path, help="folder of a finished lpn reproduce with several seeds")
    parser.add_argument("--world", type=Path, help="rendered world that the run was made on")
    parser.add_argument("--ablation", type=Path, help="folder of the ablation's runs")
    parser.add_argument("--trained", type=Path, help="folder of networks that were measured on the test split")
    parser.add_argument("--commit", default="", help="commit of the runs of --ablation or --trained")
    parser.add_argument("--check", action="store_true", help="write nothing, and fail on a difference")
    parser.add_argument("--crossval", type=Path, help="table of an lpn crossval")
    parser.add_argument("--docs", type=Path, default=Path(__file__).parents[1] / "docs")
    given = parser.parse_args()
    if given.check:
        found = [error for page in PAGES for error in errors(page, given.docs)]
        print("\n".join(found) or "The pages are what their data say.")
        return int(bool(found))
    if (given.run is None and given.seeds is None) != (given.world is None):
        parser.error("--run or --seeds and --world go together: the page tells of both.")
    if given.seeds is not None and (given.seeds / "tuning.json").is_file():
        parser.error(
            f"{given.seeds / 'tuning.json'} says that networks of the run were tuned, but the page says that none was; "
            "give a run made with lpn reproduce --no-tune."
        )
    if given.run is not None:
        copy_run(given.run, given.world, given.docs)
    if given.seeds is not None:
        copy_seeds(given.seeds, given.world, given.docs)
    if given.ablation is not None:
        copy_ablation(given.ablation, given.commit, given.docs)
    if given.trained is not None:
        copy_trained(given.trained, given.commit, given.docs)
    if given.crossval is not None:
        copy_crossval(given.crossval, given.docs)
    for page in PAGES:
        write_atomic(given.docs / f"{page}.md", render(page, given.docs).encode())
    return 0


if __name__ == "__main__":
    sys.exit(main())
