"""Figure 7's number: the share of activation in the centre."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import lpn
from lpn import retrieval
from lpn.datasets import open_dataset
from lpn.explain.centre import centre_box, centre_share, centre_shares
from lpn.models.partition import Partition
from tools.fixtures.small_contracts import GateModel


def test_activation_in_the_centre_is_a_share_of_the_map() -> None:
    assert centre_box(16, 16).sum() == 64
    assert np.array_equal(centre_box(16, 16), Partition("rings", 4).labels(16, 16) < 2)
    even, middle = np.ones((16, 16)), np.zeros((16, 16))
    middle[6:10, 6:10] = 5
    # A quarter of the area only if both sides are multiples of four.
    assert centre_box(14, 14).mean() == pytest.approx(0.184, abs=5e-4)
    assert [centre_share(one) for one in (even, middle, middle - 1, 0 * even, -even)] == [0.25, 1.0, 1.0, 0.25, 0.25]


def test_shares_of_pictures_are_those_of_their_channel_sums(model_file: Path, data: Path) -> None:
    model, pictures = lpn.load(model_file), open_dataset(data).gallery("drone") * 2  # more than one batch
    shares = list(centre_shares(model, pictures, "drone"))
    assert len(shares) == len(pictures) > 16
    for i in (0, len(pictures) - 1):
        features = model.run(model.prepare(pictures[i].load(), "drone")[None], "drone").features
        assert features is not None
        total = features[0].sum(axis=0)
        assert shares[i] == pytest.approx(total[centre_box(*total.shape)].sum() / total.sum(), rel=1e-5)
        trace = retrieval.describe_picture(model, pictures[i].load(), "drone").trace
        assert trace is not None
        assert shares[i] == pytest.approx(centre_share(trace.activation), rel=1e-5)


def test_maps_of_each_part_are_summed_over_the_parts(data: Path) -> None:
    model, picture = GateModel(), open_dataset(data).gallery("drone")[0]
    trace = retrieval.describe_picture(model, picture.load(), "drone").trace
    assert trace is not None
    assert list(centre_shares(model, [picture], "drone")) == pytest.approx([centre_share(trace.activation)])
