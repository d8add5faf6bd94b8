"""The analysis behind a report, without its HTML; each picture is read once, and each pair described once."""

from __future__ import annotations

from collections.abc import Collection, Generator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

from lpn.analysis.comparison import Comparison, effect_on
from lpn.core import images
from lpn.core.arrays import Float32Array, UInt8Array
from lpn.core.errors import InputError
from lpn.datasets.metadata import NOTE, TAGS
from lpn.descriptors.transforms import UNCHANGED, Change
from lpn.drawing.part_areas import PartAreas
from lpn.explain import Evidence
from lpn.explain.counterfactual import Effect
from lpn.library.analyser import OwnPicture, QueryAnalyser, QueryRequest
from lpn.library.answer import Answer, pair_evidence
from lpn.report._rendering import thumbnail
from lpn.retrieval import DescribedPicture, Match, describe_pictures
from lpn.tasks.query_outcomes import picture_columns
from lpn.tasks.task import Task

# Number of queries that are analysed together, and of described tiles that are cached for later queries.
_TOGETHER, _KEPT = 4, 64


@dataclass(frozen=True)
class Options:
    """The contents of a report.

    Attributes:
        matches: number of tiles listed for each query, 1 or more.
        change: the change applied to each query first.
        selection: the selection of the queries in words, for the report's header.
        doubtful: queries without a certainly right tile; they are not graded, nor counted in the report's figures.
        title: of a story's report, which has no figures of all queries; empty for a report on queries.
        captions: a story's text for each answer.
    """

    matches: int = 5
    change: Change = UNCHANGED
    selection: str = ""
    doubtful: Collection[int] = ()
    title: str = ""
    captions: Sequence[Sequence[str]] = ()

    def __post_init__(self) -> None:
        if self.matches < 1:
            raise InputError(f"The number of tiles listed is {self.matches}; expected 1 or more.")


@dataclass(frozen=True, eq=False)
class Seen:
    """A described picture for a report.

    Attributes:
        picture: the picture below the drawn parts, (H, W, 3) uint8, see `Answer.drawn`.
        areas: of its parts; None if neither a partition nor its cells are known.
        heat: its activation, (h, w), 0 to 1; None without cells.
        match: a tile's entry in the ranking; None for the query.
        evidence: of the query's score with this tile; None for the query, and without cells.
    """

    picture: UInt8Array
    areas: PartAreas | None
    heat: Float32Array | None
    match: Match | None = None
    evidence: Evidence | None = None


@dataclass(frozen=True, eq=False)
class Case:
    """One query: its answer, and a report's additions to it.

    Attributes:
        doubtful: whether no tile is certainly right, so that the query is not graded.
        matches: the nearest tiles, then the nearest positive if it is not among them.
        thumbnails: of listed tiles by their positions, as data URIs.
        facts: names and values of the query's metadata, or from the file of a user's picture.
        query: the query's picture.
        tiles: the compared tile, then its rival, if any: for a true tile the nearest wrong one, for a wrong tile the nearest true
            one, and for an unknown truth the next tile.
        comparison: of the nearest positive with a wrong tile; None if no positive is known, or no tile is wrong.
        effect: of the smallest change of weights on all queries; None in a story.
    """

    answer: Answer
    doubtful: bool
    matches: list[Match]
    thumbnails: Mapping[int, str]
    facts: list[tuple[str, str]]
    query: Seen
    tiles: list[Seen]
    comparison: Comparison | None
    effect: Effect | None


class Cases:
    """Makes the cases of one report."""

    def __init__(self, task: Task, options: Options) -> None:
        if task.model is None and options.change:
            raise InputError(
                f"{task.model_name} has saved descriptors but no network, so queries cannot be changed; leave changes out."
            )
        self._task, self._options = task, options
        self._graded = task.without_truth(options.doubtful)
        self._tiles: dict[int, DescribedPicture] = {}
        self._thumbnails: dict[int, str] = {}
        self._analyser = QueryAnalyser(task.model, lambda _, index: self._tiles[index])

    def make(self, queries: Sequence[int | OwnPicture | Answer]) -> Generator[Case]:
        """Yield the case of each query or answer; while one case is drawn, the next queries are described."""
        together = [queries[start : start + _TOGETHER] for start in range(0, len(queries), _TOGETHER)]
        with ThreadPoolExecutor(1, "report") as thread:
            made = thread.submit(self._answer, together[0])
            for following in [*together[1:], None]:
                cases = made.result()
                if following is not None:
                    made = thread.submit(self._answer, following)
                yield from cases

    def _answer(self, queries: Sequence[int | OwnPicture | Answer]) -> list[Case]:
        task, k = self._task, self._options.matches
        weights = None if task.weights is None else tuple(task.part_weights.tolist())
        requests = {
            place: QueryRequest(query, self._options.change, weights)
            for place, query in enumerate(queries)
            if not isinstance(query, Answer)
        }
        self._analyser.describe_ahead(self._graded, list(requests.values()))
        answers = [
            query if isinstance(query, Answer) else self._analyser.analyse(self._graded, requests[place], k, tile=False)
            for place, query in enumerate(queries)
        ]
        compared = [[answer.chosen, *_rival(answer)] for answer in answers]
        listed = [self._listed(answer) for answer in answers]
        own = {match.index for place in requests for match in compared[place]}
        self._see({match.index for matches in (*listed, *compared) for match in matches}, own)
        facts = [list(query.facts) if isinstance(query, OwnPicture) else [] for query in queries]
        return [self._case(*each) for each in zip(answers, compared, listed, facts, strict=True)]

    def _listed(self, answer: Answer) -> list[Match]:
        """Return the nearest tiles, and the nearest positive if it is farther away."""
        k, positive = self._options.matches, answer.positive
        return [*answer.ranking.top(k), *([] if positive is None or positive.rank <= k else [positive])]

    def _see(self, listed: Collection[int], compared: Collection[int]) -> None:
        """Draw the thumbnails of tiles, and describe the compared ones, in one batch."""
        task, gallery, pictures = self._task, self._task.gallery, {}
        self._tiles |= {index: self._tiles.pop(index) for index in compared if index in self._tiles}
        for index in sorted(listed):
            entry, wanted = gallery[index], index in compared and index not in self._tiles
            if wanted or index not in self._thumbnails:
                picture = entry.load()
                self._thumbnails.setdefault(index, thumbnail(picture))
                if wanted:
                    pictures[index] = images.zoom(images.crop(picture, entry.box, entry.name), entry.zoom)
        network = [] if task.model is None else [index for index in pictures if not gallery[index].missing]
        if task.model is not None and network:
            bound, seen = task.model.for_task(*task.views), [pictures.pop(index) for index in network]
            self._tiles |= zip(network, describe_pictures(bound, seen, task.gallery_view), strict=True)
        for index, picture in pictures.items():
            self._tiles[index] = DescribedPicture(picture, task.gallery_descriptors[index], None, None)
        for index in list(self._tiles)[: -max(_KEPT, len(compared))]:
            del self._tiles[index]

    def _case(self, answer: Answer, compared: list[Match], listed: list[Match], facts: list[tuple[str, str]]) -> Case:
        options, task, index = self._options, self._task, answer.index
        comparison = None if answer.positive is None else Comparison.of(answer.ranking, answer.chosen)
        placed = index is not None and (index in options.doubtful or task.truth is None or task.truth[index].known)
        return Case(
            answer=answer,
            doubtful=placed and answer.verdict.sign is None,
            matches=listed,
            thumbnails=self._thumbnails,
            facts=facts if index is None or options.title else self._facts(index),
            query=Seen(*answer.drawn(answer.query, 0), answer.query.activation),
            tiles=[_seen(answer, match) for match in compared],
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
        weights = comparison.weights
        return None if comparison.followed.rank == 1 or weights is None else effect_on(self._graded, weights)


def _rival(answer: Answer) -> list[Match]:
    """Return the tile beside the compared one, if there is one."""
    ranking, chosen = answer.ranking, answer.chosen
    rival = ranking.hardest_negative() if chosen.true else answer.positive
    if rival is None and chosen.true is None:
        rival = next((match for match in ranking.top(2) if match.index != chosen.index), None)
    return [] if rival is None else [rival]


def _seen(answer: Answer, match: Match) -> Seen:
    tile, ranking = answer.described(match), answer.ranking
    pair = None
    if ranking.lengths is None:  # a region's search has no evidence of the whole picture
        pair = pair_evidence(answer.query, tile, ranking.weights, csls=ranking.csls_of(match.index))
    return Seen(*answer.drawn(tile, 1), tile.activation, match, None if pair is None else pair.evidence)
