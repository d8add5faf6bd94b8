"""A whole task under part weights: `python -m tools.bench.parts [SHARE]`.

The descriptors are those of `tools.bench.evaluate`, 4 parts of 512 numbers. The first weights take a comparison of all queries
with the gallery, part by part; the peer ranks the task anew under each weights (`metrics.retrieve`). Further weights take what
the comparison kept, and intervals from a bootstrap. SHARE, 0 .. 1, is how much of both sizes is measured, 1 by default.
"""

from __future__ import annotations

import statistics
import sys
import time

import numpy as np

from lpn.analysis.model_table import RESAMPLES, intervals
from lpn.analysis.part_weights import part_combinations, weights_of
from lpn.retrieval import metrics
from lpn.retrieval.part_ranks import PartRanks
from lpn.tasks.query_outcomes import weight_factors
from tools.bench.evaluate import PARTS, SIZES, GallerySize, draw
from tools.bench.figures import Figure, below, show

# Seconds that the figures under weights may take on two cores.
TARGET = 2


def figures_of(size: GallerySize, share: float) -> list[Figure]:
    """Measure one size."""
    query, query_labels, gallery, labels = draw(size, share)
    query, gallery = (side.reshape(len(side), PARTS, -1) for side in (query, gallery))
    _ = query[:256, 0] @ gallery[:256, 0].T  # the first product starts the threads
    started = time.perf_counter()
    parts = PartRanks.of(query, gallery, query_labels, labels)
    compared = time.perf_counter() - started
    if parts is None:
        raise SystemExit("The drawn parts disagree about too many tiles to be kept.")
    equal = parts.under(np.full(PARTS, 1 / PARTS))
    seconds = []
    for some in part_combinations(PARTS):
        started = time.perf_counter()
        weights = np.array(weights_of(some, PARTS))
        first, precision = parts.under(weights / weights.sum())
        hits, before = first == 0, equal[0] == 0
        intervals(np.stack([hits * 1.0 - before, precision - equal[1]]), query_labels, 0, RESAMPLES)
        seconds.append(time.perf_counter() - started)
    weights = np.array([1.0, 1, 0, 1])
    started = time.perf_counter()
    anew = metrics.retrieve(query, query_labels, gallery, labels, None, weight_factors(query, weights))
    peer = time.perf_counter() - started
    first, precision = parts.under(weights / weights.sum())
    different = int((first != anew.first).sum() + (precision != anew.precision).sum())
    what = f"{len(query):,} x {len(gallery):,}"
    further = statistics.median(seconds)
    return [
        below(f"{what}, first weights", compared + 2 * further, TARGET, "s", peer),
        below(f"{what}, further weights (median of 15)", further, TARGET, "s", peer),
        Figure(f"{what}, all 15 combinations", compared + sum(seconds), "s", 15 * peer),
        Figure(f"{what}, queries whose rank or AP differs from the peer's", different, "queries"),
    ]


def main(arguments: list[str]) -> None:
    """Measure and print."""
    share = float(arguments[0]) if arguments else 1.0
    if not 0 < share <= 1:
        raise SystemExit(f"The share is {share:g}; expected more than 0 and at most 1.")
    show("Part weights", [one for size in SIZES for one in figures_of(size, share)])


if __name__ == "__main__":
    main(sys.argv[1:])
