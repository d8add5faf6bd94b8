"""Models on the same queries and the same gallery: figures with intervals, groups of runs, and paired tests."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from itertools import combinations
from typing import Any, ClassVar

import numpy as np

from lpn.analysis.statistics import LEVEL, RESAMPLES, Estimate, holm, intervals, randomization_test, welch_test
from lpn.core.arrays import Float64Array
from lpn.core.errors import InputError
from lpn.core.files import printable
from lpn.core.text_tables import TextTable
from lpn.core.texts import counted
from lpn.tasks.measure import RankedModel, Result, scored_names

DEPTHS = (1, 5, 10)
# Values of queries that differ by less count as equal, because sums over runs have rounding errors.
_EQUAL = 1e-9
_P_VALUES = ("p", "Holm's p", "seeds' p", "Holm's seeds' p")


@dataclass(frozen=True)
class PairedTest:
    """Two groups under one figure.

    Attributes:
        first, second: their names.
        figure: such as "R@1".
        difference: first minus second in percentage points.
        first_better, second_better: numbers of queries on which the first, or the second, is better.
        p: p-value of the paired randomization test over places.
        holm: p adjusted for all pairs under this figure.
        seeds_p, seeds_holm: p and adjusted p of Welch's t-test over runs; None unless both groups have several.
    """

    first: str
    second: str
    figure: str
    difference: Estimate
    first_better: int
    second_better: int
    p: float
    holm: float | None
    seeds_p: float | None
    seeds_holm: float | None


@dataclass(frozen=True, eq=False)
class ModelTable:
    """Models that ranked the same queries in one gallery.

    Attributes:
        task, gallery_name: common to all.
        models: rankings, their queries in one order.
        group_of: the group of each model, such as a method with runs of several seeds; by default the model's name.
        seed, resamples: of the bootstrap.
    """

    title: ClassVar[str] = "Models compared"

    task: str
    gallery_name: str
    models: tuple[RankedModel, ...]
    group_of: tuple[str, ...]
    seed: int
    resamples: int

    @property
    def queries(self) -> int:
        """Number of queries."""
        return len(self.models[0].queries)

    @property
    def groups(self) -> dict[str, list[int]]:
        """The rows of the models of each group."""
        names = dict.fromkeys(self.group_of)
        return {name: [row for row, of in enumerate(self.group_of) if of == name] for name in names}

    @cached_property
    def _values(self) -> dict[str, Float64Array]:
        precision = np.stack([one.precision for one in self.models])
        hits = {
            f"R@{depth}": np.stack([one.within(depth) for one in self.models]).astype(np.float64) for depth in DEPTHS
        }
        return hits if np.isnan(precision).any() else hits | {"AP": precision}

    @cached_property
    def _means(self) -> dict[str, Float64Array]:
        """The mean of each group's runs, by figure."""
        rows = self.groups.values()
        return {name: np.array([values[of].mean(axis=0) for of in rows]) for name, values in self._values.items()}

    def _intervals(self, values: Float64Array) -> list[Estimate]:
        return intervals(values, self.models[0].labels, self.seed, self.resamples)

    def _of_runs(self, figure: str, rows: list[int]) -> Float64Array:
        return np.asarray(100 * self._values[figure][rows].mean(axis=1))

    @cached_property
    def figures(self) -> list[dict[str, Estimate]]:
        """The `R@1`, `R@5`, `R@10`, and `AP` of each group in percent; without `AP` if a ranking is incomplete."""
        estimates = {figure: self._intervals(values) for figure, values in self._means.items()}
        return [
            {
                figure: replace(of[group], sd=float(self._of_runs(figure, rows).std(ddof=1)) if rows[1:] else None)
                for figure, of in estimates.items()
            }
            for group, rows in enumerate(self.groups.values())
        ]

    @cached_property
    def tests(self) -> list[PairedTest]:
        """Paired tests of every two groups, on R@1 and, if rankings are complete, on AP."""
        names, rows = [*self.groups], [*self.groups.values()]
        pairs, found = list(combinations(range(len(names)), 2)), list[PairedTest]()
        for figure in [name for name in ("R@1", "AP") if pairs and name in self._means]:
            differences = np.stack([self._means[figure][a] - self._means[figure][b] for a, b in pairs])
            p = randomization_test(differences, self.models[0].labels, self.seed)
            seeds_p = [welch_test(*(self._of_runs(figure, rows[group]) for group in pair)) for pair in pairs]
            better = ((sign * differences > _EQUAL).sum(axis=1).tolist() for sign in (1, -1))
            columns = (pairs, self._intervals(differences), *better, p, holm(p), seeds_p, holm(seeds_p))
            found += [PairedTest(names[a], names[b], figure, *of) for (a, b), *of in zip(*columns, strict=True)]
        return found

    @property
    def sentence(self) -> str:
        """The method behind the figures, in words."""
        places, groups = len(np.unique(self.models[0].labels)), len(self.groups)
        pairs, grouped = groups * (groups - 1) // 2, groups < len(self.models)
        sentences = [
            f"{self.task}, {self.gallery_name} pictures ranked for {counted(self.queries, 'query')} of "
            f"{counted(places, 'place')}. Intervals contain {100 * LEVEL:.0f} % of {self.resamples} bootstrap means over places, "
            f"seed {self.seed}; they cover the choice of places, not that of training seeds."
        ]
        if grouped:
            sentences.append(
                "A group shows the mean of its runs ± their standard deviation (n - 1); its interval is that of this mean."
            )
        if pairs:
            sentences.append(
                "p is of a two-sided paired randomization test. It swaps two models on whole places, as queries of one place "
                f"are not independent. Holm's p allows for {counted(pairs, 'pair')} under each figure."
            )
        if grouped and pairs:
            sentences.append(
                "For groups, p applies to these runs on other places. The seeds' p, of Welch's t-test over runs, applies to "
                "other runs on these places. A difference of two methods should pass both tests."
            )
        return " ".join(sentences)

    def to_dict(self) -> dict[str, Any]:
        """The comparison as JSON values."""
        models = []
        for (name, rows), figures in zip(self.groups.items(), self.figures, strict=True):
            runs = {figure: self._of_runs(figure, rows).tolist() for figure in figures}
            names = {"runs": {"names": [self.models[row].name for row in rows], **runs}} if rows[1:] else {}
            models.append({"name": name, **{figure: vars(of) for figure, of in figures.items()}, **names})
        return {
            **{"task": self.task, "gallery": self.gallery_name, "queries": self.queries},
            "places": len(np.unique(self.models[0].labels)),
            "bootstrap": {"seed": self.seed, "resamples": self.resamples, "level": LEVEL},
            "models": models,
            "tests": [asdict(test) for test in self.tests],
            "protocol": self.sentence,
        }

    @property
    def printed(self) -> list[TextTable]:
        """A table of figures, one of paired tests, and the sentence."""
        rows = [(name, *map(str, of.values())) for name, of in zip(self.groups, self.figures, strict=True)]
        title = f"{self.task}, {self.gallery_name}"
        figures = TextTable(("model", *self.figures[0]), rows, title)
        if not self.tests:
            return [replace(figures, after=self.sentence)]
        names = _P_VALUES if any(test.seeds_p is not None for test in self.tests) else _P_VALUES[:2]
        tests = []
        for test in self.tests:
            p = (test.p, test.holm, test.seeds_p, test.seeds_holm)[: len(names)]
            counts = map(str, (test.difference, test.first_better, test.second_better))
            row = (test.first, test.second, test.figure, *counts)
            tests.append((*row, *("-" if value is None else f"{value:.3g}" for value in p)))
        head = ("A", "B", "figure", "A minus B", "A better", "B better", *names)
        return [figures, TextTable(head, tests, f"{title}. Paired tests", self.sentence, "lllr")]

    def to_csv(self) -> bytes:
        """Return the table in the format of `comparisons_csv`."""
        return comparisons_csv([self])

    def _csv_rows(self) -> Iterator[tuple[str, ...]]:
        lines: list[tuple[str, str, str, Estimate, tuple[float | None, ...]]] = [
            (name, "", figure, estimate, (None,) * 4)
            for name, of in zip(self.groups, self.figures, strict=True)
            for figure, estimate in of.items()
        ]
        lines += [
            (t.first, t.second, t.figure, t.difference, (t.p, t.holm, t.seeds_p, t.seeds_holm)) for t in self.tests
        ]
        for first, second, figure, of, p in lines:
            values = ("" if value is None else f"{value:.6g}" for value in (*vars(of).values(), *p))
            yield (first, second, self.task, self.gallery_name, str(self.queries), figure, *values)


def comparisons_csv(tables: Sequence[ModelTable]) -> bytes:
    """Return one line for each group and figure, and one for each pair and tested figure, with the difference as its value."""
    head = ("model", "against", "task", "gallery", "queries", "figure", "value", "low", "high", "sd", *_P_VALUES)
    return TextTable(head, [row for table in tables for row in table._csv_rows()]).csv()


def compare(
    results: Sequence[Result | RankedModel], seed: int = 0, resamples: int = RESAMPLES, groups: Sequence[str] = ()
) -> ModelTable:
    """Compare two or more models on the same queries and gallery.

    Args:
        results: results of `lpn.evaluate` on the full gallery, labelled by model and scoring; or rankings.
        seed, resamples: of the bootstrap.
        groups: the group of each model, such as the method of several runs; each model by itself by default.

    Raises:
        InputError: when there are fewer than two models, names repeat, no query's truth is known, or tasks, galleries, queries,
            or the orders of repeated queries differ. Also when the numbers of groups and of models differ.
    """
    models = list[RankedModel]()
    given = results if isinstance(results, Collection) else [results]
    scored = [(one.name, one.calibration, one.neighbours) for one in given if isinstance(one, Result)]
    names = iter(scored_names(scored))
    for one in given:
        if not isinstance(one, Result | RankedModel):
            raise InputError(
                f"One of the results is of the type {type(one).__name__}; expected results of lpn.evaluate."
            )
        if isinstance(one, Result):
            one = replace(one.ranked(), name=next(names))
        models.append(one)
    if len(models) < 2:
        raise InputError(f"A comparison takes two models or more; found {len(models)}.")
    if not (seed >= 0 and 1 <= resamples <= 1_000_000):
        raise InputError(
            f"Seed and resamples are {seed} and {resamples}; expected a seed from 0 and 1 to 1,000,000 resamples."
        )
    if len({one.name for one in models}) < len(models):
        raise InputError(f"The models are called {', '.join(one.name for one in models)}; expected different names.")
    if groups and len(groups) != len(models):
        raise InputError(
            f"Found {counted(len(groups), 'group')} for {counted(len(models), 'model')}; name the group of each model in their "
            "order, the same for runs of one method."
        )
    first = models[0]
    if not first.queries:
        raise InputError(f"The true place of no query of {first.name} is known, so there is nothing to compare.")
    for other in models[1:]:
        if other.task != first.task:
            raise InputError(
                f"{first.name} ranked {first.task}, and {other.name} {other.task}; compare models on one task."
            )
        if other.gallery != first.gallery or other.gallery_name != first.gallery_name:
            raise InputError(
                f"{first.name} ranked the {first.gallery_name}, and {other.name} the {other.gallery_name}"
                f"{'' if other.gallery_name != first.gallery_name else ' of other pictures'}; figures on two galleries do not "
                "compare."
            )
        if Counter(other.queries) != Counter(first.queries):
            raise InputError(
                f"{first.name} has {len(first.queries)} queries, and {other.name} {len(other.queries)}, which are not the same; "
                "compare models on the same queries."
            )
        repeated = next((name for name, count in Counter(first.queries).items() if count > 1), None)
        if other.queries != first.queries and repeated is not None:
            raise InputError(
                f"{first.name} and {other.name} have their queries in different orders, and {printable(repeated)} is among them "
                "more than once; save both in one order."
            )
    ordered = tuple(one.in_order(first.queries) for one in models)
    group_of = tuple(map(printable, groups)) or tuple(one.name for one in models)
    return ModelTable(first.task, first.gallery_name, ordered, group_of, seed, resamples)
