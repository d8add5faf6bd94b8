"""Measure queries that are described at several turns: `python -m tools.turned_queries DATA MODEL --out FILE [--every N]`.

The model is calibrated on the pictures first. The answers to each set of turns are read in two ways: by the mean of the
descriptors of all turns (average), and by the turn at which the tile is nearest (search). Each is compared with the queries as
they are, with a 95 % interval (bootstrap over places).
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

import lpn
from lpn.analysis.model_table import RESAMPLES, intervals
from lpn.core.arrays import Float32Array, Float64Array, Int64Array
from lpn.core.files import write_json
from lpn.core.views import views_of
from lpn.datasets import open_dataset
from lpn.descriptors import descriptor_reader
from lpn.descriptors.transforms import Change
from lpn.reproduce.record import here
from lpn.retrieval import metrics
from lpn.retrieval.calibration import calibrate
from lpn.retrieval.protocol import averaged

SEED = 0  # of the bootstrap
# Degrees; the first set is the query as it is.
TURNS = ((0,), (-10, 0, 10), (-20, 0, 20), (0, 90, 180, 270), tuple(range(0, 360, 45)))


def searched(turned: Float32Array, tiles: Float32Array) -> Int64Array:
    """Return the tile (G, n, D) that is nearest to each query at any of its turns (t, Q, n, D): (Q,)."""
    scores = np.einsum("tqnd,gnd->tqg", turned, tiles).max(axis=0)
    return np.asarray(scores.argmax(axis=1), np.int64)


def measure(data: Path, name: str, every: int = 1) -> dict[str, Any]:
    """Return R@1 in percent of each set of turns on the first task of a data set, on each N-th query."""
    dataset, model = open_dataset(data), lpn.load(name)
    query_view, gallery_view = views_of(dataset.tasks()[0])
    queries, gallery = dataset.queries(query_view)[::every], dataset.gallery(gallery_view)
    read, model = descriptor_reader(dataset.root), model.for_task(query_view, gallery_view)
    found = calibrate(model, {query_view: [queries], gallery_view: [gallery]}, read)
    tiles = found.read(model, gallery, gallery_view, read)
    labels, places = (np.array([picture.label for picture in pictures], np.int64) for pictures in (queries, gallery))
    described = {
        turn: found.read(model, queries, query_view, read, Change(rotate=float(turn)))
        for turn in sorted({*sum(TURNS, ())})
    }
    rows: list[dict[str, Any]] = []
    as_it_is: list[Float64Array] = []
    for turns in TURNS:
        turned = np.stack([described[turn] for turn in turns])
        rows_of_turns = np.tile(np.arange(len(queries)), len(turns))
        mean, _ = averaged(np.concatenate(turned), rows_of_turns)
        nearest = (metrics.retrieve(mean, labels, tiles, places).best, searched(turned, tiles))
        hits = [(places[one] == labels).astype(np.float64) for one in nearest]
        as_it_is = as_it_is or hits
        row: dict[str, Any] = {"turns": list(turns)}
        gains = np.stack([one - before for one, before in zip(hits, as_it_is, strict=True)])
        for reading, hit, gain in zip(
            ("average", "search"), hits, intervals(gains, labels, SEED, RESAMPLES), strict=True
        ):
            row[reading] = 100 * float(hit.mean())
            row[f"{reading} gain"] = gain.difference()
        rows.append(row)
    made = msgspec.to_builtins(here())
    made["command"] = made["command"].replace(f"{Path(__file__).name} ", "python -m tools.turned_queries ")
    return {"data": data.resolve().name, "model": name, "queries": len(queries), "rows": rows, **made}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("data", type=Path)
    parser.add_argument("model")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--every", type=int, default=1)
    options = parser.parse_args()
    write_json(options.out, measure(options.data, options.model, options.every))


if __name__ == "__main__":
    main()
