"""A table as Markdown, CSV, and a chart: measured values beside the paper's, and verdicts on the paper's claims."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from lpn.core.files import write_atomic
from lpn.drawing.plots import png, pyplot
from lpn.reproduce.measure import Measured, by_column
from lpn.reproduce.paper_values import CLAIMS, Claim
from lpn.reproduce.tables import PaperTable

_COLOURS = ("#1f5fbf", "#7fb2e5", "#c2571a", "#eba968")


@dataclass(frozen=True)
class MeasuredColumn:
    """A measured column.

    Attributes:
        title: its name.
        paper: index of the paper's column beside it, None if there is none.
    """

    title: str
    paper: int | None


def write(
    table: PaperTable, measured: Measured, columns: Sequence[MeasuredColumn], foot: Sequence[str], out: Path
) -> list[Path]:
    """Write `<key>.md`, `<key>.csv`, and `<key>.png` into a folder and return their paths.

    Args:
        measured: the values of each network, for each row's label; other rows are shown as not run.
        columns: the measured columns.
        foot: the notes below the table.
    """
    files = [out / f"{table.key}.{suffix}" for suffix in ("md", "csv", "png")]
    write_atomic(files[0], markdown(table, measured, columns, foot).encode())
    write_atomic(files[1], _csv(table, measured, columns))
    write_atomic(files[2], figure(table, measured, columns))
    return files


def markdown(table: PaperTable, measured: Measured, columns: Sequence[MeasuredColumn], foot: Sequence[str]) -> str:
    """Format the table, its notes, and the verdicts on the paper's claims."""
    titles: list[str] = []
    # (True, i) is measured column i, (False, i) the paper's; the paper's without a neighbour come last.
    cells: list[tuple[bool, int]] = []
    any_paper = any(row.paper for row in table.rows)
    for index, column in enumerate(columns):
        titles.append(column.title)
        cells.append((True, index))
        if any_paper and column.paper is not None:
            titles.append("paper")
            cells.append((False, column.paper))
    if table.measure == "landmarks":
        beside = {column.paper for column in columns}
        for index, title in enumerate(table.columns):
            if index not in beside:
                titles.append(f"paper, {title}")
                cells.append((False, index))
    lines = [f"### {table.title}", "", "| | " + " | ".join(titles) + " |", "|---|" + "---:|" * len(titles)]
    for row in table.rows:
        values = by_column(list(measured[row.label].values())) if row.label in measured else None
        texts = []
        for here, index in cells:
            if here:
                texts.append("not run" if values is None else _format(*values[index]))
            else:
                texts.append(f"{row.paper[index]:.2f}" if index < len(row.paper) else "")
        lines.append(f"| {row.label} | " + " | ".join(texts) + " |")
    lines += ["", *(f"{sentence}  " for sentence in foot)]
    claims = verdicts(table, measured, columns)
    if claims:
        lines += ["", *(f"- {claim}" for claim in claims)]
    return "\n".join(lines) + "\n"


def verdicts(table: PaperTable, measured: Measured, columns: Sequence[MeasuredColumn]) -> list[str]:
    """State for each of the paper's claims whether it held, with the figures."""
    return [_verdict(claim, measured, columns) for claim in CLAIMS.get(table.key, ())]


def _verdict(claim: Claim, measured: Measured, columns: Sequence[MeasuredColumn]) -> str:
    labels = (claim.better, *claim.worse)
    missing = [label for label in labels if label not in measured]
    if missing:
        return f"{claim.text}: not known; {', '.join(missing)} was not run."
    index = min(claim.column, len(columns) - 1)
    mean = {label: by_column(list(measured[label].values()))[index] for label in labels}
    best, own = mean[claim.better]
    gaps = {label: best - mean[label][0] for label in claim.worse}
    figures = ", ".join(f"{label} {mean[label][0]:.1f}" for label in claim.worse)
    once = [label for label in labels if len(measured[label]) == 1]
    networks = (
        "" if not once else "; one network each" if len(once) == len(labels) else f"; one network of {', '.join(once)}"
    )
    comparison = f"{columns[index].title} {best:.1f} against {figures}{networks}"
    if claim.keeps:
        worst = max(gaps.values())
        verdict = "held" if worst <= claim.keeps else f"did not hold, {worst:.1f} points are lost"
        return f"{claim.text} (within {claim.keeps:g} points): **{verdict}** ({comparison})."
    if min(gaps.values()) <= 0:
        return f"{claim.text}: **did not hold** ({comparison})."
    close = [label for label in claim.worse if gaps[label] <= own + mean[label][1]]
    if close:
        return f"{claim.text}: **held in the mean, but within the spread of the seeds** for {', '.join(close)} ({comparison})."
    return f"{claim.text}: **held** ({comparison})."


def _format(mean: float, spread: float) -> str:
    return f"{mean:.2f} ± {spread:.2f}" if spread else f"{mean:.2f}"


def _csv(table: PaperTable, measured: Measured, columns: Sequence[MeasuredColumn]) -> bytes:
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    names = list(dict.fromkeys(name for values in measured.values() for name in values))
    writer.writerow(["row", "column", "paper", "mean", *names])
    for row in table.rows:
        values = measured.get(row.label, {})
        for index, column in enumerate(columns):
            paper = row.paper[column.paper] if column.paper is not None and column.paper < len(row.paper) else ""
            found = [f"{values[name][index]:.4f}" if name in values else "" for name in names]
            mean = f"{by_column(list(values.values()))[index][0]:.4f}" if values else ""
            writer.writerow([row.label, column.title, paper, mean, *found])
    return text.getvalue().encode()


def figure(table: PaperTable, measured: Measured, columns: Sequence[MeasuredColumn]) -> bytes:
    """Draw the table as a PNG: bars, or lines where the rows are steps of one quantity."""
    labels = [row.label for row in table.rows]
    steps = table.key in ("table3", "table4", "figure5")
    shown, axes = pyplot().subplots(
        figsize=(8.2, 3.9) if steps else (8.2, 0.5 * len(labels) + 1.6), layout="constrained"
    )
    for index, column in enumerate(columns):
        of_row = {label: by_column(list(values.values()))[index] for label, values in measured.items()}
        run = [(place, of_row[label]) for place, label in enumerate(labels) if label in of_row]
        at = column.paper
        paper = [(n, row.paper[at]) for n, row in enumerate(table.rows) if at is not None and at < len(row.paper)]
        _draw(axes, steps, index, len(columns), column.title, _COLOURS[index % len(_COLOURS)], run, paper)
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
    axes.set_title(table.title, loc="left", fontsize=11)
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(frameon=False, fontsize=8, loc="center left", bbox_to_anchor=(1, 0.5))
    return png(shown, 110)


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
    """Draw one column: measured values filled, with their spread, and the paper's hollow or dotted."""
    places = [place for place, _ in run]
    means, spreads = [value[0] for _, value in run], [value[1] for _, value in run]
    if steps:
        axes.errorbar(places, means, spreads, color=colour, marker="o", capsize=3, label=column)
        if paper:
            axes.plot(*zip(*paper, strict=True), color=colour, linestyle=":", marker="o", fillstyle="none", alpha=0.6,
                      label=f"{column}, paper")  # fmt: skip
        return
    height = 0.8 / of
    at = [place + (index - (of - 1) / 2) * height for place in places]
    axes.barh(at, means, height * 0.9, xerr=spreads if any(spreads) else None, color=colour, label=column)
    if paper:
        label = {"label": "the paper"} if index == of - 1 else {}
        where = [place + (index - (of - 1) / 2) * height for place, _ in paper]
        axes.plot([value for _, value in paper], where, "D", color="black", fillstyle="none", markersize=4, **label)
