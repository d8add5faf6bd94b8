"""A whole evaluation, from descriptors to Recall@K and AP: `python -m tools.bench evaluate`.

The peer is the published evaluation: query by query, all scores, a full sort, and a walk over the true matches. The limit is
the matrix product of the two sides in single precision, which ranks nothing. The loop runs once, the others several times, of
which the median counts. Descriptors are drawn: places are points in a space of few dimensions, mapped to unit parts, with the
noise that leaves a trained network's Recall@1. Ours is measured in a process of its own, which tells its peak memory.
"""

from __future__ import annotations

import json
import resource
import statistics
import subprocess
import sys
import time
from dataclasses import dataclass

import numpy as np

from lpn.core.arrays import Float32Array, Int64Array
from lpn.retrieval import metrics
from tools.bench.figures import Figure

LENGTH, PARTS, LATENT, NOISE = 2048, 4, 96, 1.2
KEYS = ("recall@1", "recall@5", "recall@10", "recall@1%", "ap")


@dataclass(frozen=True)
class GallerySize:
    """Numbers of queries, gallery pictures, and gallery pictures per place."""

    name: str
    queries: int
    gallery: int
    each: int


SIZES = (GallerySize("drone to satellite", 37_855, 951, 1), GallerySize("satellite to drone", 701, 51_355, 54))


def draw(size: GallerySize) -> tuple[Float32Array, Int64Array, Float32Array, Int64Array]:
    """Draw descriptors and labels of queries and gallery."""
    rng = np.random.default_rng(0)
    labels = np.arange(size.gallery) // size.each
    asked = rng.integers(0, int(0.74 * labels[-1]), size.queries)
    centres = rng.standard_normal((int(labels[-1]) + 1, LATENT), dtype=np.float32)
    spread = rng.standard_normal((LATENT, LENGTH), dtype=np.float32) / np.float32(np.sqrt(LATENT))

    def side(of: Int64Array) -> Float32Array:
        made = np.empty((len(of), LENGTH), np.float32)
        for start in range(0, len(of), 4096):
            some = of[start : start + 4096]
            points = centres[some] + NOISE * rng.standard_normal((len(some), LATENT), dtype=np.float32)
            mapped = points @ spread + 0.3 * rng.standard_normal((len(some), LENGTH), dtype=np.float32)
            parts = mapped.reshape(len(some), PARTS, -1)
            parts /= np.sqrt(PARTS) * np.linalg.norm(parts, axis=2, keepdims=True)
            made[start : start + 4096] = mapped
        return made

    return side(asked), asked, side(labels), labels


def published(
    query: Float32Array, query_labels: Int64Array, gallery: Float32Array, labels: Int64Array
) -> dict[str, float]:
    """Compute the metrics as the published evaluation does."""
    curve, total = np.zeros(len(gallery)), 0.0
    for descriptor, label in zip(query, query_labels, strict=True):
        ranking = np.argsort(gallery @ descriptor)[::-1]
        ranking = ranking[np.isin(ranking, np.flatnonzero(labels == -1), invert=True)]
        hits = np.flatnonzero(np.isin(ranking, np.flatnonzero(labels == label)))
        if len(hits) == 0:
            continue
        curve[hits[0] :] += 1
        for i, rank in enumerate(hits):
            before = i / rank if rank else 1.0
            total += ((i + 1) / (rank + 1) + before) / (2 * len(hits))
    at = (1, 5, 10, round(0.01 * len(gallery)) + 1)
    values = [curve[min(k, len(gallery)) - 1] for k in at]
    return {key: 100 * float(value) / len(query) for key, value in zip(KEYS, (*values, total), strict=True)}


def ours(size: GallerySize) -> None:
    """Measure in this process; print metrics, times, and peak memory as JSON."""
    query, query_labels, gallery, labels = draw(size)
    _ = query[:256] @ gallery[:256].T  # the first product starts the threads
    started = time.perf_counter()
    figures = metrics.evaluate(query, query_labels, gallery, labels)
    seconds = time.perf_counter() - started
    most = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    products, evaluations = [], [seconds]
    for _ in range(3):
        started = time.perf_counter()
        _product = query @ gallery.T
        products.append(time.perf_counter() - started)
        del _product
        started = time.perf_counter()
        metrics.evaluate(query, query_labels, gallery, labels)
        evaluations.append(time.perf_counter() - started)
    told = {"figures": figures, "seconds": statistics.median(evaluations), "product": statistics.median(products)}
    print(json.dumps(told | {"peak": most * 1024}))


def figures() -> list[Figure]:
    made: list[Figure] = []
    for number, size in enumerate(SIZES):
        command = [sys.executable, "-m", "tools.bench.evaluate", str(number)]
        found = json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout)
        drawn = draw(size)
        started = time.perf_counter()
        theirs = published(*drawn)
        loop = time.perf_counter() - started
        apart = max(abs(theirs[key] - found["figures"][key]) for key in KEYS)
        what = f"evaluate {len(drawn[0]):,} x {len(drawn[2]):,}"
        made += [
            Figure(f"{what} (limit: the float32 product)", found["seconds"], "s", loop, found["product"]),
            Figure(f"{what}, peak memory", found["peak"] / 1e9, "GB"),
            Figure(f"{what}, largest difference of R@K and AP from the published loop's", apart, "points"),
        ]
    return made


if __name__ == "__main__":
    ours(SIZES[int(sys.argv[1])])
