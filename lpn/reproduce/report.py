"""A measured table as Markdown and CSV, and Figure 5: measured values beside the paper's, and verdicts on its claims."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from lpn.core.files import write_atomic
from lpn.core.text_tables import TextTable
from lpn.drawing.plots import encode, pyplot
from lpn.reproduce.claims import verdicts
from lpn.reproduce.record import RowRecord, TableRecord

_COLOURS = ("#1f5fbf", "#7fb2e5", "#c2571a", "#eba968")


def write(record: TableRecord, out: Path) -> list[Path]:
    """Write `<key>.md` and `<key>.csv` into a folder, of Figure 5 the picture, too, and return their paths."""
    files = {out / f"{record.key}.md": markdown(record).encode(), out / f"{record.key}.csv": _csv(record)}
    if record.key == "figure5":
        files[out / "figure5.png"] = figure(record)
    for file, data in files.items():
        write_atomic(file, data)
    return list(files)


def markdown(record: TableRecord) -> str:
    """Format the table, its notes, and the verdicts on the paper's claims."""
    after = "".join(f"{sentence}  \n" for sentence in record.notes)
    claims = "".join(f"- {claim}\n" for claim in verdicts(record))
    table = replace(text_table(record), after="\n".join(filter(None, (after, claims))).rstrip("\n"))
    return table.markdown(3).removesuffix("\n")


def text_table(record: TableRecord) -> TextTable:
    """Return the measured values, and the paper's beside them."""
    any_paper = any(row.paper for row in record.rows)
    # Title, and the index of a measured column or of the paper's; the paper's without a neighbour come last.
    cells: list[tuple[str, int | None, int | None]] = []
    for index, (title, beside) in enumerate(zip(record.columns, record.beside, strict=True)):
        cells += [(title, index, None), *([("paper", None, beside)] if any_paper and beside is not None else [])]
    cells += [(f"paper, {title}", None, index) for index, title in record.alone.items()]
    rows = []
    for row in record.rows:
        texts = []
        # The reason stands once, in the first cell.
        lacking = "quoted" if row.quoted else f"not run: {row.reason}" if row.reason else "not run"
        for _, own, printed in cells:
            if own is not None:
                texts.append(_format(row.mean[own], row.interval[own]) if row.values else lacking)
                lacking = "quoted" if row.quoted else "not run"
            else:
                # The paper prints a dash for what it does not know of a row.
                texts.append(_printed(row, printed, "-" if row.paper else ""))
        rows.append((row.title, *texts))
    return TextTable(("", *(title for title, _, _ in cells)), rows, record.title)


def _printed(row: RowRecord, index: int | None, lacking: str = "") -> str:
    """Return the paper's value in a column of its own."""
    value = row.paper[index] if index is not None and index < len(row.paper) else None
    return lacking if value is None else f"{value:.2f}"


def _format(mean: float, interval: float) -> str:
    return f"{mean:.2f} ± {interval:.2f}" if interval else f"{mean:.2f}"


def _csv(record: TableRecord) -> bytes:
    names = list(dict.fromkeys(name for row in record.rows for name in row.values))
    rows = []
    for row in record.rows:
        for index, (title, beside) in enumerate(zip(record.columns, record.beside, strict=True)):
            values = [f"{row.values[name][index]:.4f}" if name in row.values else "" for name in names]
            mean = f"{row.mean[index]:.4f}" if row.mean else ""
            rows.append([row.title, title, _printed(row, beside), mean, row.reason, *values])
    return TextTable(("row", "column", "paper", "mean", "not run", *names), rows).csv()


def figure(record: TableRecord) -> bytes:
    """Draw a table whose rows are steps of one quantity as a PNG: lines with intervals, and the paper's dotted."""
    drawn, axes = pyplot().subplots(figsize=(8.2, 3.9), layout="constrained")
    for column, beside, colour, index in zip(record.columns, record.beside, _COLOURS, range(4), strict=False):
        run = [(at, row.mean[index], row.interval[index]) for at, row in enumerate(record.rows) if row.values]
        if run:
            places, means, intervals = zip(*run, strict=True)
            axes.errorbar(places, means, intervals, color=colour, marker="o", capsize=3, label=column)
        paper = [
            (at, row.paper[beside])
            for at, row in enumerate(record.rows)
            if beside is not None and beside < len(row.paper)
        ]
        if paper:
            style = {"linestyle": ":", "marker": "o", "fillstyle": "none", "alpha": 0.6}
            axes.plot(*zip(*paper, strict=True), color=colour, label=f"{column}, paper", **style)
    axes.set_xticks(range(len(record.rows)), [row.title for row in record.rows])
    axes.set_ylabel("%")
    axes.grid(axis="y", alpha=0.25)
    axes.set_title(record.title, loc="left", fontsize=11)
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(frameon=False, fontsize=8, loc="center left", bbox_to_anchor=(1, 0.5))
    return encode(drawn, 110)
