"""The metric losses of Table I beside numbers of the released code, see `tools.fixtures.released_metric`."""

from __future__ import annotations

import pytest

from lpn.training.recipes import METRIC_LOSSES
from tools.fixtures import released_metric


@pytest.mark.slow
def test_network_losses_and_gradients_are_the_released_ones() -> None:
    found = released_metric.differences()
    assert {f"{name}.loss" for name in METRIC_LOSSES} <= set(found)
    # Differences are relative to the largest value of each array. All but the descriptor are computed in float64.
    assert found.pop("descriptor") < 2e-5
    assert max(found.values()) < 1e-7, found


def test_the_released_test_scales_before_it_adds_the_mirror() -> None:
    assert 1e-4 < released_metric.mirror_difference() < 1e-3
