"""The contract of a model: levels, what it refuses, and evidence of models whose maps, cells, and constants differ by picture."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from lpn import retrieval
from lpn.core import images
from lpn.core.errors import InputError, ModelFileError
from lpn.core.images import normalise
from lpn.core.views import View
from lpn.drawing import overlays, verdicts
from lpn.drawing.part_areas import PartAreas
from lpn.drawing.theme import part_colour
from lpn.models.base import Model
from lpn.models.contract import Contract, check_pass
from lpn.models.spec import ModelSpec
from lpn.models.trace import Trace
from lpn.retrieval import DescribedPicture
from tools.fixtures.small_contracts import GATES, REGIONS, GateModel, PartsModel, RegionModel


def described(model: Model, view: View = "drone", seed: int = 0) -> DescribedPicture:
    picture = np.random.default_rng(seed).integers(0, 256, (60, 80, 3)).astype(np.uint8)
    return retrieval.describe_picture(model, picture, view)


def trace_of(model: Model, view: View = "drone", seed: int = 0) -> Trace:
    trace = described(model, view, seed).trace
    assert trace is not None
    return trace


def test_names_of_parts_hold_no_control_characters() -> None:
    contract = replace(REGIONS, part_names={"drone": ("1\x1b[2J", "2\u202e", "3", "4")})
    assert contract.names("drone") == ["1?[2J", "2?", "3", "4"]


def test_an_account_that_does_not_add_up_has_no_closure() -> None:
    trace = trace_of(RegionModel())
    assert replace(trace, constants=trace.constants + 0.01).errors().max() > 1e-3


def test_the_mirror_s_regions_are_its_own_and_are_flipped_back() -> None:
    trace = trace_of(RegionModel())
    assert trace.cells.shape == (2, 4, 8, 8)
    # Brightness is the same in the mirror, so that the regions are, once flipped back.
    np.testing.assert_array_equal(trace.cells[0], trace.cells[1])
    assert trace_of(GateModel()).cells.shape == (1, 3, 8, 8)


def test_a_part_without_cells_is_a_lump_and_has_no_area() -> None:
    trace = trace_of(RegionModel())
    areas = PartAreas.of(REGIONS, "drone", (8, 8), trace)
    assert areas.lumps == [3]
    assert not areas.straight
    assert sorted(np.unique(areas.labels).tolist()) == [0, 1, 2]
    np.testing.assert_array_equal(areas.inside[1], trace.cells[0, 1] > 0)
    assert areas.boxes[3] == (0, 0, 1, 1)
    grey = np.full((160, 160, 3), 100, np.uint8)
    drawn = overlays.with_parts(grey, areas)
    for part in range(4):
        coloured = (drawn == part_colour(part)).all(axis=2)
        assert coloured.any() == (part != 3)
        assert not (coloured & ~images.enlarge(areas.inside[part], 160, 160)).any()
    np.testing.assert_array_equal(overlays.with_parts(grey, None), grey)


def test_a_part_s_activation_is_of_its_own_map() -> None:
    shared, own = trace_of(RegionModel()), trace_of(GateModel())
    np.testing.assert_allclose(shared.activation, shared.features[0].sum(axis=0), rtol=1e-5)
    np.testing.assert_allclose(own.activation, own.features[0].sum(axis=(0, 1)), rtol=1e-5)


def test_cells_that_parts_weigh_alike_are_no_part_s() -> None:
    areas = PartAreas.of(GATES, "drone", (8, 8), trace_of(GateModel()))
    assert (areas.labels == -1).all()
    assert areas.inside.all()
    assert PartAreas.of(GATES, "drone", (8, 8), None) is None


@pytest.mark.parametrize(
    ("model", "claim"),
    [
        (RegionModel(), "exact, with the regions of each picture held"),
        (PartsModel(RegionModel()), "parts only: the model gives no cells"),
        (PartsModel(RegionModel(), one=True), "one vector"),
    ],
)
def test_the_level_is_named_and_a_model_without_cells_has_no_trace(model: Model, claim: str) -> None:
    assert model.contract.claim == claim
    found = described(model)
    assert (found.trace is not None) == model.contract.has_cells == (found.activation is not None)
    assert np.linalg.norm(found.descriptor) == pytest.approx(1, abs=1e-6)
    image = model.prepare(found.picture, "drone")[None]
    np.testing.assert_allclose(model.descriptors(image, "drone")[0], found.descriptor, atol=1e-6)
    if not model.contract.has_cells:
        assert claim in verdicts.no_cells(model.contract)
        with pytest.raises(InputError, match="no evidence to compute"):
            Trace.from_pass(model, model.run(image, "drone"), "drone")


def test_an_lpn_goes_through_the_contract() -> None:
    spec = ModelSpec("resnet18", activation="relu", n_parts=2)
    assert spec.contract().claim == "exact, with the slopes of the activation held"
    safa = replace(spec, activation="none", pooling="safa", polar=True).contract()
    assert (safa.mirror, safa.unrolled("satellite"), safa.unrolled("drone")) == ("none", True, False)
    assert replace(spec, activation="none").contract().names("drone") == ["1 centre", "2 outer"]


def test_a_picture_is_prepared_as_the_contract_says() -> None:
    model = GateModel()
    picture = np.random.default_rng(0).integers(0, 256, (128, 128, 3)).astype(np.uint8)
    prepared = model.prepare(picture, "drone")
    # Bilinear without anti-aliasing: a pixel of half the size is the mean of the four around its middle.
    four = picture.reshape(64, 2, 64, 2, 3).astype(float).mean(axis=(1, 3))
    np.testing.assert_allclose(prepared, (np.floor(four + 0.5) / 255 - 0.5).transpose(2, 0, 1) / 0.5, atol=1e-5)
    np.testing.assert_allclose(normalise(picture)[1, 3, 4], (picture[3, 4, 1] / 255 - 0.456) / 0.224, rtol=1e-5)


def test_branches_by_role_follow_the_task() -> None:
    model = GateModel(replace(GATES, roles="role", groups=()))
    image = model.prepare(np.random.default_rng(0).integers(0, 256, (64, 64, 3)).astype(np.uint8), "drone")[None]
    as_query, as_gallery = model.run(image, "drone").parts, model.run(image, "satellite").parts
    assert not np.allclose(as_query, as_gallery)
    forth, back = model.for_task("drone", "satellite"), model.for_task("satellite", "drone")
    np.testing.assert_array_equal(forth.run(image, "drone").parts, as_query)
    np.testing.assert_array_equal(back.run(image, "drone").parts, as_gallery)
    np.testing.assert_array_equal(back.run(image, "satellite").parts, as_query)
    # Descriptors of the two tasks are not comparable, and have separate entries in the cache.
    assert forth.fingerprint == model.fingerprint != back.fingerprint
    with pytest.raises(InputError, match="both of one view, drone"):
        model.for_task("drone", "drone")
    assert GateModel().for_task("satellite", "drone").fingerprint == GateModel().fingerprint


def test_the_fingerprint_of_a_model_without_a_file_is_that_of_its_answers() -> None:
    assert RegionModel().fingerprint == RegionModel().fingerprint != RegionModel(seed=3).fingerprint


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"parts": np.zeros((1, 4, 7))}, "parts of shape 1 x 4 x 7; by its contract of 4 parts of 5 numbers.* 1 x 4 x 5"),
        ({"features": None}, "returns no features, but its contract says 'exact, with the regions"),
        ({"features": np.zeros((1, 9, 8, 8))}, "weight of shape 4 x 5 x 6; .* 4 x 5 x 9"),
        ({"features": np.zeros((1, 2, 6, 8, 8))}, "features of shape 1 x 2 x 6 x 8 x 8; .* 1 x 4 x 6 x 8 x 8"),
        ({"cells": np.zeros((1, 4, 8, 7))}, "cells of shape 1 x 4 x 8 x 7; .* 1 x 4 x 8 x 8"),
        ({"constants": np.zeros((4, 5))}, "constants of shape 4 x 5; .* 1 x 4 x 5"),
        ({"cells": None}, "a map of 8 x 8 cells without the part of each cell"),
    ],
)  # fmt: skip
def test_shapes_that_contradict_the_contract_are_refused_with_the_shapes(change: dict[str, Any], message: str) -> None:
    model = RegionModel()
    whole = model.run(np.zeros((1, 3, 64, 64), np.float32), "drone")
    with pytest.raises(ModelFileError, match=message):
        Trace.from_pass(model, whole._replace(**change), "drone")
    check_pass(model.contract, whole, model.heads("drone"))
    heads = replace(model.heads("drone"), cells=np.zeros((3, 8, 7), np.float32))
    model.heads = lambda _: heads
    with pytest.raises(ModelFileError, match=r"the heads' cells of shape 3 x 8 x 7; .* 4 x 8 x 8"):
        Trace.from_pass(model, whole._replace(cells=None), "drone")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"views": ()}, "one to three of"),
        ({"level": "exactly"}, "level is 'exactly'; expected one of exact,"),
        ({"held": ""}, "name what is held"),
        ({"level": "one vector", "held": ""}, "with 4 parts; one of both is wrong"),
        ({"part_names": {"drone": ["1"]}}, "The drone has 1 names of parts; expected 4"),
        ({"groups": (("drone",),)}, "do not hold each of the views"),
        ({"n_parts": 0}, "parts is 0; expected a whole number from 1 to 256"),
        ({"roles": "role"}, "groups 'satellite drone'; one branch .* two groups of one view each"),
        ({"roles": "role", "views": ("drone",), "groups": (), "part_names": {}}, "its groups 'drone'; one branch"),
        ({"std": (1.0, 1e-300, 1.0)}, "std above 0, from 0.0001 to 10000"),
        ({"mean": (1e39, 0.0, 0.0)}, "the mean from -1000 to 1000"),
        ({"mean": (0.0, float("nan"), 0.0)}, "expected three numbers each"),
        ({"resize": "nearest"}, "resize is 'nearest'; expected one of bicubic, linear, area"),
        ({"partitions": {"drone": ModelSpec().partition("drone")}, "n_parts": 3, "part_names": {}}, "has 4 parts; expected 3"),
    ],
)  # fmt: skip
def test_a_contract_that_contradicts_itself_is_refused(change: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        replace(REGIONS, **change)
    assert isinstance(REGIONS, Contract)
