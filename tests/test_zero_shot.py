"""Groups of networks on pictures that none was trained on, measured by the program on small data."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

import lpn
from lpn.datasets import open_dataset
from lpn.retrieval.evaluate import evaluate
from tools.fixtures import small_worlds
from tools.fixtures.programs import run_program


@pytest.mark.slow
def test_groups_have_the_figures_of_lpn_evaluate_and_differ_from_the_first_one_by_their_own(
    tmp_path: Path, model_file: Path, one_part_model_file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    data, out = small_worlds.make_dataset(tmp_path / "places", train=1, test=24), tmp_path / "zero.json"
    first, second = model_file, one_part_model_file
    groups = [f"one={first},{second}", f"two={second},{first}", f"three={first}", f"four={first},{first}"]
    run_program(monkeypatch, "tools.zero_shot", data, *groups, "--out", out)
    found = json.loads(out.read_bytes())
    one, two, three, four = found["rows"]
    dataset = open_dataset(data)
    differs = set()
    for task in dataset.tasks():
        plain = one["tasks"][task]["plain"]
        expected = [evaluate(lpn.load(file), dataset, task).recall["1"] for file in (first, second)]
        assert plain["runs"] == pytest.approx(expected)
        assert plain["mean"] == pytest.approx(sum(expected) / 2)
        assert "difference" not in plain
        gain = two["tasks"][task]["plain"]
        assert gain["difference"] == pytest.approx(0)  # the same networks in another order
        assert gain["interval"][0] <= 0 <= gain["interval"][1]
        gain = four["tasks"][task]["plain"]
        assert gain["difference"] == pytest.approx((expected[0] - expected[1]) / 2)
        differs.add(gain["difference"])
        assert "difference" not in three["tasks"][task]["plain"]  # another number of seeds
        assert set(three["tasks"][task]) == {"plain", "calibrated", "csls"}
    assert differs != {0.0}
    assert found["command"].startswith("python -m tools.zero_shot ")
