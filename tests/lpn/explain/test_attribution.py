"""Exact evidence: that it adds up, on every kind of model, and belongs to the pair and the trained network."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

import lpn
from lpn import explain, retrieval
from lpn.core.arrays import Float32Array
from lpn.core.errors import InputError
from lpn.core.views import View
from lpn.models.base import Model
from lpn.models.checkpoints import TorchModel
from lpn.models.lpn import LPN
from lpn.models.onnx_engine import Engine
from lpn.models.spec import ModelSpec
from lpn.retrieval import DescribedPicture, scoring
from tools.fixtures.small_contracts import GateModel, RegionModel

SPECS = {
    "rings": ModelSpec("resnet18", "layer3", n_parts=4, embedding=24, classes=5, input_size=(64, 64)),
    # A map of 4 x 4 is resized before it is cut into eight rings.
    "resized": ModelSpec("resnet18", "layer3", n_parts=8, embedding=24, classes=5, input_size=(64, 64)),
    "rings and rows": ModelSpec(
        "vgg16_bn", views=("satellite", "street"), shared=False, layout="cvusa", n_parts=4, embedding=24, classes=5,
        input_size=(64, 64),
    ),
    "columns": ModelSpec(
        "resnet18", "layer3", views=("satellite", "street"), shared=False, layout="strips", n_parts=3, embedding=24,
        classes=5, input_size=(64, 128),
    ),
    "safa": ModelSpec(
        "resnet18", "layer3", views=("satellite", "street"), shared=False, n_parts=3, maps=2, embedding=2 * 256,
        input_size=(48, 128), pooling="safa", polar=True,
    ),
    # A map of 2 x 5, whose last row and column reach beyond the picture.
    "safa-lpn": ModelSpec(
        "vgg16", views=("satellite", "street"), shared=False, n_parts=3, maps=1, embedding=512,
        input_size=(48, 136), pooling="safa", polar=True,
    ),
}  # fmt: skip
SPECS |= {name: replace(SPECS["rings"], activation=name) for name in ("leaky_relu", "relu")}
# Models whose cells, maps, and constants differ by picture.
OWN_CELLS: dict[str, Model] = {"regions": RegionModel(), "gates": GateModel()}


def opened(name: str) -> Model:
    return OWN_CELLS[name] if name in OWN_CELLS else TorchModel(network(SPECS[name]))


def network(spec: ModelSpec, seed: int = 0) -> LPN:
    """A network whose norms have seen something: untrained ones have heads without constants."""
    torch.manual_seed(seed)
    made = LPN(spec)
    for module in made.modules():
        if isinstance(module, torch.nn.BatchNorm1d):
            module.running_mean = 0.3 * torch.randn_like(module.weight)
            module.bias.data = 0.3 * torch.randn_like(module.weight)
    return made


def pair(model: Model, seed: int = 1) -> tuple[DescribedPicture, DescribedPicture]:
    """A query and a tile of noise and shapes, described."""
    rng = np.random.default_rng(seed)
    query_view: View = "drone" if "drone" in model.views else "street"
    pictures = [rng.integers(0, 256, (60, 80, 3)).astype(np.uint8) for _ in range(2)]
    return (
        retrieval.describe_picture(model, pictures[0], query_view),
        retrieval.describe_picture(model, pictures[1], "satellite"),
    )


def evidence(one: DescribedPicture, other: DescribedPicture, weights: Float32Array | None = None) -> explain.Evidence:
    return explain.evidence(one.trace, other.trace, weights)


@pytest.mark.parametrize("name", [*SPECS, *OWN_CELLS])
def test_cells_and_constants_add_up_to_each_cosine_on_both_sides(name: str) -> None:
    model = opened(name)
    query, tile = pair(model)
    n = model.n_parts
    weights = scoring.part_weights(n, 1.0 + np.arange(n))
    found = evidence(query, tile, weights)
    cosines = scoring.part_cosines(query.descriptor, tile.descriptor[None])[0]
    np.testing.assert_allclose(found.cosines, cosines, atol=1e-5)
    for side in (found.query, found.tile):
        np.testing.assert_allclose(side.cells.sum(axis=(1, 2)) + side.constants, cosines, atol=1e-5)
    spread = explain.spread_constants(found.query, query.trace)
    with_cells = query.trace.cells.any(axis=(0, 2, 3))
    np.testing.assert_allclose(spread.sum(axis=(1, 2)), cosines * with_cells, atol=1e-5)
    assert not spread[(query.trace.cells == 0).all(axis=0)].any(), "a cell outside a part has no share of it"
    lead = explain.lead_cells(query.trace, found.weights, tile.descriptor, -tile.descriptor)
    assert lead.sum() == pytest.approx(4 * float(found.weights @ (found.cosines * with_cells)), abs=1e-4), (
        "d² of one less that of the other"
    )
    assert found.score == pytest.approx(float(cosines @ weights), abs=1e-5)
    assert found.query.score_map(weights).sum() + found.query.constants @ weights == pytest.approx(
        found.score, abs=1e-5
    )
    if name in SPECS and SPECS[name].pooling == "average":
        # The constants are computed apart from the cells, not as the remainder of the sum.
        assert np.abs(found.query.constants).max() > 1e-3


@pytest.mark.parametrize("whiten", [False, True])
@pytest.mark.parametrize("name", ["leaky_relu", "safa"])
def test_the_mean_of_a_view_is_one_more_constant_and_whitening_goes_through_the_cells(name: str, whiten: bool) -> None:
    plain = TorchModel(network(SPECS[name]), "fingerprint")
    rng = np.random.default_rng(5)
    shape = (plain.n_parts, plain.embedding)
    query_view: View = "drone" if "drone" in plain.views else "street"
    means: dict[View, Float32Array] = {
        "satellite": (0.02 * rng.standard_normal(shape)).astype(np.float32),
        query_view: (0.02 * rng.standard_normal(shape)).astype(np.float32),
    }
    matrices = None
    if whiten:
        matrices = rng.standard_normal((*shape, shape[1])).astype(np.float32)
    model = plain.centred(means, matrices)
    assert len({model.fingerprint, plain.fingerprint, plain.centred(means).fingerprint}) == (3 if whiten else 2)
    assert not plain.means
    held = plain.contract.held
    assert model.contract.claim == f"exact, with {f'{held} and ' if held else ''}the length of the mean's term held"
    query, tile = pair(model)
    before, _ = pair(plain)
    moved = before.descriptor - means[query_view]
    if matrices is not None:
        moved = np.stack([matrix @ part for matrix, part in zip(matrices, moved, strict=True)])
    expected = moved / np.linalg.norm(moved, axis=1, keepdims=True) / np.sqrt(plain.n_parts)
    np.testing.assert_allclose(query.descriptor, expected, atol=1e-6)
    image = model.prepare(before.picture, query_view)[None]
    np.testing.assert_allclose(model.descriptors(image, query_view)[0], expected, atol=1e-5)
    found = evidence(query, tile)
    cosines = scoring.part_cosines(query.descriptor, tile.descriptor[None])[0]
    for side in (found.query, found.tile):
        np.testing.assert_allclose(side.cells.sum(axis=(1, 2)) + side.constants, cosines, atol=1e-4)
    assert query.trace.errors().max() < 1e-4
    if whiten:
        # Cells have their share of the whitened embedding, rather than the constant.
        other = tile.descriptor.astype(np.float64) / np.linalg.norm(tile.descriptor, axis=1, keepdims=True)
        norms = np.linalg.norm(query.trace.embedding, axis=1)
        for part in range(model.n_parts):
            cells = query.trace.vectors(part) @ other[part] / norms[part]
            np.testing.assert_allclose(found.query.cells[part].ravel(), cells, atol=1e-4)
    assert not np.allclose(cosines, evidence(*pair(plain)).cosines, atol=1e-3)


@pytest.mark.parametrize("name", ["rings", "leaky_relu", "relu", "columns", "safa", *OWN_CELLS])
def test_links_add_up_to_each_cell_and_turn_around_with_the_pair(name: str) -> None:
    model = opened(name)
    query, tile = pair(model)
    found, turned = evidence(query, tile), evidence(tile, query)
    np.testing.assert_allclose(found.query.cells, turned.tile.cells, atol=1e-6)
    np.testing.assert_allclose(found.tile.constants, turned.query.constants, atol=1e-6)
    for part in range(model.n_parts):
        shared = explain.cell_similarities(query.trace, tile.trace, part)
        np.testing.assert_allclose(shared, explain.cell_similarities(tile.trace, query.trace, part).T, atol=1e-6)
        # The share of a query's cell with the tile's constant belongs to no cell of the tile.
        constant = tile.trace.embedding[part] - tile.trace.vectors(part).sum(axis=0)
        norms = np.linalg.norm(query.trace.embedding[part]) * np.linalg.norm(tile.trace.embedding[part])
        rest = query.trace.vectors(part) @ constant / norms
        np.testing.assert_allclose(shared.sum(axis=1) + rest, found.query.cells[part].reshape(-1), atol=1e-5)


def test_a_counterpart_is_the_other_picture_s_cell_of_the_same_part_that_agrees_most() -> None:
    model = TorchModel(network(replace(SPECS["rings"], n_parts=2)))
    query, tile = pair(model)
    labels = model.spec.partition("drone").labels(4, 4).reshape(-1)
    weights = scoring.part_weights(2, [1, 3])
    forth, back = explain.correspondences(query.trace, tile.trace, weights)
    for cell in range(16):
        part = labels[cell]
        shared = explain.cell_similarities(query.trace, tile.trace, part) * weights[part]
        assert labels[forth.cells[cell]] == labels[back.cells[cell]] == part
        assert forth.terms[cell] == pytest.approx(shared[cell, labels == part].max())
        assert back.terms[cell] == pytest.approx(shared[labels == part, cell].max())
        assert forth.terms[cell] == pytest.approx(shared[cell, forth.cells[cell]])
    forth, _ = explain.correspondences(query.trace, tile.trace, scoring.part_weights(2, [0, 1]))
    np.testing.assert_array_equal(forth.cells == -1, labels == 0)


@pytest.mark.parametrize("name", ["rings", "leaky_relu", "relu", "safa", *OWN_CELLS])
def test_a_region_s_search_orders_by_what_its_cells_add_to_each_score(name: str) -> None:
    model = opened(name)
    query, _ = pair(model)
    rng = np.random.default_rng(3)
    painted = np.zeros(query.trace.size, bool)
    painted[1:3, 0:3] = True
    n = model.n_parts
    weights = scoring.part_weights(n, 1 + np.arange(n))
    region = query.trace.region(painted, weights)
    lengths = n * (region**2).sum(axis=1)
    assert lengths @ weights == pytest.approx(1.0, abs=1e-5)
    gallery = rng.normal(size=(6, *region.shape)).astype(np.float32)
    gallery /= np.linalg.norm(gallery, axis=2, keepdims=True) * np.sqrt(n)
    added = [explain.side_evidence(query.trace, tile).score_map(weights)[painted].sum() for tile in gallery]
    products = scoring.part_cosines(region, gallery)
    scores = products @ weights
    np.testing.assert_allclose(scores / scores[0], np.array(added) / added[0], rtol=1e-3)
    # The shares of the distance add up, and none is negative as it would be if these were cosines.
    shares = scoring.contributions(products, weights, lengths)
    np.testing.assert_allclose(shares.sum(axis=1), 2 - 2 * scores, atol=1e-5)
    assert shares.min() >= -1e-6
    with pytest.raises(InputError, match="No cell of a part that counts"):
        query.trace.region(np.zeros(query.trace.size, bool), weights)
    with pytest.raises(InputError, match="the feature map has"):
        query.trace.region(np.ones((2, 2), bool), weights)


def test_mirrored_pictures_have_mirrored_evidence() -> None:
    model = TorchModel(network(SPECS["rings"]))
    query, tile = pair(model)
    mirrored = retrieval.describe_picture(model, np.ascontiguousarray(query.picture[:, ::-1]), "drone")
    np.testing.assert_allclose(mirrored.descriptor, query.descriptor, atol=1e-5)
    np.testing.assert_allclose(
        evidence(mirrored, tile).query.cells[..., ::-1], evidence(query, tile).query.cells, atol=1e-5
    )


def test_a_part_whose_relu_passes_nothing_adds_nothing() -> None:
    made = network(SPECS["relu"])
    made.heads[1].add_block[1].bias.data -= 100
    query, tile = pair(TorchModel(made))
    found = evidence(query, tile)
    assert found.cosines[1] == 0
    assert not found.query.cells[1].any()
    assert found.query.constants[1] == 0
    assert not explain.cell_similarities(query.trace, tile.trace, 1).any()


def test_an_exported_model_accounts_without_torch_s_model(relu_file: Path, int8_file: Path) -> None:
    for file in (relu_file, int8_file):
        found = evidence(*pair(Engine(file)))
        assert found.query.constants.any() == (file is relu_file)
        np.testing.assert_allclose(found.query.cells.sum(axis=(1, 2)) + found.query.constants, found.cosines, atol=1e-5)
    found, original = (evidence(*pair(lpn.load(relu_file.with_suffix(end)))) for end in (".onnx", ".safetensors"))
    np.testing.assert_allclose(found.query.cells, original.query.cells, atol=1e-4)


def test_two_models_are_not_compared() -> None:
    spec = SPECS["rings"]
    query, _ = pair(TorchModel(network(spec)))
    _, tile = pair(TorchModel(network(replace(spec, embedding=16))))
    with pytest.raises(InputError, match="describe both with one model"):
        evidence(query, tile)
