"""What a report says of one query, computed; nothing here is html."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

from lpn import explain, retrieval
from lpn.analysis.comparison import nearest_wrong
from lpn.analysis.query_outcomes import described_by
from lpn.analysis.task import Task
from lpn.core import images
from lpn.core.arrays import UInt8Array
from lpn.core.errors import InputError
from lpn.datasets import Picture as Picture
from lpn.datasets import geo
from lpn.datasets.metadata import NOTE, TAGS
from lpn.descriptors.transforms import UNCHANGED, Change
from lpn.explain import Evidence, counterfactual, sweeps
from lpn.explain.counterfactual import Effect, Margin, Reweighting, Without
from lpn.explain.sweeps import Profile
from lpn.retrieval import DescribedPicture, Match, Ranking, scoring


@dataclass(frozen=True)
class Options:
    """What a report shows.

    Attributes:
        matches: tiles listed for each query, 1 or more.
        profile: whether each query is turned once around; one forward pass for each step.
        step: degrees between two steps.
        change: what is done to each query first.
        against: gallery position of a tile to compare in place of the top match.
        chosen: how the queries were chosen, in words.
    """

    matches: int = 5
    profile: bool = False
    step: float = 15.0
    change: Change = UNCHANGED
    against: int | None = None
    chosen: str = ""

    def __post_init__(self) -> None:
        if self.matches < 1:
            raise InputError(f"The number of tiles listed is {self.matches}; expected 1 or more.")
        sweeps.changes_over("rotation", self.step)


@dataclass(frozen=True, eq=False)
class Own:
    """A picture that is no query of the data set; its true place is not known.

    Attributes:
        name: how it is called.
        picture: (H, W, 3) uint8.
    """

    name: str
    picture: UInt8Array


@dataclass(frozen=True, eq=False)
class Pair:
    """The query with one tile.

    Attributes:
        match: the tile in the ranking.
        picture: the tile as its parts are cut from it.
        evidence: None without a network.
    """

    match: Match
    picture: UInt8Array
    evidence: Evidence | None


@dataclass(frozen=True, eq=False)
class Case:
    """One query.

    Attributes:
        name: of the query.
        known: whether its place is known, though the gallery may have no tile of it.
        facts: name and value of each thing known of its picture.
        picture: the query as its parts are cut from it.
        ranking: the whole gallery.
        matches: the nearest tiles, and after them the nearest true one where it is not among them.
        metres: from what the query shows to each of the matches; None where that is not known.
        truth: the nearest true tile; None where there is none or it is not known.
        rival: the nearest tile that is not true; None where truth is not known or all are true.
        pairs: the tile looked at, then its opponent: the nearest true tile, or where that is looked at, the nearest false one.
        margin: of the true tile of the two over the false one; None where there are not both.
        without: where the truth would stand with other parts; None where there is none.
        change: the smallest change of part weights that puts the truth first; None where there is none, or it is first.
        effect: what that change does to all queries of the task.
        profile: over the circle; None where it was not asked for.
    """

    name: str
    known: bool
    facts: list[tuple[str, str]]
    picture: UInt8Array
    ranking: Ranking
    matches: list[Match]
    metres: list[float] | None
    truth: Match | None
    rival: Match | None
    pairs: tuple[Pair, ...]
    margin: Margin | None
    without: Without | None
    change: Reweighting | None
    effect: Effect | None
    profile: Profile | None

    @property
    def verdict(self) -> bool | None:
        """Whether the top match is true; None where that is not known."""
        return self.matches[0].true if self.known else None


class Cases:
    """Makes the cases of one report, keeping what they share."""

    def __init__(self, task: Task, options: Options) -> None:
        if options.against is not None and not 0 <= options.against < len(task.gallery):
            raise InputError(
                f"There is no gallery picture {options.against}; the gallery has positions 0 to {len(task.gallery) - 1}."
            )
        if task.model is None and (options.profile or options.change):
            raise InputError(
                f"{task.model_name} holds descriptors without their network: queries cannot be turned, so leave the profile "
                "and changes out."
            )
        self._task, self._options = task, options
        self._positions = geo.positions(task.root)
        self._tile = lru_cache(maxsize=64)(self._describe_tile)
        turns = sweeps.changes_over("rotation", options.step) if options.profile else []
        self.turns = sweeps.around("rotation", options.change, turns) if turns else []

    def make(self, query: int | Own, tick: Callable[[], None]) -> Case:
        """Everything about one query; `tick` is called after it and after each step of its profile."""
        task, options = self._task, self._options
        index = None if isinstance(query, Own) else query
        name, picture = self._opened(query)
        seen = self._described(picture, index)
        ranking = task.rank(index, scoring.part_cosines(seen.descriptor, task.gallery_descriptors), task.part_weights)
        if not len(ranking.order):
            raise InputError(f"No tile is left to rank for {name}; its gallery holds junk alone.")
        truth = ranking.truth()
        first = ranking.match(0)
        if options.against is not None and ranking.holds(options.against):
            first = ranking.find(options.against)
        matches = ranking.top(options.matches)
        if truth is not None and truth.rank > len(matches):
            matches.append(truth)
        rival = None if ranking.relevant is None else nearest_wrong(ranking)
        other = rival if first.true else truth
        margin = None
        if other is not None:
            true, wrong = (first, other) if first.true else (other, first)
            margin = counterfactual.margin(ranking, true.index, wrong.index)
        change = None if truth is None or truth.rank == 1 else counterfactual.smallest_change(ranking)
        case = Case(
            name=name,
            known=index is not None,
            facts=self._facts(index),
            picture=self._cut(seen.picture, 0),
            ranking=ranking,
            matches=matches,
            metres=self._metres(index, matches),
            truth=truth,
            rival=rival,
            pairs=tuple(self._pair(seen, match) for match in (first, other) if match is not None),
            margin=margin,
            without=counterfactual.without(ranking),
            change=change,
            effect=None if change is None else self._effect(change),
            profile=self._profile(picture, index, first, tick),
        )
        tick()
        return case

    def _opened(self, query: int | Own) -> tuple[str, UInt8Array]:
        if isinstance(query, Own):
            return query.name, query.picture
        if not 0 <= query < len(self._task.queries):
            raise InputError(f"There is no query {query}; they have positions 0 to {len(self._task.queries) - 1}.")
        entry = self._task.queries[query]
        return entry.name, shown(entry)

    def _described(self, picture: UInt8Array, index: int | None) -> DescribedPicture:
        task = self._task
        if task.model is None:
            if index is None:
                raise InputError(
                    f"{task.model_name} holds descriptors without their network; choose a query of its own."
                )
            return DescribedPicture(picture, task.query_descriptors[index], None, None)
        change = self._options.change.for_picture(task.queries[index or 0])
        return retrieval.describe_picture(task.model, picture, task.views[0], change)

    def _describe_tile(self, index: int) -> DescribedPicture:
        task = self._task
        picture = shown(task.gallery[index])
        if task.model is None:
            return DescribedPicture(picture, task.gallery_descriptors[index], None, None)
        return retrieval.describe_picture(task.model, picture, task.views[1])

    def _cut(self, picture: UInt8Array, side: int) -> UInt8Array:
        task = self._task
        return picture if task.model is None else task.model.as_partitioned(picture, task.views[side])

    def _pair(self, seen: DescribedPicture, match: Match) -> Pair:
        tile = self._tile(match.index)
        evidence = None
        if seen.trace is not None and tile.trace is not None:
            evidence = explain.evidence(seen.trace, tile.trace, self._task.part_weights)
        return Pair(match, self._cut(tile.picture, 1), evidence)

    def _facts(self, index: int | None) -> list[tuple[str, str]]:
        if index is None:
            return []
        table = self._task.table
        names = [column.name for column in described_by(table)] + [TAGS, NOTE]
        columns = [table.columns[name] for name in names if name in table.columns]
        return [
            (column.name, column.text(index) + (column.unit if column.unit == "°" else f" {column.unit}").rstrip())
            for column in columns
            if column.known[index]
        ]

    def _metres(self, index: int | None, matches: list[Match]) -> list[float] | None:
        if self._positions is None or index is None:
            return None
        here = self._positions.of([self._task.queries[index]])
        tiles = self._positions.of([self._task.gallery[match.index] for match in matches])
        return [float(value) for value in geo.metres(here * len(tiles), tiles)]

    def _effect(self, change: Reweighting) -> Effect:
        task = self._task
        return counterfactual.effect(
            task.query_descriptors,
            task.gallery_descriptors,
            task.weights,
            change.weights,
            task.query_labels,
            task.gallery_labels,
            task.truth,
            task.outcomes.rank,
        )

    def _profile(
        self, picture: UInt8Array, index: int | None, first: Match, tick: Callable[[], None]
    ) -> Profile | None:
        task, options = self._task, self._options
        if not self.turns or task.model is None:
            return None
        change = options.change
        entry = task.queries[index or 0]
        turns = [turn.for_picture(entry) for turn in self.turns]
        label = None if index is None else int(task.query_labels[index])
        truth = None if index is None or task.truth is None else task.truth[index]
        follow = first.index if index is None else None
        points = []
        for point in sweeps.profile(
            task.model,
            picture,
            task.views[0],
            task.gallery_descriptors,
            task.part_weights,
            turns,
            task.gallery_labels,
            label,
            truth,
            follow,
        ):
            points.append(point)
            tick()
        return Profile("rotation", tuple(points), change.for_picture(entry))


def shown(entry: Picture) -> UInt8Array:
    """What is meant of a picture file."""
    picture = images.load_picture(entry.path)
    return images.crop(picture, entry.box, entry.name)
