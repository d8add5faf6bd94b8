"""The page of a report: what was measured, a table of contents, and a section for each query."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import datetime

import lpn
from lpn.core.errors import InputError
from lpn.drawing import verdicts
from lpn.library.analyser import OwnPicture
from lpn.report._rendering import render, style_sheet, thumbnail
from lpn.report.cases import Case, Cases, Options
from lpn.report.sections import section, summary
from lpn.retrieval import protocol
from lpn.tasks.task import Task

# Queries in one report; browsers open the file of more of them slowly.
MOST = 200


@dataclass(frozen=True)
class _ContentsTile:
    """A tile named in the table of contents."""

    verdict: bool | None
    thumbnail: str
    name: str


@dataclass(frozen=True)
class _ContentsLine:
    """One query in the table of contents: its tiles, the rank of the positive, and the margin."""

    verdict: bool | None
    thumbnail: str
    name: str
    headline: str
    tiles: list[_ContentsTile]
    rank: int | None
    margin: float | None


def build(
    task: Task,
    queries: Sequence[int | OwnPicture],
    options: Options | None = None,
    progress: Callable[[int, int], None] | None = None,
    made: datetime | None = None,
) -> bytes:
    """Build a report: a UTF-8 HTML file with its pictures inside, about 0.2 MB for each query.

    Each query and each compared tile takes one forward pass.

    Args:
        queries: positions among the task's queries, or pictures that are no queries, in the order of the report.
        progress: called after each query with the numbers of finished and of all queries; what it raises ends the work.
        made: date and time that the report bears, by default now.

    Raises:
        InputError: when there are no queries, more than 200, or one that does not exist.
        LPNError: when a picture or a file of the data set cannot be read.
    """
    options = options or Options()
    if not 1 <= len(queries) <= MOST:
        raise InputError(f"{len(queries)} queries are chosen; a report holds 1 to {MOST}, so choose others.")
    shown, task = task.without_truth(options.ungraded), task.without_truth(options.doubtful)
    cases = Cases(shown, options)
    lines, sections = [], []
    for number, query in enumerate(queries, 1):
        case = cases.make(query)
        # A case holds pictures and a whole ranking, so only its HTML is kept.
        lines.append(_line(case, shown, query))
        sections.append(section(case, shown, number))
        if progress is not None:
            progress(number, len(queries))
    graded = int(task.metrics["queries"])
    return render(
        "report.html.j2",
        style=style_sheet(),
        data_name=task.data_name,
        task=task.name,
        tiles=(f"{task.tiles:,}", verdicts.pictures_of(task)),
        selection=options.selection,
        # A share of chosen pictures, such as the worst ones, would be read as the accuracy.
        complete=len(queries) == len(task.queries),
        right=sum(line.verdict is True for line in lines),
        graded=sum(line.verdict is not None for line in lines),
        doubtful=bool(options.doubtful),
        part_names=task.part_names,
        said=options.said,
        queries=f"{graded:,}{'' if graded == len(task.queries) else ' graded'}",
        own=any(isinstance(query, OwnPicture) for query in queries),
        figures=_figures(task),
        facts=_facts(task, options, len(queries), made or datetime.now().astimezone()),
        lines=lines,
        sections=sections,
    ).encode()


def _figures(task: Task) -> list[tuple[str, float, str]]:
    """List the results of all queries as names, percentages, and meanings; empty if no query's place is known."""
    if not task.metrics["queries"]:
        return []
    figures = [
        ("R@1", task.metrics["recall@1"], "true tile first"),
        ("R@5", task.metrics["recall@5"], "among the first 5"),
        ("R@10", task.metrics["recall@10"], "among the first 10"),
        ("AP", task.metrics["ap"], "mean average precision"),
    ]
    # AP needs all ranks, and a search returns only the first.
    return [figure for figure in figures if not math.isnan(figure[1])]


def _gallery(task: Task) -> str:
    tiles = f"{len(task.gallery):,} tiles" if task.lists_gallery else task.gallery_description
    return f"{tiles}, pieces of the map" if task.of_map else tiles


def _facts(task: Task, options: Options, count: int, made: datetime) -> list[tuple[str, str]]:
    """List what the report is about as names and values."""
    mirrored = "descriptors of picture and mirror added, " if task.contract.mirror == "sum" else ""
    normalised = f"{'each part ' if task.contract.n_parts > 1 else ''}normalised"
    clauses = ["descriptors as saved"] if task.model is None else [f"{mirrored}{normalised}"]
    if task.weights is not None:
        clauses.append("part weights " + " : ".join(f"{100 * weight:.0f}" for weight in task.part_weights) + " %")
    clauses += [] if task.calibration is None else [task.calibration.describe()]
    parts = tuple(range(1, task.contract.n_parts + 1))
    rule = protocol.sentence(clauses, parts, len(parts), listed=task.truth is not None, neighbours=task.neighbours)
    facts = [
        ("Model", task.model_name),
        ("", "saved descriptors, no network" if task.model is None else task.model.describe()),
    ]
    if task.model is not None:
        facts.append(("Fingerprint", task.model.fingerprint))
    chosen = f", {options.selection}" if options.selection else ""
    known = task.known
    certain = ", for certain" if options.doubtful else ""
    graded = (
        "" if known is None or known.all() else f" ({int(known.sum()):,} of known place{certain}, which are graded)"
    )
    facts += [
        ("Data", task.data_name),
        ("Task", f"{task.name}: {len(task.queries):,} queries{graded}, {_gallery(task)}"),
        ("Protocol", rule.removeprefix("Protocol: ")),
        ("In this report", f"{count} {'query' if count == 1 else 'queries'}{chosen}"),
    ]
    if options.said:
        facts += options.said.map
    if options.change:
        facts.append(("Changed", f"queries {options.change.describe()} first, in this report only"))
    return [*facts, ("Made", f"{made:%Y-%m-%d %H:%M %Z} by LPN Explorer {lpn.__version__}")]


def _line(case: Case, task: Task, query: int | OwnPicture) -> _ContentsLine:
    picture = query.picture if isinstance(query, OwnPicture) else task.queries[query].load_cropped()
    first, truth = case.matches[0], case.answer.positive
    tiles = [first] if truth is None or truth.rank == 1 else [first, truth]
    return _ContentsLine(
        case.answer.verdict.sign,
        thumbnail(picture),
        case.answer.name,
        summary(case)[0],
        [
            _ContentsTile(match.true, thumbnail(entry.load()), entry.name)
            for match, entry in ((match, task.gallery[match.index]) for match in tiles)
        ],
        None if truth is None else truth.rank,
        case.margin_shown,
    )
