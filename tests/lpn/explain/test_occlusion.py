"""Covering parts of pictures, and that evidence points at what matters."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from lpn import load, retrieval
from lpn.core import images
from lpn.core.demo import DEMO
from lpn.explain import occlusion
from lpn.retrieval import scoring
from tools.fixtures import small_worlds
from tools.fixtures.faithfulness import centre_first, curve, curves


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
    # The middle of the square is blurred, the other end of the picture as it was.
    np.testing.assert_array_equal(spoilt[:5], shaped[:5])
    np.testing.assert_allclose(spoilt[32, 40], occlusion.blur(shaped)[32, 40], atol=2)
    cosines = [
        scoring.part_cosines(retrieval.describe_picture(model, shown, "drone").descriptor, other[None])[0]
        for shown in (shaped, spoilt)
    ]
    np.testing.assert_allclose(losses[:, 1, 2], cosines[0] - cosines[1], atol=1e-5)


def test_covering_can_be_stopped_and_shows_what_it_has(model_file: Path) -> None:
    model = load(model_file)
    other = model.descriptors(images.prepare(small_worlds.place(1), model.input_size)[None], "satellite")[0]
    done, losses = next(occlusion.occlude(model, small_worlds.place(2), "drone", other))
    assert done == 8
    assert np.isnan(losses).sum() == 4 * (64 - 8)


def test_curves_begin_and_end_at_the_whole_and_the_blurred_picture(model_file: Path) -> None:
    model, weights = load(model_file), scoring.part_weights(4)
    picture = small_worlds.place(2)
    other = retrieval.describe_picture(model, small_worlds.place(1), "satellite").descriptor
    order = centre_first((4, 4))
    assert set(order[:4]) == {5, 6, 9, 10}
    out, back = (curve(model, picture, "drone", other, weights, order, (4, 4), 4, insert) for insert in (False, True))
    whole = (
        scoring.part_cosines(retrieval.describe_picture(model, picture, "drone").descriptor, other[None])[0] @ weights
    )
    assert out[0] == pytest.approx(whole, abs=1e-5)
    assert (out[0], out[-1]) == pytest.approx((back[-1], back[0]), abs=1e-6)


@pytest.mark.slow
def test_on_the_demo_evidence_finds_what_matters() -> None:
    found = {key: float(scores.mean()) for key, scores in curves(DEMO, load(DEMO / "lpn.onnx"), 6, 4).items()}
    for other in ("random", "centre first"):
        assert found["deletion", "evidence"] < found["deletion", other] - 0.02
    assert found["insertion", "evidence"] > found["insertion", "random"] + 0.05
    gaps = {name: found["insertion", name] - found["deletion", name] for name in ("evidence", "random", "centre first")}
    assert gaps["evidence"] > gaps["centre first"] > gaps["random"]
