from __future__ import annotations

import io
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import lpn
from lpn.core.arrays import UInt8Array
from lpn.drawing import network_figures, plots
from lpn.drawing.network_figures import PictureOfView
from lpn.models.base import Model
from lpn.retrieval import describe_picture
from tools.fixtures import small_worlds


def described(model: Model) -> list[PictureOfView]:
    made = []
    for view in ("drone", "satellite"):
        one = describe_picture(model, small_worlds.place(7), view)
        assert one.activation is not None
        made.append(PictureOfView(view, one.picture, one.activation, one.descriptor))
    return made


def pixels(data: bytes) -> UInt8Array:
    return np.asarray(Image.open(io.BytesIO(data)).convert("RGB"))


def test_the_network_is_drawn_with_a_panel_for_each_part(
    model_file: Path, one_part_model_file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    titles: list[list[str]] = []
    encode = plots.encode
    noted = lambda figure, dpi: (titles.append([cell.get_title() for cell in figure.axes]), encode(figure, dpi))[1]  # noqa: E731
    monkeypatch.setattr(network_figures, "encode", noted)
    widths = {}
    for file in (model_file, one_part_model_file):
        model = lpn.load(file)
        widths[model.n_parts] = pixels(network_figures.network(model, described(model))).shape[:2]
        first, cells, *parts, last = titles[-1][: 3 + model.n_parts]
        rows, columns = model.map_size("drone")
        assert (first, cells) == ("drone: 64 x 64 pixels", f"map: {rows} x {columns} cells")
        assert [title.partition(":")[0] for title in parts] == model.contract.names("drone")
        assert last == f"descriptor: {model.n_parts} x {model.embedding}"
    assert widths == {4: (460, 1470), 1: (460, 840)}


def test_partitions_are_drawn_side_by_side_and_the_model_s_is_named(
    model_file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    titles: list[str] = []
    encode = plots.encode
    noted = lambda figure, dpi: (titles.extend(cell.get_title() for cell in figure.axes), encode(figure, dpi))[1]  # noqa: E731
    monkeypatch.setattr(network_figures, "encode", noted)
    model = lpn.load(model_file)
    drawn = pixels(network_figures.partitions(model, described(model)))
    assert titles[:3] == ["drone, square rings (this model)", "drone, sequential: columns", "drone, sequential: rows"]
    # The three panels show the same picture under other borders.
    thirds = np.array_split(drawn[:230], 3, axis=1)
    assert len({third.tobytes() for third in thirds}) == 3
