"""The exact account of pairs and of ranked tiles of the demo: it adds up, and it is that of the baseline."""

from __future__ import annotations

from lpn.core.arrays import FloatingArray
from tools.keep.measures import Figures, Measure, at_most, within
from tools.keep.ranks import demo_tasks, spread

# Largest error of a sum, and largest change of a value.
EXACT = 1e-5
_PAIRS, _TILES = 10, 20
_DIGITS = 6


def explained() -> Figures:
    """Account for queries and their nearest tiles, plain, calibrated, and by CSLS in turn.

    "errors" has for each pair the largest error of its sums: cells and constants of a part and its cosine on both sides, parts
    and the score, shares and the distance, and cells of a picture and its descriptor. The other figures are lists over all pairs:
    the cosine of each part, the constants of both sides, and each cell's share of the score, of the query before the tile.
    """
    import numpy as np

    from lpn import explain, retrieval
    from lpn.retrieval import scoring

    tasks = demo_tasks()
    errors, cosines, constants, cells = (list[float]() for _ in range(4))
    for number, query in enumerate(spread(len(tasks[0].queries), _PAIRS)):
        task = tasks[number % len(tasks)]
        assert task.model is not None
        ranking = task.search(query)
        match = ranking.match(0)
        pictures = task.queries[query], task.gallery[match.index]
        first, second = (
            retrieval.describe_picture(task.model, picture.load_zoomed(), view)
            for picture, view in zip(pictures, task.views, strict=True)
        )
        assert first.trace is not None
        assert second.trace is not None
        terms = ranking.csls_of(match.index)
        account = explain.evidence(first.trace, second.trace, ranking.weights, terms)
        similar = scoring.part_cosines(first.descriptor, second.descriptor[None])[0].astype(float)
        score = float(similar @ ranking.weights) - sum(float(one @ ranking.weights) for one in terms or ())
        sums = [
            *(side.cells.sum((1, 2)) + side.constants - similar for side in (account.query, account.tile)),
            account.weighted_cosines.sum() + sum(account.csls_shares) - score,
            account.contributions.sum() - (2 - 2 * score),
            first.trace.errors(),
            second.trace.errors(),
        ]
        errors.append(float(f"{max(np.abs(one).max() for one in sums):.2g}"))
        cosines += _rounded(account.cosines)
        constants += _rounded(np.concatenate([account.query.constants, account.tile.constants]))
        cells += _rounded(np.concatenate([one.ravel() for one in account.cell_maps()]))
    return {"errors": errors, "cosines": cosines, "constants": constants, "cells": cells}


def matches() -> Figures:
    """Split the distance of queries to their positives into the parts' shares, plain, calibrated, and by CSLS in turn.

    Figures are lists over all pairs: the error of the shares' sum, the squared distance, and each part's share.
    """
    tasks = demo_tasks()
    errors, distances, shares = (list[float]() for _ in range(3))
    for number, query in enumerate(spread(len(tasks[0].queries), _TILES)):
        match = tasks[number % len(tasks)].search(query).positive()
        assert match is not None
        errors.append(float(f"{abs(match.contributions.sum(dtype=float) - match.distance2):.2g}"))
        distances.append(round(match.distance2, _DIGITS))
        shares += _rounded(match.contributions)
    return {"errors": errors, "distances": distances, "shares": shares}


def _rounded(values: FloatingArray) -> list[float]:
    return [round(float(value), _DIGITS) for value in values]


MEASURES = (
    Measure("explained", explained, {"errors": at_most(EXACT), "*": within(EXACT)}),
    Measure("matches", matches, {"errors": at_most(EXACT), "*": within(EXACT)}),
)
