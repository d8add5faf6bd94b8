"""The answer of a gallery to one picture: its ranking, the reason as a figure, and both as HTML for a notebook."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from markupsafe import Markup

from lpn import explain, retrieval
from lpn.core.arrays import UInt8Array
from lpn.core.errors import InputError
from lpn.core.files import check_ending, printable, write_atomic
from lpn.core.notebook_html import table
from lpn.core.views import View
from lpn.datasets import Picture
from lpn.drawing import charts, overlays, pair_figure, verdicts
from lpn.drawing.part_areas import PartAreas
from lpn.models.base import Model
from lpn.models.trace import Trace
from lpn.retrieval import DescribedPicture, Match, Ranking

_SHOWN = 5
_THUMBNAIL = 96


@dataclass(frozen=True)
class NamedMatch(Match):
    """A match with the name of its picture, which is its path below the gallery's folder."""

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
class Answer:
    """A gallery in the order of its distance to one picture; a notebook shows its first matches.

    Attributes:
        model: it described query and gallery.
        views: of query and gallery.
        query: the picture after its change, with its descriptor.
        pictures: of the gallery.
        ranking: of all pictures, under the part weights of the search.
    """

    model: Model
    views: tuple[View, View]
    query: DescribedPicture
    pictures: tuple[Picture, ...]
    ranking: Ranking

    def top(self, k: int) -> list[NamedMatch]:
        """The k nearest pictures, or all when there are fewer.

        A match has `rank` (1 for the nearest), `name`, `index` in the gallery, `score`, `distance2` (d², 0 .. 4), `cosines` of
        the parts (n,), and `contributions`, their shares of d² (n,), which add up to it.
        """
        return [NamedMatch(**vars(match), name=self.pictures[match.index].name) for match in self.ranking.top(k)]

    def evidence(self, rank: int = 1) -> explain.Evidence:
        """Account for the score of the picture at a rank, cell by cell; the picture is described once more.

        Raises:
            InputError: if there is no such rank, or the model gives no cells.
            PictureError: if the picture cannot be read any more.
        """
        return self._pair(rank)[0]

    def figure(self, rank: int = 1) -> PairPicture:
        """Draw the query beside the picture at a rank: their parts, the evidence of their cells, and bars for each part.

        Raises:
            InputError: if there is no such rank, or the model gives no cells.
            PictureError: if the picture cannot be read any more.
        """
        evidence, tile, traces = self._pair(rank)
        pictures = [
            self.model.as_partitioned(one.picture, view)
            for one, view in zip((self.query, tile), self.views, strict=True)
        ]
        areas = [
            PartAreas.of(self.model.contract, view, trace.size, trace)
            for view, trace in zip(self.views, traces, strict=True)
        ]
        name = printable(self.pictures[int(self.ranking.order[rank - 1])].name)
        titles = f"Query, {self.views[0]}", f"Rank {rank} of {len(self.pictures):,}, {self.views[1]}: {name}"
        return PairPicture(
            pair_figure.draw(
                evidence, (pictures[0], pictures[1]), titles, self.views, self.model.contract, (areas[0], areas[1])
            )
        )

    def _pair(self, rank: int) -> tuple[explain.Evidence, DescribedPicture, tuple[Trace, Trace]]:
        """Return the evidence for the picture at a rank, the picture, and the traces of query and picture."""
        if rank not in range(1, len(self.pictures) + 1):
            raise InputError(f"There is no rank {rank}; the gallery has ranks 1 to {len(self.pictures)}.")
        if self.query.trace is None:
            raise InputError(f"{verdicts.no_cells(self.model.contract)} Its answers have no figure.")
        index = int(self.ranking.order[rank - 1])
        picture = self.pictures[index].load_zoomed()
        tile = retrieval.describe_picture(self.model, picture, self.views[1])
        assert tile.trace is not None  # cells are of the model, not of a view
        return (
            explain.evidence(self.query.trace, tile.trace, self.ranking.weights, self.ranking.csls_of(index)),
            tile,
            (self.query.trace, tile.trace),
        )

    def _repr_html_(self) -> str:
        matches, names = self.top(_SHOWN), self.model.contract.names(self.views[0])
        full = max((match.distance2 for match in matches), default=0.0)
        rows: list[tuple[object, ...]] = [(Markup("<b>query</b>"), _thumbnail(self.query.picture), "", "", "")]
        for match in matches:
            shares = _bar(match, full, names)
            picture = _thumbnail(self.pictures[match.index].load())
            rows.append((match.rank, picture, printable(match.name), Markup(f"{match.distance2:.4f}"), shares))
        legend = Markup(", ").join(
            Markup('<span style="border-bottom: .25em solid {}">{}</span>').format(charts.part_colour(part), name)
            for part, name in enumerate(names)
        )
        bars = Markup("contributions to d²: {}").format(legend) if len(names) > 1 else ""
        caption = f"{len(matches)} of {len(self.pictures):,} {self.views[1]} pictures, by their distance to the query"
        return table(caption, ("rank", "", "name", "d²", bars), rows)


def _bar(match: NamedMatch, full: float, names: Sequence[str]) -> Markup:
    """Draw the contributions side by side; the distance `full` fills the bar."""
    segments = Markup().join(
        Markup('<i title="{}" style="background: {}; width: {}%"></i>').format(
            f"part {name}: {share:.4f}" if len(names) > 1 else f"{share:.4f}",
            charts.part_colour(part),
            round(100 * max(share, 0.0) / max(full, 1e-9), 2),
        )
        for part, (name, share) in enumerate(zip(names, match.contributions.tolist(), strict=True))
    )
    return Markup('<div style="display: flex; width: 16em; height: 1em">{}</div>').format(segments)


def _thumbnail(picture: UInt8Array) -> Markup:
    small = overlays.data_uri(overlays.square(picture, _THUMBNAIL))
    return Markup('<img src="{}" width="{}" height="{}" alt="">').format(small, _THUMBNAIL, _THUMBNAIL)
