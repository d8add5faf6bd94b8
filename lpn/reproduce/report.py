"""A measured table as Markdown, LaTeX, CSV, and a chart: measured values beside the paper's, and verdicts on its claims."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from lpn.core.files import write_atomic
from lpn.core.text_tables import TextTable, latex_page
from lpn.drawing.plots import encode, pyplot
from lpn.reproduce.claims import verdicts
from lpn.reproduce.record import TableRecord

_COLOURS = ("#1f5fbf", "#7fb2e5", "#c2571a", "#eba968")


def write(record: TableRecord, out: Path) -> list[Path]:
    """Write `<key>.md`, `<key>.csv`, `<key>.png`, and `<key>.tex` into a folder and return their paths."""
    files = [out / f"{record.key}.{suffix}" for suffix in ("md", "csv", "png", "tex")]
    write_atomic(files[0], markdown(record).encode())
    write_atomic(files[1], _csv(record))
    write_atomic(files[2], figure(record))
    after = " ".join((*record.notes, *verdicts(record)))
    write_atomic(files[3], latex_page([replace(text_table(record), after=after)]).encode())
    return files


def markdown(record: TableRecord) -> str:
    """Format the table, its notes, and the verdicts on the paper's claims."""
    after = "".join(f"{sentence}  \n" for sentence in record.notes)
    claims = "".join(f"- {claim}\n" for claim in verdicts(record))
    table = replace(text_table(record), after="\n".join(filter(None, (after, claims))).rstrip("\n"))
    return table.markdown(3).removesuffix("\n")


def text_table(record: TableRecord) -> TextTable:
    """Return the measured values, and the paper's beside them."""
    titles: list[str] = []
    # (True, i) is measured column i, (False, i) the paper's; the paper's without a neighbour come last.
    cells: list[tuple[bool, int]] = []
    any_paper = any(row.paper for row in record.rows)
    for index, (title, beside) in enumerate(zip(record.columns, record.beside, strict=True)):
        titles.append(title)
        cells.append((True, index))
        if any_paper and beside is not None:
            titles.append("paper")
            cells.append((False, beside))
    for index, title in record.alone.items():
        titles.append(f"paper, {title}")
        cells.append((False, index))
    rows = []
    for row in record.rows:
        texts = []
        # The reason stands once, in the first cell.
        lacking = "quoted" if row.quoted else f"not run: {row.reason}" if row.reason else "not run"
        for here, index in cells:
            if here:
                texts.append(_format(row.mean[index], row.interval[index]) if row.mean else lacking)
                lacking = "quoted" if row.quoted else "not run"
            else:
                printed = row.paper[index] if index < len(row.paper) else None
                # The paper prints a dash for what it does not know of a row.
                texts.append(f"{printed:.2f}" if printed is not None else "-" if row.paper else "")
        rows.append((row.title, *texts))
    return TextTable(("", *titles), rows, record.title)


def _format(mean: float, interval: float) -> str:
    return f"{mean:.2f} ± {interval:.2f}" if interval else f"{mean:.2f}"


def _csv(record: TableRecord) -> bytes:
    names = list(dict.fromkeys(name for row in record.rows for name in row.values))
    rows = []
    for row in record.rows:
        for index, (title, beside) in enumerate(zip(record.columns, record.beside, strict=True)):
            printed = row.paper[beside] if beside is not None and beside < len(row.paper) else None
            paper = "" if printed is None else str(printed)
            values = [f"{row.values[name][index]:.4f}" if name in row.values else "" for name in names]
            mean = f"{row.mean[index]:.4f}" if row.mean else ""
            rows.append([row.title, title, paper, mean, row.reason, *values])
    return TextTable(("row", "column", "paper", "mean", "not run", *names), rows).csv()


def figure(record: TableRecord) -> bytes:
    """Draw the table as a PNG: bars, or lines where the rows are steps of one quantity."""
    labels = [row.title for row in record.rows]
    steps = record.key in ("table3", "figure5")
    drawn, axes = pyplot().subplots(
        figsize=(8.2, 3.9) if steps else (8.2, 0.5 * len(labels) + 1.6), layout="constrained"
    )
    for index, (column, beside) in enumerate(zip(record.columns, record.beside, strict=True)):
        run = [(place, (row.mean[index], row.interval[index])) for place, row in enumerate(record.rows) if row.mean]
        paper = [
            (place, value)
            for place, row in enumerate(record.rows)
            if beside is not None and beside < len(row.paper) and (value := row.paper[beside]) is not None
        ]
        _draw(axes, steps, index, len(record.columns), column, _COLOURS[index % len(_COLOURS)], run, paper)
    if steps:
        axes.set_xticks(range(len(labels)), labels)
        axes.set_ylabel("%")
        axes.grid(axis="y", alpha=0.25)
    else:
        axes.set_yticks(range(len(labels)), labels)
        axes.invert_yaxis()
        axes.set_xlabel("%")
        axes.set_xlim(0, 100)
        axes.grid(axis="x", alpha=0.25)
    axes.set_title(record.title, loc="left", fontsize=11)
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(frameon=False, fontsize=8, loc="center left", bbox_to_anchor=(1, 0.5))
    return encode(drawn, 110)


def _draw(
    axes: Any,
    steps: bool,
    index: int,
    of: int,
    column: str,
    colour: str,
    run: Sequence[tuple[int, tuple[float, float]]],
    paper: Sequence[tuple[int, float]],
) -> None:
    """Draw one column: measured values filled, with their intervals, and the paper's hollow or dotted."""
    places = [place for place, _ in run]
    means, intervals = [value[0] for _, value in run], [value[1] for _, value in run]
    if steps:
        axes.errorbar(places, means, intervals, color=colour, marker="o", capsize=3, label=column)
        if paper:
            axes.plot(*zip(*paper, strict=True), color=colour, linestyle=":", marker="o", fillstyle="none", alpha=0.6,
                      label=f"{column}, paper")  # fmt: skip
        return
    height = 0.8 / of
    at = [place + (index - (of - 1) / 2) * height for place in places]
    axes.barh(at, means, height * 0.9, xerr=intervals if any(intervals) else None, color=colour, label=column)
    if paper:
        label = {"label": "the paper"} if index == of - 1 else {}
        where = [place + (index - (of - 1) / 2) * height for place, _ in paper]
        axes.plot([value for _, value in paper], where, "D", color="black", fillstyle="none", markersize=4, **label)
