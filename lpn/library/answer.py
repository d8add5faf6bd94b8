"""The answer to one query, the object that the app, reports, stories, notebooks, and JSON render."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Literal, Self

import numpy as np
from markupsafe import Markup

from lpn import explain
from lpn.core import images
from lpn.core.arrays import Float32Array, Float64Array, UInt8Array
from lpn.core.errors import InputError
from lpn.core.files import check_ending, printable, write_atomic
from lpn.core.notebook_html import table
from lpn.drawing import overlays, pair_figure, theme, verdicts
from lpn.drawing.paper_figure import PAGE, FigureRow, PaperFigure
from lpn.drawing.part_areas import PartAreas
from lpn.drawing.theme import DARK
from lpn.explain import Correspondences, Evidence
from lpn.retrieval import DescribedPicture, Match, Ranking
from lpn.tasks import verdict
from lpn.tasks.task import Task
from lpn.tasks.verdict import Verdict

# Matches in a notebook.
SHOWN = 5
_THUMBNAIL = 96
# Notebooks are light or dark, but the colours of parts need dark ground.
_GROUND = theme.css(DARK.background)
_SIGNS = {True: "✓ ", False: "✗ ", None: ""}


@dataclass(frozen=True)
class NamedMatch(Match):
    """A match with the name of its picture: its path below the gallery's folder."""

    name: str = ""


@dataclass(frozen=True, eq=False)
class PairPicture:
    """A drawn figure; a notebook shows it.

    Attributes:
        pixels: (H, W, 3) uint8 RGB.
    """

    pixels: UInt8Array

    def save(self, path: str | Path) -> None:
        """Write the figure as a PNG file, folders included.

        Raises:
            InputError: if the name does not end in .png.
            OutputError: if the file cannot be written.
        """
        path = Path(path)
        check_ending(path, ".png")
        write_atomic(path, self._repr_png_())

    def _repr_png_(self) -> bytes:
        return pair_figure.encode(self.pixels)


@dataclass(frozen=True, eq=False)
class PairEvidence:
    """The evidence for the score of a pair.

    Attributes:
        correspondences: of the query's and the tile's cells; None unless requested.
    """

    evidence: Evidence
    correspondences: tuple[Correspondences, Correspondences] | None


@dataclass(frozen=True, eq=False, kw_only=True)
class Answer:
    """The gallery of a task ordered by distance to one query, with a verdict; a notebook shows the first matches.

    Attributes:
        task: the query's task, whose gallery was searched.
        name: the query's name.
        index: the query's position; None for a picture outside the task.
        query: the query after its change, with its descriptor.
        ranking: of the gallery, under the part weights of the search.
        matches: the nearest tiles.
        chosen: the tile to compare the query with.
        describe_tile: describes a tile of the task by its gallery position.
        source: the query's picture before the change, (H, W, 3) uint8.
        tile: the compared tile, described; None until it is needed.
        positive: the nearest positive; None if the query has none, or its place is unknown.
        errors_m: metres from the query's place, or from the camera of a user's picture, to each tile, (G,); None if unknown.
        zoom: of the query's picture, see `Picture.zoom`, or the calibration's choice for a user's picture.
        pair_evidence: of the compared tile; None if it was not requested, or there is no network.
        seconds: duration of the analysis.
    """

    task: Task
    name: str
    query: DescribedPicture
    ranking: Ranking
    matches: list[Match]
    chosen: Match
    describe_tile: Callable[[Task, int], DescribedPicture]
    source: UInt8Array
    index: int | None = None
    tile: DescribedPicture | None = None
    positive: Match | None = None
    errors_m: Float64Array | None = None
    zoom: float = 1.0
    pair_evidence: PairEvidence | None = None
    seconds: float = 0.0

    @cached_property
    def verdict(self) -> Verdict:
        """The judgement of the first match, with the parts that decide it."""
        return verdict.judge(
            self.ranking, self.task.part_names, self.task.contract.part_noun, self.error_m(self.matches[0])
        )

    def error_m(self, match: Match) -> float | None:
        """Return the metres from the query's place to a tile; None if unknown."""
        error_m = math.nan if self.errors_m is None else float(self.errors_m[match.index])
        return error_m if math.isfinite(error_m) else None

    def ungraded(self) -> Self:
        """Return this answer with the query's place unknown."""
        return replace(
            self,
            ranking=replace(self.ranking, relevant=None),
            matches=[replace(match, true=None) for match in self.matches],
            chosen=replace(self.chosen, true=None),
            positive=None,
        )

    def top(self, k: int) -> list[NamedMatch]:
        """Return the k nearest pictures, or all if there are fewer.

        A match has `rank` (1 for the nearest), `name`, `index` in the gallery, `score`, `distance2` (d², 0 .. 4), `cosines` of
        the parts (n,), and `contributions`, their shares of d² (n,), which add up to it.
        """
        return [NamedMatch(**vars(match), name=self.task.gallery[match.index].name) for match in self.ranking.top(k)]

    def evidence(self, rank: int = 1) -> Evidence:
        """Account for the score of the picture at a rank, cell by cell; the picture may be described once more.

        Raises:
            InputError: if there is no such rank, or the model gives no cells.
            PictureError: if the picture can no longer be read.
        """
        return self._pair(self._match(rank))[1]

    @property
    def shares(self) -> Float32Array:
        """Return each part's share of d² of every ranked picture, nearest first, (k, n); a picture's shares add up to its d²."""
        return np.stack([match.contributions for match in self.ranking.top(len(self.ranking.order))])

    def heat(self, rank: int = 1, of: Literal["query", "tile"] = "query") -> Float32Array:
        """Return each cell's share of the score at a rank, by part, (n, h, w), for cells of the query or of the tile.

        With the constants of `evidence(rank)` under the part weights and the terms of CSLS, all cells add up to the score.

        Raises:
            InputError, PictureError: as `evidence`.
        """
        evidence = self.evidence(rank)
        side = evidence.query if of == "query" else evidence.tile
        return (side.cells * evidence.weights[:, None, None]).astype(np.float32)

    def figure(self, rank: int = 1) -> PairPicture:
        """Draw the query beside the picture at a rank: their parts, the evidence of their cells, and bars for each part.

        Raises:
            InputError: if there is no such rank, or the model gives no cells.
            PictureError: if the picture can no longer be read.
        """
        match, views = self._match(rank), self.task.views
        tile, evidence = self._pair(match)
        (one, first), (other, second) = self.drawn(self.query, 0), self.drawn(tile, 1)
        name = printable(self.task.gallery[match.index].name)
        titles = f"Photo, {views[0]}", f"Rank {rank} of {self.task.tiles:,}, {views[1]}: {name}"
        return PairPicture(pair_figure.draw(evidence, (one, other), titles, views, self.task.contract, (first, second)))

    def drawn(self, described: DescribedPicture, side: int) -> tuple[UInt8Array, PartAreas | None]:
        """Return the picture on which the parts of the query (side 0) or of a tile (1) are drawn, and their areas.

        The areas are None if neither a partition nor the picture's cells are known.
        """
        task, view = self.task, self.task.views[side]
        picture = described.picture if task.model is None else task.model.as_partitioned(described.picture, view)
        return picture, PartAreas.of(task.contract, view, task.map_sizes[view], described.trace)

    def described(self, match: Match) -> DescribedPicture:
        """Return the described picture of a match."""
        if self.tile is not None and match.index == self.chosen.index:
            return self.tile
        return self.describe_tile(self.task, match.index)

    def paper_figure(
        self, true: int | str | None = None, wrong: int | str | None = None, width: float = PAGE
    ) -> PaperFigure:
        """Draw a paper's figure: the query, the true tile, a wrong tile, the heat of each part, and its shares.

        Args:
            true: a tile by its rank or its name; by default the nearest positive, or the nearest tile if no positive is known.
            wrong: likewise; by default the nearest other tile.
            width: in mm, such as 88 for a column, or 180 for a page, which has a map for each part.

        Raises:
            InputError: if there is no such tile, both are one, the model gives no cells, or the width is out of range.
            PictureError: if a picture can no longer be read.
        """
        second = None if wrong is None else self._match(wrong)
        positive = self.ranking.positive() if true is None else self._match(true)
        first = positive or self.ranking.hardest_negative(None if second is None else second.index)
        second = second or (first and self.ranking.hardest_negative(first.index))
        if first is None or (second is not None and first.index == second.index):
            raise InputError("The true and the wrong tile are one; give two tiles of the gallery.")
        rows, pairs = [], []
        for match, right in ((first, True), (second, False)):
            if match is not None:
                tile, evidence = self._pair(match)
                told = right if positive is not None or (match is second and wrong is not None) else None
                known = told if match.true is None else match.true
                title = {True: "True tile", False: "Wrong tile", None: "Tile"}[known], f"rank {match.rank:,}"
                rows.append(FigureRow.of_tile(title, *self.drawn(tile, 1), evidence, known))
                pairs.append(evidence)
        query = FigureRow.of_query(("Query", self.task.query_view), *self.drawn(self.query, 0), pairs)
        return PaperFigure([query, *rows], self.task.part_names, self.task.contract.part_noun, width)

    def _match(self, tile: int | str) -> Match:
        order = self.ranking.order.tolist()
        if isinstance(tile, str):
            for index in order:
                if self.task.gallery[index].name == tile:
                    return self.ranking.find(index)
            example = printable(self.task.gallery[order[0]].name)
            raise InputError(f"There is no tile {printable(tile)}; give a rank, or a name such as {example}.")
        if tile not in range(1, len(order) + 1):
            raise InputError(f"There is no rank {tile}; the gallery has ranks 1 to {len(order)}.")
        return self.ranking.match(tile - 1)

    def _pair(self, match: Match) -> tuple[DescribedPicture, Evidence]:
        """Return the described tile of a match, and the evidence for it."""
        tile = self.described(match)
        pair = pair_evidence(self.query, tile, self.ranking.weights, csls=self.ranking.csls_of(match.index))
        if pair is None:
            raise InputError(f"{verdicts.no_cells(self.task.contract)} Its answers have no figure.")
        return tile, pair.evidence

    def to_dict(self, k: int = 10) -> dict[str, Any]:
        """Return JSON values: the verdict, the k nearest tiles with each part's share of d², and the evidence, if any."""
        said, names = self.verdict, self.task.part_names
        rival = None if said.rival is None else self._listed(said.rival)
        judged: dict[str, Any] = {
            "sign": said.sign,
            "headline": said.headline,
            "sentence": said.sentence,
            "rival": rival,
        }
        judged |= {"lead": said.lead, "gains": None if said.gains is None else said.gains.tolist()}
        values: dict[str, Any] = {
            "query": self.name,
            "task": self.task.name,
            "weights": self.ranking.weights.tolist(),
            "verdict": judged | {"parts": [names[part] for part in said.parts]},
            "compared": self._listed(self.chosen),
            "nearest": [self._listed(match) for match in self.ranking.top(k)],
        }
        pair = self.pair_evidence
        return values if pair is None else values | pair.evidence.to_dict(names, self.task.contract.claim)

    def _listed(self, match: Match) -> dict[str, Any]:
        return {
            "rank": match.rank,
            "name": self.task.gallery[match.index].name,
            "true": match.true,
            "score": match.score,
            "distance2": match.distance2,
            "shares": match.contributions.tolist(),
            "metres": self.error_m(match),
        }

    def _repr_html_(self) -> str:
        matches, names, view = self.top(SHOWN), self.task.part_names, self.task.gallery_view
        full = max((match.distance2 for match in matches), default=0.0)
        rows: list[tuple[object, ...]] = [(Markup("<b>query</b>"), _thumbnail(self.query.picture), "", "", "")]
        for match in matches:
            shares = _bar(match, full, names)
            picture = _thumbnail(self.task.gallery[match.index].load())
            rows.append((match.rank, picture, printable(match.name), Markup(f"{match.distance2:.4f}"), shares))
        legend = Markup(", ").join(
            Markup('<span style="padding: 0 .4em; background: {}; color: {}">{}</span>').format(
                _GROUND, theme.css(DARK.ink(theme.part_colour(part))), name
            )
            for part, name in enumerate(names)
        )
        bars = Markup("contributions to d²: {}").format(legend) if len(names) > 1 else ""
        caption = f"{len(matches)} of {self.task.tiles:,} {view} pictures, by their distance to the query"
        caption = f"{_SIGNS[self.verdict.sign]}{self.verdict.headline}. {self.verdict.sentence} {caption}"
        return table(caption, ("rank", "", "name", "d²", bars), rows)


def _bar(match: NamedMatch, full: float, names: Sequence[str]) -> Markup:
    """Draw the contributions side by side; the distance `full` fills the bar."""
    segments = Markup().join(
        Markup('<i title="{}" style="background: {}; width: {}%"></i>').format(
            f"part {name}: {share:.4f}" if len(names) > 1 else f"{share:.4f}",
            theme.css(theme.part_colour(part)),
            round(100 * max(share, 0.0) / max(full, 1e-9), 2),
        )
        for part, (name, share) in enumerate(zip(names, match.contributions.tolist(), strict=True))
    )
    return Markup('<div style="display: flex; width: 16em; height: 1em; background: {}">{}</div>').format(
        _GROUND, segments
    )


def _thumbnail(picture: UInt8Array) -> Markup:
    small = overlays.data_uri(images.resize(picture, _THUMBNAIL, _THUMBNAIL))
    return Markup('<img src="{}" width="{}" height="{}" alt="">').format(small, _THUMBNAIL, _THUMBNAIL)


def pair_evidence(
    query: DescribedPicture,
    tile: DescribedPicture,
    weights: Float32Array,
    correspondences: bool = False,
    csls: tuple[Float32Array, Float32Array] | None = None,
) -> PairEvidence | None:
    """Return the evidence of a pair under part weights (n,) with sum one; None without a network.

    Args:
        csls: see `Evidence`.
    """
    if query.trace is None or tile.trace is None:
        return None
    evidence = explain.evidence(query.trace, tile.trace, weights, csls)
    pairs = explain.correspondences(query.trace, tile.trace, weights) if correspondences else None
    return PairEvidence(evidence, pairs)
