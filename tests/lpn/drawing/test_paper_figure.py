"""The figure of a paper: its rows add up, its files are of three kinds, and its letters fit a column."""

from __future__ import annotations

import io
import re
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import lpn
from lpn.core.errors import InputError, LPNError, MissingPackageError
from lpn.drawing.paper_figure import COLUMN, PaperFigure
from tools.fixtures import small_worlds
from tools.fixtures.small_contracts import RegionModel

MM = 1 / 25.4


@pytest.fixture(scope="module")
def answer(data: Path, model_file: Path) -> lpn.Answer:
    gallery = lpn.Gallery.of_folder(data / "test" / "gallery_satellite", model_file)
    return gallery.search(small_worlds.place(9), weights=[1, 2, 1, 0], view="drone")


@pytest.fixture(scope="module")
def figure(answer: lpn.Answer) -> PaperFigure:
    return answer.paper_figure(true="0009/0009.png", wrong=3)


def test_rows_are_the_shares_of_the_answer_and_the_lead_adds_up(answer: lpn.Answer, figure: PaperFigure) -> None:
    query, true, wrong = figure.rows
    names = [match.name for match in answer.top(14)]
    first, second = answer.evidence(names.index("0009/0009.png") + 1), answer.evidence(3)
    assert [row.title[0] for row in figure.rows] == ["Query", "True tile", "Wrong tile"]
    assert wrong.title[1] == "rank 3"
    for row, evidence in ((true, first), (wrong, second)):
        assert row.shares.sum() == pytest.approx(evidence.distance2, abs=1e-5)
        assert row.heat.sum() + evidence.tile.constants @ evidence.weights == pytest.approx(evidence.score, abs=1e-5)
    assert query.shares.sum() == pytest.approx(second.distance2 - first.distance2, abs=1e-5)
    constants = 2 * (first.query.constants - second.query.constants) * first.weights
    np.testing.assert_allclose(query.heat.sum(axis=(1, 2)) + constants, query.shares, atol=1e-5)


def test_a_png_has_300_dpi_and_the_width_of_a_page_or_a_column(figure: PaperFigure) -> None:
    for drawn in (figure, replace(figure, width=COLUMN)):
        picture = Image.open(io.BytesIO(drawn.encode("png")))
        assert picture.info["dpi"] == pytest.approx((300, 300), abs=0.01)
        assert picture.width == pytest.approx(300 * drawn.width * MM, abs=1)
        edge = np.asarray(picture.convert("L"))
        assert (edge[[0, -1]] == 255).all(), "nothing is cut off above or below"
        assert (edge[:, [0, -1]] == 255).all(), "nothing is cut off at a side"
    assert figure._repr_png_() == figure.encode("png"), "equal figures give equal files"


def test_texts_of_an_svg_are_texts_and_a_page_has_a_map_of_each_ring(figure: PaperFigure) -> None:
    page, column = (replace(figure, width=width).encode("svg").decode() for width in (180, 88))
    texts = [re.findall(r"<text[^>]*>([^<]*)</text>", one) for one in (page, column)]
    assert {"Query", "True tile", "Wrong tile", "ring 1 centre", "ring 2", "ring 3", "ring 4 outer"} <= set(texts[0])
    assert "heat of the rings" in texts[1]
    assert (page.count("<image"), column.count("<image")) == (3 * 5 + 1, 3 * 2 + 1)
    assert f'width="{180 * MM * 72:.6f}'[:12] in page
    assert all(
        float(size) >= 7 for one in (page, column) for size in re.findall(r"font(?:-size)?: ?(?:bold )?([\d.]+)px", one)
    )
    assert page == figure.encode("svg").decode(), "equal figures give equal files"


def test_a_pdf_is_of_lines_and_letters(figure: PaperFigure, tmp_path: Path) -> None:
    figure.save(tmp_path / "deep" / "figure.pdf")
    data = (tmp_path / "deep" / "figure.pdf").read_bytes()
    assert data.startswith(b"%PDF")
    assert b"/CIDFontType2" in data
    box = re.search(rb"/MediaBox \[ ?0 0 ([\d.]+) ([\d.]+) ?\]", data)
    assert float(box[1]) == pytest.approx(180 * MM * 72, abs=0.1)
    assert b"CreationDate" not in data


def test_by_default_the_truth_chooses_the_tiles(answer: lpn.Answer) -> None:
    relevant = np.zeros(14, bool)
    relevant[answer.ranking.order[4]] = True
    known = replace(answer, ranking=replace(answer.ranking, relevant=relevant))
    assert [row.title for row in known.paper_figure().rows[1:]] == [("True tile", "rank 5"), ("Wrong tile", "rank 1")]
    told = known.paper_figure(true=1, wrong=5).rows[1:]  # a known truth overrides the requested one
    assert [row.title for row in told] == [("Wrong tile", "rank 1"), ("True tile", "rank 5")]
    assert [row.title for row in answer.paper_figure().rows[1:]] == [("Tile", "rank 1"), ("Tile", "rank 2")]
    rows = answer.paper_figure(wrong=1).rows[1:]
    assert [row.title for row in rows] == [("Tile", "rank 2"), ("Wrong tile", "rank 1")]
    lone = replace(answer, ranking=replace(answer.ranking, order=answer.ranking.order[:1]))
    alone = lone.paper_figure(true=1)
    assert [row.title[0] for row in alone.rows] == ["Query", "True tile"]
    assert alone.rows[0].shares is None
    assert alone.encode("svg").count(b"<image") == 2 * 5 + 1


def test_parts_of_any_shape_are_drawn(data: Path) -> None:
    gallery = lpn.Gallery.of_folder(data / "test" / "gallery_satellite", RegionModel())
    figure = gallery.search(small_worlds.place(9)).paper_figure()
    assert not figure.rows[0].areas.straight
    assert Image.open(io.BytesIO(figure.encode("png"))).width == pytest.approx(300 * 180 * MM, abs=1)


def test_what_cannot_be_drawn_is_refused_in_one_sentence(
    answer: lpn.Answer, figure: PaperFigure, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    refused: dict[str, dict[str, object]] = {
        "There is no tile nowhere.png; give a rank, or a name such as": {"true": "nowhere.png"},
        "There is no rank 15; the gallery has ranks 1 to 14": {"wrong": 15},
        "The true and the wrong tile are one": {"true": 2, "wrong": 2},
        "The figure is 20 mm wide; expected 60 to 400 mm": {"width": 20},
    }
    for message, given in refused.items():
        with pytest.raises(InputError, match=message):
            answer.paper_figure(**given)
    with pytest.raises(LPNError, match=r"ends in \.png, \.svg, or \.pdf"):
        figure.save(tmp_path / "figure.jpg")
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    with pytest.raises(MissingPackageError, match="needs the package matplotlib"):
        figure.save(tmp_path / "figure.png")
    assert not list(tmp_path.iterdir())
