"""lpn doctor --model: the level, its proof on pictures, and what breaks it."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from lpn.cli import main
from lpn.core.arrays import Float32Array
from lpn.core.demo import DEMO
from lpn.core.views import View
from lpn.doctor.model_check import check_model, noise
from lpn.models.contract import ForwardPass
from tools.fixtures.small_contracts import GateModel, PartsModel, RegionModel


def test_every_level_says_what_it_proves() -> None:
    pictures = {"drone": noise(), "street": noise()}
    regions = list(check_model(RegionModel(), pictures))  # type: ignore[arg-type]
    assert [finding.view for finding in regions] == ["drone"]
    assert regions[0].healthy
    assert regions[0].error is not None
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
    assert "of part 2 miss it by 0.0" in forgets.message
    assert "a picture of squares" in forgets.message
    lies = next(check_model(Lies(), {"drone": noise()}))
    assert not lies.healthy
    assert "cells of shape 2 x 3 x 8 x 8; " in lies.message
    assert "they are 2 x 4 x 8 x 8" in lies.message


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
