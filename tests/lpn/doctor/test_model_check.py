"""lpn doctor --model: the level, its proof on pictures, and counter-examples."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from lpn.cli import main
from lpn.core.arrays import Float32Array
from lpn.core.demo import DEMO
from lpn.core.views import View
from lpn.doctor.model_check import check_model, noise
from lpn.models.base import Model
from lpn.models.contract import ForwardPass
from tools.fixtures.small_contracts import GateModel, PartsModel, RegionModel


def test_every_level_says_what_it_proves() -> None:
    pictures = {"drone": noise(), "street": noise()}
    regions = list(check_model(RegionModel(), pictures))
    assert [finding.view for finding in regions] == ["drone"]
    assert regions[0].healthy
    assert regions[0].error < 1e-6
    assert "on 2 pictures" in regions[0].message
    assert "No cell belongs to part 4 whole picture; it is a constant of each picture." in regions[0].message
    gates = next(check_model(GateModel(), {"satellite": noise()}))
    assert gates.healthy
    assert "No cell" not in gates.message
    parts = next(check_model(PartsModel(GateModel()), {"drone": noise()}))
    assert (parts.healthy, parts.error) == (True, None)
    assert parts.message == "It gives 3 x 6 numbers on 2 pictures, and no cells to prove."


def test_what_breaks_the_account_is_named() -> None:
    class Forgets(RegionModel):
        def run(self, images: Float32Array, view: View) -> ForwardPass:
            found = super().run(images, view)
            parts = found.parts.copy()
            parts[:, 1] *= np.float32(1.01)
            return found._replace(parts=parts)

    class Lies(RegionModel):
        def run(self, images: Float32Array, view: View) -> ForwardPass:
            found = super().run(images, view)
            return found._replace(cells=None if found.cells is None else found.cells[:, :3])

    forgets = next(check_model(Forgets(), {"drone": noise()}))
    assert not forgets.healthy
    assert "add up to part 2: the error is 0.0" in forgets.message
    assert "a picture of squares" in forgets.message
    lies = next(check_model(Lies(), {"drone": noise()}))
    assert not lies.healthy
    assert "cells of shape 2 x 3 x 8 x 8; " in lies.message
    assert "they are 2 x 4 x 8 x 8" in lies.message


def changed(model: Model, **changes: Callable[[Float32Array], Float32Array]) -> Model:
    """Return a model whose outputs are changed in place of its own."""
    plain = model.run

    def run(images: Float32Array, view: View) -> ForwardPass:
        found = plain(images, view)
        return found._replace(**{name: change(getattr(found, name).copy()) for name, change in changes.items()})

    model.run = run
    return model


@pytest.mark.parametrize("name", ["features", "cells", "constants"])
def test_values_that_are_not_finite_prove_nothing(name: str) -> None:
    def spoil(values: Float32Array) -> Float32Array:
        values[0, 0].flat[-1] = np.nan
        return values

    found = next(check_model(changed(RegionModel(), **{name: spoil}), {"drone": noise()}))
    assert (found.healthy, found.error) == (False, None)
    assert f"Regions gives {name} with values that are not finite" in found.message


def test_a_sum_that_overflows_proves_nothing() -> None:
    def huge(values: Float32Array) -> Float32Array:
        return np.where(values > 0, np.float32(3e38), values)

    found = next(check_model(changed(RegionModel(), cells=huge), {"drone": noise()}))
    assert (found.healthy, found.error) == (False, None)
    assert "is no finite number on a picture of squares" in found.message


def test_a_small_part_is_proved_on_its_own_scale() -> None:
    def small(share: float) -> Callable[[Float32Array], Float32Array]:
        factors = np.float32([1, share, 1]).reshape(3, 1)
        return lambda values: values * factors.reshape(-1, *[1] * (values.ndim - 2))

    kept = changed(GateModel(), parts=small(1e-6), features=small(1e-6))
    assert next(check_model(kept, {"drone": noise()})).healthy
    lies = changed(GateModel(), parts=small(1e-6), features=small(-3e-6))
    found = next(check_model(lies, {"drone": noise()}))
    assert not found.healthy
    assert "add up to part 2: the error is 4 of its largest value" in found.message


@pytest.mark.parametrize(
    ("model", "differing"), [(RegionModel(), "cells"), (GateModel(), "constants")], ids=["cells", "constants"]
)
def test_what_is_chosen_for_each_picture_is_not_exact(model: Model, differing: str) -> None:
    model.contract = replace(model.contract, level="exact", held="")
    squares = noise()
    # One picture of a view is compared with another, too.
    for pictures in (squares, squares[1:]):
        found = next(check_model(model, {"drone": pictures}))
        assert (found.healthy, found.error) == (False, None)
        assert found.message.startswith(f"The {differing} of a picture of squares ")
        assert "add that quantity to the contract's 'held'" in found.message


def test_the_demo_s_model_is_proved_on_its_pictures(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "model.json"
    assert main.main(["doctor", "--model", str(DEMO / "lpn.onnx"), "--data", str(DEMO), "--json", str(out)]) == 0
    said = capsys.readouterr().out
    assert "Level: exact.\n" in said
    assert "drone: Cells and constants add up to each part on 4 pictures" in said
    written = json.loads(out.read_text())
    assert written["level"] == "exact"
    assert [view["view"] for view in written["views"]] == ["satellite", "drone"]
    assert all(0 < view["error"] < 1e-5 for view in written["views"])
