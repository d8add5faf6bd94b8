"""The page of a report: what was measured, a table of contents, and a section for each query."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from datetime import datetime

import lpn
from lpn.analysis.task import Study
from lpn.core import images
from lpn.core.errors import InputError
from lpn.report.cases import Case, Cases, Options, Own, shown
from lpn.report.figures import text
from lpn.report.sections import KINDS, parts_legend, said, section, sign, thumbnail
from lpn.report.style import STYLE
from lpn.retrieval import protocol

MOST = 200
"""Queries in one report; more make a file that browsers open slowly."""
_POLICY = "default-src 'none'; img-src data:; style-src 'unsafe-inline'"


def build(
    study: Study,
    queries: Sequence[int | Own],
    options: Options | None = None,
    progress: Callable[[int, int], None] | None = None,
    made: datetime | None = None,
) -> bytes:
    """A report as a file's contents: UTF-8 html with its pictures inside.

    About 0.2 MB for each query; one forward pass for each query and each tile compared, and with a profile one more for each
    of its steps.

    Args:
        study: model, data, and task.
        queries: positions among the study's queries, or pictures of one's own, in the order of the report.
        options: what is shown.
        progress: told after each step how many are done, and of how many; what it raises ends the work.
        made: date and time that the report bears, now by default.

    Raises:
        InputError: when there are no queries, more than 200, or one that does not exist.
        LPNError: when a picture or a file of the data set cannot be read.
    """
    options = options or Options()
    if not 1 <= len(queries) <= MOST:
        raise InputError(f"{len(queries)} queries are chosen; a report holds 1 to {MOST}, so choose others.")
    cases = Cases(study, options)
    done, steps = 0, len(queries) * (1 + len(cases.turns))

    def tick() -> None:
        nonlocal done
        done += 1
        if progress is not None:
            progress(done, steps)

    lines, sections, decided = [], [], []
    for number, query in enumerate(queries, 1):
        case = cases.make(query, tick)
        # A case holds pictures and a whole ranking; only its html is kept.
        decided.append(_decides(case, study))
        lines.append(_line(case, study, query, number, decided[-1]))
        sections.append(section(case, study, number))
    head = _head(study, options, len(queries), made or datetime.now().astimezone())
    contents = _contents(lines, decided)
    title = f"{study.data_name}, {study.task}: {len(queries)} queries"
    page = (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f'<meta http-equiv="Content-Security-Policy" content="{_POLICY}">'
        f"<title>{text(title)}</title><style>{STYLE}</style></head>\n"
        f'<body id="top">{head}{contents}\n{chr(10).join(sections)}\n</body></html>\n'
    )
    return page.encode()


def _head(study: Study, options: Options, count: int, made: datetime) -> str:
    figures = study.figures
    tiles = "".join(
        f"<div><b>{figures[key]:.1f} %</b>{name}<small>{meant}</small></div>"
        for name, key, meant in (
            ("R@1", "recall@1", "true tile first"),
            ("R@5", "recall@5", "among the first 5"),
            ("R@10", "recall@10", "among the first 10"),
            ("AP", "ap", "mean average precision"),
        )
    )
    mirrored = "descriptors of picture and mirror added, " if study.spec.mirrored else ""
    clauses = ["descriptors as saved"] if study.model is None else [f"{mirrored}each part normalised"]
    if study.weights is not None:
        clauses.append("part weights " + " : ".join(f"{100 * weight:.0f}" for weight in study.used) + " %")
    parts = tuple(range(1, study.spec.n_parts + 1))
    rule = protocol.sentence(clauses, parts, len(parts), listed=study.truth is not None)
    facts = [
        ("Model", study.model_name),
        ("", "saved descriptors, no network" if study.model is None else study.model.describe()),
        *([] if study.model is None else [("Fingerprint", study.model.fingerprint)]),
        ("Data", study.data_name),
        ("Task", f"{study.task}: {len(study.queries):,} queries, {len(study.gallery):,} tiles"),
        ("Protocol", rule.removeprefix("Protocol: ")),
        (
            "In this report",
            f"{count} {'query' if count == 1 else 'queries'}{f', {options.chosen}' if options.chosen else ''}",
        ),
        *([("Changed", f"queries {options.change.describe()} first, in this report only")] if options.change else []),
        ("Made", f"{made:%Y-%m-%d %H:%M %Z} by LPN Explorer {lpn.__version__}"),
    ]
    listed = "".join(f"<dt>{text(name)}</dt><dd>{text(value)}</dd>" for name, value in facts)
    return (
        f'<h1>Retrieval report</h1><p class="dim">{text(study.data_name)}, {text(study.task)}</p>'
        f'<div class="figures num" aria-label="of all queries">{tiles}</div><dl class="facts">{listed}</dl>{_how(study)}'
    )


def _how(study: Study) -> str:
    """How to read a section, for people who see such a report for the first time."""
    gallery = study.views[1]
    return (
        '<div class="keep"><h3>How to read it</h3><p>Each query picture is compared with every '
        f"{gallery} tile. The network cuts both into {study.spec.n_parts} parts and compares part with part; d² is the squared "
        "distance, the sum of the parts' shares, and the tile with the smallest one comes first. "
        f"{sign(True)} and a yellow frame mark a tile of the query's place, {sign(False)} and a blue one any other.</p>"
        f"{parts_legend(study.part_names)}</div>"
    )


def _line(case: Case, study: Study, query: int | Own, number: int, part: str) -> str:
    """One line of the table of contents."""
    picture = query.picture if isinstance(query, Own) else shown(study.queries[query])
    first, truth = case.matches[0], case.truth
    tiles = [first] if truth is None or truth.rank == 1 else [first, truth]
    cells = [
        f"<td>{thumbnail(images.load_picture(study.gallery[match.index].path))}</td>"
        f"<td>{sign(match.true)} {text(study.gallery[match.index].name)}</td>"
        for match in tiles
    ]
    cells += ["<td></td><td></td>"] * (2 - len(tiles))
    rank = "–" if truth is None else f"{truth.rank:,}"
    margin = "–" if case.margin is None else f"{case.margin.distance2.sum():+.3f}"
    return (
        f'<tr><td class="r">{number}</td><td>{thumbnail(picture)}</td><td class="{KINDS[case.verdict]}">{sign(case.verdict)} '
        f'<a href="#q{number}" title="{text(said(case, study)[0])}">{text(case.name)}</a></td>{"".join(cells)}'
        f'<td class="r">{rank}</td><td class="r">{margin}</td><td>{text(part or "–")}</td></tr>'
    )


def _decides(case: Case, study: Study) -> str:
    """The part that costs the truth most, or where it is nearer, that helps it most; "–" without a margin."""
    if case.margin is None:
        return "–"
    steps = case.margin.parts
    return study.part_names[int(steps.argmax() if case.margin.score >= 0 else steps.argmin())]


def _contents(lines: Sequence[str], decided: Sequence[str]) -> str:
    counts = Counter(decided).most_common()
    counted = ", ".join(f"{part} in {count}" for part, count in counts if part != "–")
    summary = f'<p class="note">Part that decides: {text(counted)}.</p>' if len(lines) > 1 and counted else ""
    return (
        '<h3>Contents</h3><div class="wide"><table class="contents"><thead><tr><th></th><th></th><th>query</th>'
        '<th></th><th>top match</th><th></th><th>true tile, if another</th><th class="r">its rank</th>'
        '<th class="r">margin, d²</th><th>part that decides</th></tr></thead>'
        f"<tbody>{''.join(lines)}</tbody></table></div>{summary}"
    )
