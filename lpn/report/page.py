"""The page of a report: the figures, a table of contents, and a section for each query."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import closing
from datetime import datetime

import lpn
from lpn.core.errors import InputError
from lpn.core.texts import counted
from lpn.drawing import verdicts
from lpn.library.analyser import OwnPicture
from lpn.library.answer import Answer
from lpn.report._rendering import render, style_sheet, thumbnail
from lpn.report.cases import Cases, Options
from lpn.report.sections import section
from lpn.tasks.measure import sentence
from lpn.tasks.task import Task

# Maximum of queries in one report; browsers open larger files slowly.
MOST = 200


def build(
    task: Task,
    queries: Sequence[int | OwnPicture | Answer],
    options: Options | None = None,
    progress: Callable[[int, int], None] | None = None,
    made: datetime | None = None,
) -> bytes:
    """Build a report: a UTF-8 HTML file with its pictures inside, about 0.15 MB for each query.

    Each query and each compared tile is described once, several together.

    Args:
        queries: positions among the task's queries, users' pictures, or answers, in the order of the report.
        progress: called after each query with the numbers of finished and of all queries; its exception ends the work.
        made: date and time in the report, by default now.

    Raises:
        InputError: when there are no queries, more than 200, or one that does not exist.
        LPNError: when a picture or a file of the data set cannot be read.
    """
    options = options or Options()
    if not 1 <= len(queries) <= MOST:
        raise InputError(f"{len(queries)} queries are chosen; a report holds 1 to {MOST}, so choose others.")
    cases, task = Cases(task, options), task.without_truth(options.doubtful)
    lines, sections, signs, own = [], [], [], False
    with closing(cases.make(queries)) as made_cases:
        for number, case in enumerate(made_cases, 1):
            # A case holds pictures and a whole ranking, so only its HTML is stored.
            lines.append(render("line.html.j2", number=number, case=case, thumbnail=thumbnail(case.answer.source)))
            sections.append(section(case, number))
            signs.append(case.answer.verdict.sign)
            own = own or case.answer.index is None
            if progress is not None:
                progress(number, len(queries))
    graded = 0 if options.title else int(task.metrics["queries"])
    return render(
        "report.html.j2",
        style=style_sheet(),
        data_name=task.data_name,
        task=task,
        noun=task.contract.part_noun,
        gallery=verdicts.pictures_of(task),
        options=options,
        # A share of selected pictures, such as the worst ones, would be read as the accuracy.
        complete=len(queries) == len(task.queries),
        found=signs.count(True),
        graded=len(signs) - signs.count(None),
        queries=f"{graded:,}{'' if graded == len(task.queries) else ' graded'}",
        own=own,
        figures=[] if options.title else _figures(task),
        facts=_facts(task, options, len(queries), made or datetime.now().astimezone()),
        lines=lines,
        sections=sections,
    ).encode()


def _figures(task: Task) -> list[tuple[str, float, str]]:
    """List the results of all queries as names, percentages, and meanings; empty if no query's place is known."""
    if not task.metrics["queries"]:
        return []
    return [
        ("R@1", task.metrics["recall@1"], "truth first"),
        ("R@5", task.metrics["recall@5"], "among the first 5"),
        ("R@10", task.metrics["recall@10"], "among the first 10"),
        ("AP", task.metrics["ap"], "mean average precision"),
    ]


def _facts(task: Task, options: Options, count: int, made: datetime) -> list[tuple[str, str]]:
    """List the subject of the report as names and values."""
    facts = [
        ("Model", task.model_name),
        ("", "saved descriptors, no network" if task.model is None else task.model.describe()),
    ]
    if task.model is not None:
        facts.append(("Fingerprint", task.model.fingerprint))
    pieces = ", pieces of the map" if task.of_map else ""
    chosen = f", {options.selection}" if options.selection else ""
    known = task.known
    certain = ", for certain" if options.doubtful else ""
    graded = (
        "" if known is None or known.all() else f" ({int(known.sum()):,} of known place{certain}, which are graded)"
    )
    facts += [
        ("Data", task.data_name),
        ("Task", f"{task.name}: {counted(len(task.queries), 'query')}{graded}, {task.gallery_description}{pieces}"),
        ("Protocol", sentence(task).removeprefix("Protocol: ")),
        ("In this report", f"{counted(count, 'query')}{chosen}"),
    ]
    if options.change:
        facts.append(("Changed", f"queries {options.change.describe()} first, in this report only"))
    return [*facts, ("Made", f"{made:%Y-%m-%d %H:%M %Z} by LPN Explorer {lpn.__version__}")]
