"""Occlusion of parts of pictures, and evidence on the cells that matter."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import lpn
from lpn import load, retrieval
from lpn.core import images
from lpn.core.arrays import Float32Array
from lpn.datasets import open_dataset
from lpn.explain import occlusion
from lpn.library.matching_turn import relative_turn
from lpn.models.partition import Partition
from lpn.models.trace import Trace
from lpn.reproduce.measure import centre_box, centre_share, centre_shares
from lpn.retrieval import scoring
from tools.fixtures import small_worlds
from tools.fixtures.small_contracts import GateModel


def test_a_square_s_loss_is_what_its_blurring_costs(model_file: Path) -> None:
    model = load(model_file)
    picture = small_worlds.place(3)
    other = retrieval.describe_picture(model, small_worlds.from_drone(small_worlds.place(3), 1), "satellite").descriptor
    steps = list(occlusion.occlude(model, picture, "drone", other, rows=3, columns=4))
    assert [done for done, _ in steps] == [8, 12]
    losses = steps[-1][1]
    assert losses.shape == (4, 3, 4)
    shaped = images.resize(picture, *model.input_size)
    gone = np.zeros((3, 4), bool)
    gone[1, 2] = True
    spoilt = occlusion.mixed(shaped, occlusion.blur(shaped), gone)
    # The middle of the square is blurred, the far end of the picture unchanged.
    np.testing.assert_array_equal(spoilt[:5], shaped[:5])
    np.testing.assert_allclose(spoilt[32, 40], occlusion.blur(shaped)[32, 40], atol=2)
    cosines = [
        scoring.part_cosines(retrieval.describe_picture(model, shown, "drone").descriptor, other[None])[0]
        for shown in (shaped, spoilt)
    ]
    np.testing.assert_allclose(losses[:, 1, 2], cosines[0] - cosines[1], atol=1e-5)


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
        total = features[0].sum(axis=0)
        assert shares[i] == pytest.approx(total[centre_box(*total.shape)].sum() / total.sum(), rel=1e-5)
        trace = retrieval.describe_picture(model, pictures[i].load(), "drone").trace
        assert shares[i] == pytest.approx(centre_share(trace.activation), rel=1e-5)


def test_maps_of_each_part_are_summed_over_the_parts(data: Path) -> None:
    model, picture = GateModel(), open_dataset(data).gallery("drone")[0]
    trace = retrieval.describe_picture(model, picture.load(), "drone").trace
    assert list(centre_shares(model, [picture], "drone")) == pytest.approx([centre_share(trace.activation)])


def trace_of(features: Float32Array) -> Trace:
    """The trace of one pass with a map (C, h, w); nothing but the map matters here."""
    nothing = np.zeros((1, 1), np.float32)
    return Trace(
        nothing, features[None], np.ones((1, 1, *features.shape[1:]), np.float32), None, None, np.zeros((1, 1))
    )


@pytest.mark.parametrize("quarters", range(4))
def test_a_map_that_was_turned_is_turned_back(quarters: int) -> None:
    query = np.random.default_rng(3).random((8, 12, 12), np.float32)
    tile = np.rot90(query, -quarters, axes=(1, 2))  # clockwise
    assert relative_turn(trace_of(query), trace_of(np.ascontiguousarray(tile))) == 90 * quarters


def test_maps_that_cannot_be_laid_over_each_other_have_no_turn() -> None:
    maps = np.random.default_rng(3).random((8, 12, 12), np.float32)
    square = trace_of(maps)
    assert relative_turn(square, trace_of(maps[:, :10, :10])) is None
    assert relative_turn(trace_of(maps[:, :6]), trace_of(maps[:, :6])) is None
    assert relative_turn(square, trace_of(np.ones_like(maps))) is None
