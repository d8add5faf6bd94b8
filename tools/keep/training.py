"""Real pairs: a network that is trained on 320 places of University-1652 and measured on 80 others."""

from __future__ import annotations

import json
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from statistics import mean

from tools.keep._resumable import keep_row, resumable, run_lpn
from tools.keep.measures import Figures, Measure, Value, at_least, data_folder, reported

TASKS = ("drone-to-satellite", "satellite-to-drone")
SEEDS = (0, 1, 2)
SETTINGS = ("--recipe", "small", "--init", "city-lpn", "--ground-ratio", 1.41, "--size", 160)
READINGS = {"calibrated": ("--calibrate",), "CSLS": ("--calibrate", "--csls", 3)}


def trained_pairs() -> Figures:
    """Train with each seed, and measure R@1 both ways, calibrated and by CSLS; about ten minutes of processor time a seed."""
    data = data_folder("LPN_MINI_DATA")
    with resumable("training") as folder:
        rows = [
            keep_row(folder / "rows.json", f"seed {seed}", partial(_measured, data, folder, seed)) for seed in SEEDS
        ]
    return training_figures(rows)


def training_figures(rows: list[Mapping[str, float]]) -> Figures:
    """Reduce R@1 of each seed to its mean, half of the distance between lowest and highest, and its values, in percent."""
    figures: dict[str, Value] = {}
    for name in rows[0]:
        values = [row[name] for row in rows]
        figures |= {
            f"{name} mean": round(mean(values), 2),
            f"{name} half range": round((max(values) - min(values)) / 2, 2),
            f"{name} by seed": values,
        }
    return figures


def _measured(data: Path, folder: Path, seed: int) -> dict[str, float]:
    """Train with a seed, and return R@1 in percent of each reading and task."""
    out, measures = folder / f"seed-{seed}", folder / "measures.json"
    begun = any((out / name).exists() for name in ("state.pt", "log.csv"))
    run_lpn("train", "--data", data, "--out", out, *SETTINGS, "--seed", seed, *["--resume"] * begun)
    found = {}
    for reading, options in READINGS.items():
        for task in TASKS:
            told = ("--task", task, *options, "--json", measures)
            run_lpn("evaluate", data, "--model", out / "last.safetensors", *told)
            found[f"{reading} {task}"] = round(json.loads(measures.read_bytes())["recall@1"], 2)
    return found


MEASURES = (
    Measure(
        "training",
        trained_pairs,
        {
            # By docs/strong.md: the mean of three seeds, less half of the distance between the lowest and the highest.
            "calibrated drone-to-satellite mean": at_least(77.08),
            "calibrated satellite-to-drone mean": at_least(75.41),
            "CSLS drone-to-satellite mean": at_least(80.83),
            "CSLS satellite-to-drone mean": at_least(82.5),
            "* half range": reported(),
            "* by seed": reported(),
        },
        slow=True,
    ),
)
