from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from torch import Tensor

from lpn.core.errors import InputError
from lpn.training import losses
from lpn.training.losses import (
    PackageLoss,
    TrainingStep,
    descriptors,
    hardest_scores,
    infonce_loss,
    instance_loss,
    loss_terms,
    soft_margin_loss,
)
from lpn.training.recipe import Recipe
from lpn.training.recipes import METRIC_LOSSES, RECIPES, method
from tools.fixtures import released_safa, seeded

B = 6


def drawn(seed: int, *shape: int) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


@pytest.fixture
def pair() -> tuple[Tensor, Tensor]:
    first = drawn(1, B, 4, 16)
    return descriptors(first), descriptors(first + 1.5 * drawn(2, B, 4, 16))


Outputs = dict[str, tuple[Tensor, Tensor]]


def total_loss(outputs: Outputs, labels: dict[str, Tensor], recipe: Recipe, step: int = 0) -> Tensor:
    """The sum of a recipe's terms on part embeddings and class scores of each set."""
    parts, scores = ({name: of[i] for name, of in outputs.items()} for i in (0, 1))
    return torch.stack(list(loss_terms(TrainingStep(parts, scores, labels, None, step), recipe).values())).sum()


def test_instance_loss_is_the_cross_entropy_of_each_part() -> None:
    scores, places = drawn(0, B, 4, 9), torch.arange(B)
    by_part = torch.stack([torch.nn.functional.cross_entropy(scores[:, i], places) for i in range(4)])
    torch.testing.assert_close(instance_loss(scores, places), by_part)


def test_infonce_is_symmetric_and_small_for_the_right_pairs(pair: tuple[Tensor, Tensor]) -> None:
    one, other = pair
    assert infonce_loss(one, one, 0.05) < 1e-3
    torch.testing.assert_close(infonce_loss(one, other, 0.1), infonce_loss(other, one, 0.1))
    assert infonce_loss(one, one.roll(1, 0), 0.05) > 5


def test_smoothed_infonce_leaves_overlapping_pairs_out(pair: tuple[Tensor, Tensor]) -> None:
    one, other = (view.clone().requires_grad_() for view in pair)
    overlaps = torch.zeros(B, B, dtype=torch.bool)
    overlaps[0, 1] = overlaps[1, 0] = True
    found = infonce_loss(one, other, 0.1, 0.2, overlaps)
    table = one @ other.T / 0.1
    terms = []
    for logits in (table, table.T):
        for i in range(B):
            columns = [j for j in range(B) if {i, j} != {0, 1}]
            terms.append(F.cross_entropy(logits[i, columns], torch.tensor(columns.index(i)), label_smoothing=0.2))
    torch.testing.assert_close(found, torch.stack(terms).mean())
    found.backward()
    assert one.grad.isfinite().all()


def test_the_loss_on_distances_has_finite_slopes_where_views_agree() -> None:
    parts = drawn(4, B, 2, 8).requires_grad_()
    soft_margin_loss(descriptors(parts), descriptors(parts), 10.0).backward()
    assert torch.isfinite(parts.grad).all()


def test_soft_margin_losses_are_the_released_ones() -> None:
    released, ours = seeded.arrays("parity_safa"), released_safa.losses()
    for name in ("loss.multi", "loss.single"):
        assert ours[name] == pytest.approx(float(released[name]), rel=1e-5)
    np.testing.assert_allclose(ours["loss.multi.gradient"], released["loss.multi.gradient"], atol=1e-7)


def test_every_method_has_the_loss_it_is_named_after() -> None:
    places = torch.arange(B)
    outputs = {name: (drawn(i, B, 1, 16), drawn(9 + i, B, 1, B)) for i, name in enumerate(("satellite", "drone"))}
    labels = dict.fromkeys(outputs, places)
    tiles, drones = (descriptors(parts.float()) for parts, _ in outputs.values())
    expected = {
        "instance": torch.stack([instance_loss(s.float(), places).sum() for _, s in outputs.values()]).sum(),
        "safa": soft_margin_loss(tiles, drones, 10.0),
    }
    for name, value in expected.items():
        torch.testing.assert_close(total_loss(outputs, labels, method(name, RECIPES["paper"])), value)
    # Four drone pictures of each place: the pool holds them all.
    outputs["drone"] = (drawn(5, 4 * B, 1, 16), drawn(6, 4 * B, 1, B))
    labels["drone"] = places.repeat_interleave(4)
    cosines = tiles @ descriptors(outputs["drone"][0].float()).T
    own = labels["drone"][None, :] == places[:, None]
    p, n = cosines.masked_fill(~own, 2).amin(1), cosines.masked_fill(own, -2).amax(1)
    by_method = {
        "contrastive": ((1 - p) ** 2 + (1 + n) ** 2).sum(),
        "triplet-0.3": F.relu(n + 0.3 - p).sum(),
        "triplet-0.5": F.relu(n + 0.5 - p).sum(),
        "soft-margin": (n - p).exp().log1p().sum(),
    }
    assert len({round(float(value), 3) for value in by_method.values()}) == len(METRIC_LOSSES)
    for name in METRIC_LOSSES:
        for recipe in ("paper", "small", "metric-released"):
            found = total_loss(outputs, labels, method(name, RECIPES[recipe]))
            torch.testing.assert_close(found, by_method[name])


def test_the_hardest_of_a_satellite_s_own_pictures_and_of_a_pool() -> None:
    """Cosines of each satellite with the hardest of its four drone pictures, and with the hardest of others in the pool."""
    b, k = 5, 4
    tiles = descriptors(drawn(1, b, 1, 16))
    drones = descriptors(tiles.repeat_interleave(k, 0)[:, None] + 0.8 * drawn(2, b * k, 1, 16)).unflatten(0, (b, k))
    places = torch.tensor([3, 3, 5, 7, 8])
    pool = torch.randperm(b * k, generator=torch.Generator().manual_seed(3))[:12]
    positive, negative = hardest_scores(tiles, drones, places, pool)
    for i in range(b):
        own = [float(tiles[i] @ drones[i, j]) for j in range(k)]
        # Two satellites show place 3, and they are no negatives of each other.
        wrong = [float(tiles[i] @ drones[n // k, n % k]) for n in pool.tolist() if places[n // k] != places[i]]
        assert float(positive[i]) == pytest.approx(min(own))
        assert float(negative[i]) == pytest.approx(max(wrong))


def test_a_pool_without_another_place_has_no_negative() -> None:
    tiles, drones = descriptors(drawn(1, 2, 1, 8)), descriptors(drawn(2, 8, 1, 8)).unflatten(0, (2, 4))
    _, negative = hardest_scores(tiles, drones, torch.tensor([4, 9]), torch.tensor([0, 1, 3]))
    assert float(negative[0]) == 0
    assert float(negative[1]) == pytest.approx(max(float(tiles[1] @ drones[0, j]) for j in (0, 1, 3)))


def test_the_released_losses_take_the_pictures_of_a_satellite_s_own_place() -> None:
    recipe = replace(method("triplet-0.5", RECIPES["metric-released"]), positives=2, pool=100)
    tiles, drones = drawn(1, 3, 1, 16), drawn(2, 6, 1, 16)
    outputs = {"satellite": (tiles, drawn(3, 3, 1, 3)), "drone": (drones, drawn(4, 6, 1, 3))}
    places = torch.arange(3)
    whole = total_loss(outputs, {"satellite": places, "drone": places.repeat_interleave(2)}, recipe)
    # The drone pictures of the last row show another place, for want of its own: the row is in no pair.
    labels = {"satellite": places, "drone": torch.tensor([0, 0, 1, 1, 0, 0])}
    less = total_loss(outputs, labels, recipe)
    two = {name: (e[: len(e) * 2 // 3], s[: len(s) * 2 // 3]) for name, (e, s) in outputs.items()}
    torch.testing.assert_close(less, total_loss(two, {n: of[: len(of) * 2 // 3] for n, of in labels.items()}, recipe))
    assert float(less) < float(whole)
    # Steps draw pools of their own.
    some = replace(recipe, pool=2)
    labels = {"satellite": places, "drone": places.repeat_interleave(2)}
    assert len({float(total_loss(outputs, labels, some, step=step)) for step in range(9)}) > 1
    assert float(total_loss(outputs, labels, some, step=4)) == float(total_loss(outputs, labels, some, step=4))


class Entry:
    """An entry point of a loss, which is loaded as it is."""

    def __init__(self, loss: object, name: str = "spread") -> None:
        self.loss, self.name, self.value = loss, name, "package:spread"

    def load(self) -> object:
        if isinstance(self.loss, Exception):
            raise self.loss
        return self.loss


def documented(name: str) -> PackageLoss:
    """The loss that docs/training.md shows."""
    page = (Path(__file__).parents[3] / "docs" / "training.md").read_text(encoding="utf-8")
    (code,) = re.findall(r"^    (def spread.*?)\n\n", page, re.MULTILINE | re.DOTALL)
    found: dict[str, PackageLoss] = {}
    exec(code.replace("\n    ", "\n"), found)
    return found[name]


STEP = TrainingStep(
    {"satellite": torch.ones(2, 1, 4), "drone": torch.full((2, 1, 4), 2.0)},
    dict.fromkeys(("satellite", "drone"), torch.zeros(2, 1, 3)),
    dict.fromkeys(("satellite", "drone"), torch.arange(2)),
)


def test_a_loss_of_another_package_is_a_term_with_its_weight(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(losses, "entry_points", lambda group: [Entry(documented("spread"))] * (group == "lpn.losses"))
    recipe = replace(RECIPES["released"], loss="spread", loss_weight=0.5)
    terms = loss_terms(STEP, recipe, losses.open_loss("spread"))
    assert list(terms) == ["instance", "spread"]
    assert float(terms["spread"]) == 0.5
    alone = replace(recipe, instance=0.0)
    assert list(loss_terms(STEP, alone, losses.open_loss("spread"))) == ["spread"]


@pytest.mark.parametrize(
    ("loss", "said"),
    [
        (None, "no loss spread; .* entry point of lpn.losses, which has other; loss, instance, .* names of ours"),
        (ImportError("no module"), r"The loss spread \(package:spread\) cannot be loaded: ImportError: no module."),
        (lambda *_: 1 / 0, "The loss spread failed: ZeroDivisionError: division by zero."),
        (lambda *_: 3.0, "returned a float; expected a tensor with one number."),
        (lambda *_: torch.zeros(2, 3), r"returned a tensor of \(2, 3\); expected"),
    ],
)
def test_a_loss_that_cannot_be_used_is_refused_in_one_sentence(
    monkeypatch: pytest.MonkeyPatch, loss: object, said: str
) -> None:
    points = [Entry(documented("spread"), "other")] if loss is None else [Entry(loss)]
    monkeypatch.setattr(losses, "entry_points", lambda **_: points)
    with pytest.raises(InputError, match=said):
        loss_terms(STEP, replace(RECIPES["released"], loss="spread"), losses.open_loss("spread"))
