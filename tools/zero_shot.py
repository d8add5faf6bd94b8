"""Measure groups of networks on pictures that none was trained on: `python -m tools.zero_shot DATA NAME=MODEL,MODEL --out FILE`.

A group is one way of training with several seeds. Each network is read plain, calibrated, and calibrated with CSLS, in both
directions. Each group is compared with the first one query by query, seed by seed, with 95 % intervals (bootstrap over places).
They are intervals of these networks, and do not include what other seeds would give.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

import lpn
from lpn.analysis.model_table import RESAMPLES, RankedModel, intervals, rank_model
from lpn.core.files import write_json
from lpn.datasets import open_dataset
from lpn.descriptors import descriptor_reader
from lpn.reproduce.record import here

NEIGHBOURS = 3  # of CSLS
READINGS = {"plain": (False, 0), "calibrated": (True, 0), "csls": (True, NEIGHBOURS)}
SEED = 0  # of the bootstrap


def measure(data: Path, groups: Mapping[str, Sequence[Path]]) -> list[dict[str, Any]]:
    """Return R@1 in percent of each group, its networks, and its difference from the first group, by task and reading."""
    dataset = open_dataset(data)
    read = descriptor_reader(dataset.root)
    rows: list[dict[str, Any]] = [{"name": name, "networks": len(files), "tasks": {}} for name, files in groups.items()]
    models = {name: [lpn.load(file) for file in files] for name, files in groups.items()}
    for task in dataset.tasks():
        for reading, (calibrated, neighbours) in READINGS.items():
            first: list[RankedModel] = []
            for row in rows:
                ranked = [
                    rank_model(model, row["name"], dataset, task, "full", read, calibrated, neighbours)
                    for model in models[row["name"]]
                ]
                first = first or ranked
                runs = [100 * float(one.within(1).mean()) for one in ranked]
                found = {"mean": float(np.mean(runs)), "runs": runs, **_difference(ranked, first)}
                row["tasks"].setdefault(task, {})[reading] = found
    return rows


def _difference(ranked: Sequence[RankedModel], first: Sequence[RankedModel]) -> dict[str, Any]:
    """Compare networks with those of the first group with the same seeds; nothing for that group itself."""
    if ranked is first or len(ranked) != len(first):
        return {}
    gains = np.concatenate(
        [one.within(1).astype(np.float64) - other.within(1) for one, other in zip(ranked, first, strict=True)]
    )
    labels = np.tile(first[0].labels, len(first))
    (estimate,) = intervals(gains[None], labels, SEED, RESAMPLES)
    return estimate.difference()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("data", type=Path)
    parser.add_argument("groups", nargs="+", metavar="NAME=MODEL,MODEL")
    parser.add_argument("--out", type=Path, required=True)
    options = parser.parse_args()
    groups = {
        name: [Path(file) for file in files.split(",")]
        for name, _, files in (one.partition("=") for one in options.groups)
    }
    if len(groups) < len(options.groups) or not all(map(bool, groups)):
        parser.error("expected a name of its own for each group, as in NAME=MODEL,MODEL")
    rows = measure(options.data, groups)
    made = msgspec.to_builtins(here())
    made["command"] = made["command"].replace(f"{Path(__file__).name} ", "python -m tools.zero_shot ")
    write_json(options.out, {"data": options.data.resolve().name, "rows": rows, **made})


if __name__ == "__main__":
    main()
