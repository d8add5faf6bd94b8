"""Plain arrays in the app: ranking, laboratory, and map without a model."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from explorer.opening import open_source
from lpn.analysis import breakdown
from lpn.sources import SourceOptions
from tests.explorer.conftest import answered


def test_arrays_are_ranked_without_a_model(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    query, gallery = rng.standard_normal((6, 2, 5)), rng.standard_normal((9, 2, 5))
    np.save(tmp_path / "q.npy", query)
    np.save(tmp_path / "g.npy", gallery)
    lines = ["file,side,label,latitude,longitude"]
    lines += [f"q{row},query,{row},46.{row},7" for row in range(6)] + [
        f"g{row},gallery,{row},46.{row},7" for row in range(9)
    ]
    (tmp_path / "paths.csv").write_text("\n".join(lines))
    workspace = open_source(
        SourceOptions(source=str(tmp_path / "q.npy"), gallery=tmp_path / "g.npy", paths=tmp_path / "paths.csv"), "q2"
    )
    (task,) = workspace.tasks.values()
    assert workspace.first_query == 2
    assert workspace.part_names == ["1", "2"]
    unit = [side / np.linalg.norm(side, axis=2, keepdims=True) for side in (query, gallery)]
    cosines = np.einsum("nd,gnd->gn", unit[0][2], unit[1])
    for weights in ([1, 1], [0, 1]):
        result = answered(workspace, weights=weights)
        expected = np.argsort(-(cosines @ np.array(weights, float)), kind="stable")[:4]
        assert [match.index for match in result.analysis.matches[:4]] == expected.tolist()
        assert result.message()["headline"]["found"] in (True, False)
    assert workspace.areas(task.query_view) is None
    pairs = breakdown.confusions(task.outcomes, task.query_labels, task.gallery_labels, task.table.rows())
    assert sum(pair.count for pair in pairs) == int(task.outcomes.failed.sum())
