"""The effect of part weights on all queries of a task, against each query ranked by itself."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from lpn import retrieval
from lpn.analysis.comparison import effect_on
from lpn.core.arrays import Float32Array
from lpn.datasets import Truth
from lpn.models.base import normalise
from lpn.retrieval import metrics, ranks, scoring
from tools.fixtures.tasks import descriptor_task


def described(seed: int, count: int) -> Float32Array:
    return normalise(np.random.default_rng(seed).standard_normal((count, 3, 16)).astype(np.float32))


@pytest.mark.parametrize("listed", [False, True])
def test_the_effect_on_a_data_set_is_that_of_each_query_ranked(listed: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ranks, "_BLOCK_BYTES", 4 * 30 * 4)  # several blocks
    rng = np.random.default_rng(3)
    gallery = described(4, 30)
    labels, of_query = rng.integers(-1, 12, 30), rng.integers(0, 12, 25)
    mates = [np.flatnonzero(labels == label) for label in of_query]
    query = normalise(np.stack([gallery[m[0] if len(m) else 0] for m in mates]) + 3 * described(5, 25))
    truth = [Truth(m, np.flatnonzero(labels == metrics.JUNK)) for m in mates] if listed else None
    before, after = [2, 0.1, 0.4], [0.1, 2, 0.5]
    task = replace(descriptor_task(query, gallery, of_query, labels, truth), weights=before)
    found = effect_on(task, after)
    hits = []
    for weights in (before, after):
        tops = [
            retrieval.rank(
                scoring.part_cosines(q, gallery), scoring.part_weights(3, weights), labels, int(label)
            ).match(0)
            for q, label in zip(query, of_query, strict=True)
        ]
        hits.append(np.array([top.true for top in tops]))
    assert (found.before, found.after) == pytest.approx(tuple(100 * h.mean() for h in hits))
    np.testing.assert_array_equal(found.gained, np.flatnonzero(hits[1] & ~hits[0]))
    np.testing.assert_array_equal(found.lost, np.flatnonzero(hits[0] & ~hits[1]))
    assert len(found.gained) > 0
    assert len(found.lost) > 0
    assert found.helps == (found.after > found.before)
    if truth is not None:
        blind = replace(truth[0], good=truth[0].good[:0], known=False)
        graded = effect_on(replace(task, truth=[blind, *truth[1:]]), after)
        assert graded.queries == 24
        assert (graded.before, graded.after) == pytest.approx(tuple(100 * h[1:].mean() for h in hits))
