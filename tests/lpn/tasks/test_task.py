"""Tests of what all tasks have."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from lpn.core.errors import InputError
from lpn.datasets import Truth
from lpn.sources import SourceOptions, open_source


def test_a_query_whose_truth_is_taken_away_is_not_graded(data: Path, model_file: Path) -> None:
    by_labels = open_source(SourceOptions(source=str(data), model=model_file)).task
    with pytest.raises(InputError, match="told by labels"):
        by_labels.without_truth([0])
    none = np.zeros(0, np.int64)
    lists = [Truth(np.flatnonzero(by_labels.gallery_labels == label), none) for label in by_labels.query_labels]
    task = replace(by_labels, truth=lists)
    assert task.without_truth([]) is task
    failed = np.flatnonzero(task.outcomes.failed)
    assert len(failed)
    left = task.without_truth([int(failed[0])])
    assert left.without_truth(failed[:1].tolist()) is left
    np.testing.assert_array_equal(np.flatnonzero(left.outcomes.failed), failed[1:])
    assert (task.metrics["queries"], left.metrics["queries"]) == (len(lists), len(lists) - 1)
    assert left.search(int(failed[0])).relevant is None
