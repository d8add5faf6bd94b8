"""The analysis of one query for a report, without its HTML."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from functools import lru_cache

from lpn.analysis.comparison import Comparison, effect_on
from lpn.core.arrays import Float32Array, UInt8Array
from lpn.core.errors import InputError
from lpn.core.numbers import shown_difference
from lpn.datasets.metadata import NOTE, TAGS
from lpn.descriptors.transforms import UNCHANGED, Change
from lpn.drawing.part_areas import PartAreas
from lpn.explain import Evidence
from lpn.explain.counterfactual import Effect
from lpn.explain.part_activation import part_activation
from lpn.library.analyser import OwnPicture, QueryAnalyser, QueryRequest, describe_tile
from lpn.library.answer import Answer, pair_evidence
from lpn.retrieval import Match
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
class DetailPin:
    """A detail that photo and map show, by its number in both.

    Attributes:
        in_photo, on_map: per cent of the width and height of the pictures.
        metres: from where the photo's place has it to where the map has it, two digits.
    """

    number: int
    in_photo: tuple[float, float]
    on_map: tuple[float, float]
    metres: str


@dataclass(frozen=True)
class DetailsPair:
    """A photo beside the map about it, with the same details numbered in both.

    Attributes:
        sentence: how many details agree, and how well.
        photo, ground, laid: the photo, the map, and the photo laid over it, as data URIs.
        size: their width and height in pixels.
        frame: the photo's corners on the map, per cent of its width and height.
        colour: of the frame, in CSS.
        pins: the numbered details.
        limit: metres within which a detail counts, as a number.
        heading: what points up on the map, degrees clockwise from north, -180 up to 180.
        scale: metres of the scale, and per cent of the map's width that it takes.
    """

    sentence: str
    photo: str
    ground: str
    laid: str
    size: tuple[int, int]
    frame: list[tuple[float, float]]
    colour: str
    pins: list[DetailPin]
    limit: str
    heading: float
    scale: tuple[float, float]


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
    details: DetailsPair | None = None


@dataclass(frozen=True)
class Options:
    """The contents of a report.

    Attributes:
        matches: number of tiles listed for each query, 1 or more.
        change: the change that is applied to each query first.
        selection: how the queries were chosen, for the report's header.
        said: the screen's words on a single query; they stand first.
        doubtful: queries of the task for which no tile is right for certain; they are not graded, nor counted in its figures.
        title: of a report that tells a story, which has no figures of all queries; empty for a report on queries.
        captions: what a story says of each answer.
    """

    matches: int = 5
    change: Change = UNCHANGED
    selection: str = ""
    said: Said | None = None
    doubtful: Collection[int] = ()
    title: str = ""
    captions: Sequence[Sequence[str]] = ()

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
        doubtful: no tile is right for certain, so it is not graded.
        matches: the nearest tiles, then the nearest positive if it is not among them.
        facts: names and values of the query's metadata.
        picture: the query's picture on which parts are drawn, see `Answer.drawn`.
        areas: of its parts; None if neither a partition nor its cells are known.
        pairs: the compared tile, then its counterpart if there is one. The counterpart of a positive is the hardest
            negative. The counterpart of another tile is the nearest positive.
        comparison: of the nearest positive with a wrong tile; None if no positive is known, or no tile is wrong.
        effect: what the smallest change of weights does to all queries; None in a story.
    """

    answer: Answer
    doubtful: bool
    matches: list[Match]
    facts: list[tuple[str, str]]
    picture: UInt8Array
    areas: PartAreas | None
    pairs: tuple[Pair, ...]
    comparison: Comparison | None
    effect: Effect | None

    @property
    def margin(self) -> float | None:
        """The margin of the positive as it is shown beside both squared distances, see `shown_difference`."""
        pair = self.comparison
        return None if pair is None else shown_difference(pair.other.distance2, pair.followed.distance2)


class Cases:
    """Makes the cases of one report; caches described tiles across cases."""

    def __init__(self, task: Task, options: Options) -> None:
        if task.model is None and options.change:
            raise InputError(
                f"{task.model_name} has saved descriptors but no network, so queries cannot be changed; leave changes out."
            )
        self._task, self._options = task, options
        self._graded = task.without_truth(options.doubtful)
        tile = lru_cache(maxsize=64)(lambda index: describe_tile(task, index, task.model))
        self._analyser = QueryAnalyser(task.model, lambda _, index: tile(index))

    def make(self, query: int | OwnPicture | Answer) -> Case:
        """Answer one query, or take the answer that is given."""
        task, options = self._task, self._options
        if isinstance(query, Answer):
            answer = query
        else:
            weights = None if task.weights is None else tuple(task.part_weights.tolist())
            request = QueryRequest(query, options.change, weights)
            answer = self._analyser.analyse(self._graded, request, options.matches)
        ranking, chosen, positive = answer.ranking, answer.chosen, answer.positive
        other = ranking.hardest_negative() if chosen.true else positive
        comparison = None if positive is None else Comparison.of(ranking, chosen)
        below = [] if positive is None or positive.rank <= options.matches else [positive]
        picture, areas = answer.drawn(answer.query, 0)
        index = answer.index
        placed = index is not None and (index in options.doubtful or task.truth is None or task.truth[index].known)
        return Case(
            answer=answer,
            doubtful=placed and answer.verdict.sign is None,
            matches=[*ranking.top(options.matches), *below],
            facts=[] if index is None or options.title else self._facts(index),
            picture=picture,
            areas=areas,
            pairs=tuple(_pair(answer, match) for match in (chosen, other) if match is not None),
            comparison=comparison,
            effect=None if comparison is None or options.title else self._effect(comparison),
        )

    def _facts(self, index: int) -> list[tuple[str, str]]:
        table = self._graded.table
        names = [column.name for column in picture_columns(table)] + [TAGS, NOTE]
        columns = [table.columns[name] for name in names if name in table.columns]
        return [
            (column.name, column.text(index) + (column.unit if column.unit == "°" else f" {column.unit}").rstrip())
            for column in columns
            if column.known[index]
        ]

    def _effect(self, comparison: Comparison) -> Effect | None:
        task, change = self._graded, comparison.change
        if comparison.followed.rank == 1 or change is None:
            return None
        return effect_on(task, change.weights)


def _pair(answer: Answer, match: Match) -> Pair:
    query, tile, ranking = answer.query, answer.described(match), answer.ranking
    evidence = pair_evidence(query, tile, ranking.weights, csls=ranking.csls_of(match.index))
    activation = None
    if query.trace is not None and tile.trace is not None:
        activation = part_activation(query.trace), part_activation(tile.trace)
    return Pair(match, *answer.drawn(tile, 1), None if evidence is None else evidence.evidence, activation)
