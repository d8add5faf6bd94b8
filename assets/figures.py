"""Measures models on a rendered world's test split: `python assets/figures.py WORLD MODEL...`, a Markdown table each.

Both directions, with and without the places that have twins; turned queries; each drone picture of the spiral on its own.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np

import lpn
from lpn import descriptors
from lpn.core.arrays import Float32Array, Int64Array
from lpn.datasets import Dataset, Picture, open_dataset
from lpn.descriptors.transforms import Change
from lpn.models.base import Model
from lpn.retrieval import metrics
from lpn.retrieval.evaluate import evaluate
from lpn.retrieval.protocol import Protocol

ANGLES = (15, 45, 90, 180)


def main() -> None:
    """Print the tables."""
    world, *files = (Path(argument) for argument in sys.argv[1:])
    plan = json.loads((world / "world.json").read_bytes())
    twins = {building["id"]: building["twins"] for building in plan["buildings"]}
    dataset = open_dataset(world)
    for file in files:
        model = lpn.load(file)
        print(f"\n{file.stem}: {model.spec.describe()}\n")
        print(
            "| task | R@1 | R@5 | R@10 | AP | R@1 of twins | R@1 of others | R@1 without twins | wrong | of them a twin |"
        )
        print("|---|---|---|---|---|---|---|---|---|---|")
        for task in ("drone-to-satellite", "satellite-to-drone"):
            _directions(model, dataset, task, twins)
        turned = [evaluate(model, dataset, "drone-to-satellite", Protocol(Change(angle))) for angle in ANGLES]
        print("\nturned: " + ", ".join(f"{r.recall['1']:.1f} at {r.protocol.change.rotate:g} deg" for r in turned))
        near = evaluate(model, dataset, "drone-to-satellite").distances()
        print("error: " + ", ".join(f"{key} {value:.1f}" for key, value in near.items()))
        print("by picture: " + ", ".join(f"{name} {value:.1f}" for name, value in _by_picture(model, dataset).items()))


def _directions(model: Model, dataset: Dataset, task: str, twins: dict[int, int | None]) -> None:
    query_view, gallery_view = task.split("-to-")
    pictures = dataset.queries(query_view), dataset.gallery(gallery_view)
    (query, own), (tiles, theirs) = (
        _described(model, p, v) for p, v in zip(pictures, (query_view, gallery_view), strict=True)
    )
    found = metrics.retrieve(query, own, tiles, theirs)
    whole, top = found.figures(), theirs[found.best]
    right = top == own
    group = np.array([twins[int(label)] or -1 for label in own])
    confused = (group >= 0) & (group == np.array([twins[int(label)] or -1 for label in top])) & ~right
    alone = group < 0
    rest = np.array([twins[int(label)] is None for label in theirs])
    without = metrics.evaluate(query[alone], own[alone], tiles[rest], theirs[rest])
    figures = [whole[key] for key in ("recall@1", "recall@5", "recall@10", "ap")]
    figures += [100 * float(right[~alone].mean()), 100 * float(right[alone].mean()), without["recall@1"]]
    print(
        f"| {task} | "
        + " | ".join(f"{f:.2f}" for f in figures)
        + f" | {(~right).sum()} of {len(own)} | {confused.sum()} |"
    )


def _by_picture(model: Model, dataset: Dataset) -> dict[str, float]:
    """R@1 of the first, second, ... drone picture of each place."""
    pictures = dataset.queries("drone")
    query, own = _described(model, pictures, "drone")
    tiles, theirs = _described(model, dataset.gallery("satellite"), "satellite")
    right = theirs[metrics.retrieve(query, own, tiles, theirs).best] == own
    names = np.array([picture.path.stem.rpartition("-")[2] for picture in pictures])
    return {name: 100 * float(right[names == name].mean()) for name in sorted(set(names))}


def _described(model: Model, pictures: list[Picture], view: str) -> tuple[Float32Array, Int64Array]:
    described = descriptors.cached_descriptors(model, pictures, view)  # type: ignore[arg-type]
    return described, np.array([picture.label for picture in pictures])


if __name__ == "__main__":
    main()
