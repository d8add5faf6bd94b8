"""The analysis of one query for a report, without its HTML."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from functools import lru_cache

from lpn.analysis.comparison import effect_on
from lpn.core.arrays import Float32Array, UInt8Array
from lpn.core.errors import InputError
from lpn.core.numbers import shown_difference
from lpn.datasets.metadata import NOTE, TAGS
from lpn.descriptors.transforms import UNCHANGED, Change
from lpn.drawing.part_areas import PartAreas
from lpn.explain import Evidence, counterfactual
from lpn.explain.counterfactual import Effect, Margin, RanksWithoutParts, Reweighting
from lpn.explain.part_activation import part_activation
from lpn.library.analyser import OwnPicture, QueryAnalyser, QueryRequest, describe_tile
from lpn.library.answer import Answer, pair_evidence
from lpn.retrieval import DescribedPicture, Match, Ranking
from lpn.tasks.query_outcomes import picture_columns
from lpn.tasks.task import Task


@dataclass(frozen=True)
class SaidPicture:
    """A picture by which a screen shows an answer.

    Attributes:
        caption: what it is.
        name: its name or place.
        source: a data URI.
        sign: True if it is right, False if wrong; None if that is unknown.
        turn: degrees clockwise by which it is turned to lie like the query.
        doubted: it shows the place by a photo's details, which something contradicts.
    """

    caption: str
    name: str
    source: str
    sign: bool | None = None
    turn: float = 0.0
    doubted: bool = False


@dataclass(frozen=True)
class SaidDetails:
    """A photo beside the map about it, with the same details numbered in both.

    Attributes:
        sentence: how many details agree, and how well.
        photo, ground: the pictures as data URIs.
        size: their width and height in pixels.
        frame: the photo's corners on the map, per cent of its width and height.
        colour: of the frame, in CSS.
        pins: for each detail its places in photo and map, per cent of width and height, and the metres between where the photo
            has it and where the map has it, as a number.
        limit: metres within which a detail counts, as a number.
    """

    sentence: str
    photo: str
    ground: str
    size: tuple[int, int]
    frame: tuple[tuple[float, float], ...]
    colour: str
    pins: tuple[tuple[tuple[float, float], tuple[float, float], str], ...]
    limit: str


@dataclass(frozen=True)
class Said:
    """The words and pictures by which a screen shows the answer that a report is about.

    Attributes:
        question: to which it is the answer.
        headline: the verdict in some words.
        sentences: paragraphs of text.
        pictures: the photo, the answer, and the map with the ground that the photo shows.
        photo: what the photo's file says of it, as names and values.
        map: the files of the map and their digests, as names and values.
        reasons: why this is the answer: each method, "" where it is the only one, and its sentences.
        judged: sentences on how right and wrong are told apart and checked.
        details: the numbered details by which the photo is placed; None without them.
    """

    question: str
    headline: str
    sentences: tuple[str, ...]
    pictures: tuple[SaidPicture, ...] = ()
    photo: tuple[tuple[str, str], ...] = ()
    map: tuple[tuple[str, str], ...] = ()
    reasons: tuple[tuple[str, tuple[str, ...]], ...] = ()
    judged: tuple[str, ...] = ()
    details: SaidDetails | None = None


@dataclass(frozen=True)
class Options:
    """The contents of a report.

    Attributes:
        matches: number of tiles listed for each query, 1 or more.
        change: the change that is applied to each query first.
        compared_tile: gallery position of a tile to compare in place of the top match.
        selection: how the queries were chosen, for the report's header.
        said: the screen's words on a single query; they stand first.
        doubtful: queries of the task for which no tile is right for certain; they are not graded, nor counted in its figures.
        unsure: of the report's queries, those whose answer as it is shown is not graded; by default those that are doubtful.
    """

    matches: int = 5
    change: Change = UNCHANGED
    compared_tile: int | None = None
    selection: str = ""
    said: Said | None = None
    doubtful: Collection[int] = ()
    unsure: Collection[int] | None = None

    @property
    def ungraded(self) -> Collection[int]:
        """The queries whose answers are not graded where they are shown."""
        return self.doubtful if self.unsure is None else self.unsure

    def __post_init__(self) -> None:
        if self.matches < 1:
            raise InputError(f"The number of tiles listed is {self.matches}; expected 1 or more.")


@dataclass(frozen=True, eq=False)
class Pair:
    """A tile that is compared with the query.

    Attributes:
        match: the tile's entry in the ranking.
        picture: the tile's picture on which parts are drawn, see `Model.as_partitioned`.
        areas: of its parts; None if neither a partition nor its cells are known.
        evidence: the evidence for the score; None without cells.
        activation: of each part of the query and of the tile, (n, h, w) each, see `part_activation`; None without cells.
    """

    match: Match
    picture: UInt8Array
    areas: PartAreas | None
    evidence: Evidence | None
    activation: tuple[Float32Array, Float32Array] | None


@dataclass(frozen=True, eq=False)
class Case:
    """One query: its answer, and what a report adds to it.

    Attributes:
        doubtful: see `Options`; its place counts as not known.
        facts: names and values of the query's metadata.
        picture: the query's picture on which parts are drawn, see `Model.as_partitioned`.
        areas: of its parts; None if neither a partition nor its cells are known.
        pairs: the compared tile, then its counterpart if there is one. The counterpart of a positive is the hardest
            negative. The counterpart of another tile is the nearest positive.
        margin: margin of the positive in `pairs` over the other tile; None if `pairs` is one tile.
        without: ranks of the positive without each part; None if no positive is known.
        change: the smallest change of part weights that puts a positive first; None if impossible or needless.
        effect: the effect of `change` on all queries of the task; None for a gallery that only searches know.
    """

    answer: Answer
    doubtful: bool
    facts: list[tuple[str, str]]
    picture: UInt8Array
    areas: PartAreas | None
    pairs: tuple[Pair, ...]
    margin: Margin | None
    without: RanksWithoutParts | None
    change: Reweighting | None
    effect: Effect | None

    @property
    def matches(self) -> list[Match]:
        """The nearest tiles, then the nearest positive if it is not among them."""
        listed, positive = self.answer.matches, self.answer.positive
        return listed if positive is None or positive.rank <= len(listed) else [*listed, positive]

    @property
    def margin_shown(self) -> float | None:
        """The margin as it is shown beside both squared distances, see `shown_difference`; None without one."""
        if self.margin is None:
            return None
        distance2 = {pair.match.index: pair.match.distance2 for pair in self.pairs}
        return shown_difference(distance2[self.margin.negative], distance2[self.margin.positive])


class Cases:
    """Makes the cases of one report; caches described tiles across cases."""

    def __init__(self, task: Task, options: Options) -> None:
        if options.compared_tile is not None and not 0 <= options.compared_tile < len(task.gallery):
            raise InputError(
                f"There is no gallery picture {options.compared_tile}; the gallery has positions 0 to {len(task.gallery) - 1}."
            )
        if task.model is None and options.change:
            raise InputError(
                f"{task.model_name} has saved descriptors but no network, so queries cannot be changed; leave changes out."
            )
        self._task, self._options = task, options
        self._tile = lru_cache(maxsize=64)(lambda index: describe_tile(task, index, task.model))
        self._analyser = QueryAnalyser(task.model, lambda _, index: self._tile(index))

    def make(self, query: int | OwnPicture) -> Case:
        """Analyse one query."""
        task, options = self._task, self._options
        index = None if isinstance(query, OwnPicture) else query
        weights = None if task.weights is None else tuple(task.part_weights.tolist())
        request = QueryRequest(query, options.change, weights, compare=options.compared_tile)
        answer = self._analyser.analyse(task, request, options.matches)
        ranking, chosen, positive = answer.ranking, answer.chosen, answer.positive
        other = ranking.hardest_negative() if chosen.true else positive
        margin = None
        if other is not None:
            true, wrong = (chosen, other) if chosen.true else (other, chosen)
            margin = counterfactual.margin(ranking, true.index, wrong.index)
        change = None if positive is None or positive.rank == 1 else counterfactual.smallest_change(ranking)
        return Case(
            answer=answer,
            doubtful=index in options.ungraded,
            facts=self._facts(index),
            picture=self._partitioned(answer.query.picture, 0),
            areas=self._areas(answer.query, 0),
            pairs=tuple(self._pair(answer.query, match, ranking) for match in (chosen, other) if match is not None),
            margin=margin,
            without=counterfactual.ranks_without_parts(ranking),
            change=change,
            effect=None if change is None else self._effect(change),
        )

    def _partitioned(self, picture: UInt8Array, side: int) -> UInt8Array:
        task = self._task
        return picture if task.model is None else task.model.as_partitioned(picture, task.views[side])

    def _pair(self, query: DescribedPicture, match: Match, ranking: Ranking) -> Pair:
        tile = self._tile(match.index)
        evidence = pair_evidence(query, tile, self._task.part_weights, csls=ranking.csls_of(match.index))
        activation = None
        if query.trace is not None and tile.trace is not None:
            activation = part_activation(query.trace), part_activation(tile.trace)
        evidence_of_pair = None if evidence is None else evidence.evidence
        return Pair(match, self._partitioned(tile.picture, 1), self._areas(tile, 1), evidence_of_pair, activation)

    def _areas(self, described: DescribedPicture, side: int) -> PartAreas | None:
        view = self._task.views[side]
        return PartAreas.of(self._task.contract, view, self._task.map_sizes[view], described.trace)

    def _facts(self, index: int | None) -> list[tuple[str, str]]:
        if index is None:
            return []
        table = self._task.table
        names = [column.name for column in picture_columns(table)] + [TAGS, NOTE]
        columns = [table.columns[name] for name in names if name in table.columns]
        return [
            (column.name, column.text(index) + (column.unit if column.unit == "°" else f" {column.unit}").rstrip())
            for column in columns
            if column.known[index]
        ]

    def _effect(self, change: Reweighting) -> Effect | None:
        task = self._task
        return effect_on(task, task.weights, change.weights, task.outcomes.rank) if task.lists_gallery else None
