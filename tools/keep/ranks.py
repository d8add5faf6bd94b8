"""The demo: the rank and score of each query's positive under every scoring, and some pictures described anew."""

from __future__ import annotations

from typing import TYPE_CHECKING

from tools.keep.measures import Figures, Measure, Value, at_least, equal, reported, within

if TYPE_CHECKING:
    from lpn.tasks.task import Task

# Scores of two runs agree to this, and the order of two tiles is certain where their scores differ by twice as much.
SCORE = 1e-6
_DIGITS = 7


def ranks() -> Figures:
    """Rank the positive of every query of the demo plain, calibrated, and by CSLS.

    Each scoring has its R@1 in percent, and by query: the 1-based rank of the nearest positive, its score, and the difference
    from that score to the nearest other one.
    """
    figures: dict[str, Value] = {}
    for task in demo_tasks():
        rows = []
        for query, first in enumerate(task.retrieved.first.tolist()):
            ranking = task.search(query)
            positive = ranking.positive()
            assert positive is not None
            others = ranking.scores[ranking.order[ranking.order != positive.index]]
            gap = abs(others - positive.score).min()
            rows.append((first + 1, round(positive.score, _DIGITS), float(f"{gap:.2g}")))
        figures[f"{task.scoring} R@1"] = round(task.metrics["recall@1"], 2)
        for name, column in zip(("ranks", "scores", "gaps"), zip(*rows, strict=True), strict=True):
            figures[f"{task.scoring} {name}"] = list(column)
    return figures


def demo_tasks() -> list[Task]:
    """Open the demo's first task under each scoring, plain first."""
    from lpn import load, open_dataset
    from lpn.core.demo import DEMO, DEMO_MODEL
    from lpn.tasks.opening import describe_task, scored_tasks, shipped_calibration

    model, dataset = load(DEMO_MODEL, "cpu"), open_dataset(DEMO)
    calibration = shipped_calibration(model, dataset)
    assert calibration is not None
    plain = describe_task(model, DEMO_MODEL.name, dataset)
    return [plain, *scored_tasks(model, DEMO_MODEL.name, dataset, calibration, [plain.name])]


def described() -> Figures:
    """Describe some pictures of the demo anew by the shipped model, which shows a change of decoding.

    Figures are lists by picture, drone pictures first: the cosine with the shipped descriptor, which is rounded to 8 bits for a
    drone picture and to 16 for a tile, and the sum over the descriptor's numbers with alternating signs.
    """
    import numpy as np

    from lpn import retrieval

    task = demo_tasks()[0]
    assert task.model is not None
    cosines, sums = list[float](), list[float]()
    for pictures, view, stored, count in (
        (task.queries, task.query_view, task.query_descriptors, 48),
        (task.gallery, task.gallery_view, task.gallery_descriptors, 16),
    ):
        for i in spread(len(pictures), count):
            found = retrieval.describe_picture(task.model, pictures[i].load_zoomed(), view).descriptor
            cosines.append(round(float((found * stored[i]).sum()), _DIGITS))
            sums.append(round(float((found.reshape(-1, 2) @ np.array([1.0, -1.0])).sum()), _DIGITS))
    return {"cosines with the shipped": cosines, "alternating sums": sums}


def spread(length: int, count: int) -> list[int]:
    """Positions of a sequence, evenly from its first."""
    return [number * length // count for number in range(count)]


MEASURES = (
    Measure(
        "ranks",
        ranks,
        {
            "plain R@1": at_least(70.0),
            "calibrated R@1": at_least(84.6),
            "* R@1": within(0.1),
            **{f"{scoring} ranks": equal(f"{scoring} gaps", 2 * SCORE) for scoring in ("plain", "calibrated", "csls")},
            "* scores": within(SCORE),
            "* gaps": reported(),
        },
    ),
    Measure("described", described, {"cosines *": within(1e-5), "alternating sums": within(1e-4)}),
)
