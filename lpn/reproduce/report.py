"""A measured table as Markdown and CSV, and Figure 5: values beside the paper's, notes, and verdicts on the claims."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from lpn.analysis.statistics import half_interval
from lpn.core.files import write_atomic
from lpn.core.text_tables import TextTable
from lpn.drawing.plots import encode, pyplot
from lpn.reproduce.jobs import TrainingJob
from lpn.reproduce.record import RowRecord, TableRecord
from lpn.reproduce.sources import Source, out_of
from lpn.reproduce.tables import Claim, PaperTable, Scale, Training, claims

_COLOURS = ("#1f5fbf", "#7fb2e5", "#c2571a", "#eba968")


def write(record: TableRecord, out: Path) -> list[Path]:
    """Write `<key>.md` and `<key>.csv`, and for Figure 5 the picture, into a folder; return their paths."""
    files = {out / f"{record.key}.md": markdown(record).encode(), out / f"{record.key}.csv": _csv(record)}
    if record.key == "figure5":
        files[out / "figure5.png"] = figure(record)
    for file, data in files.items():
        write_atomic(file, data)
    return list(files)


def markdown(record: TableRecord) -> str:
    """Format the table, its notes, and the verdicts on the paper's claims."""
    after = "".join(f"{sentence}  \n" for sentence in record.notes)
    judged = "".join(f"- {claim}\n" for claim in verdicts(record))
    table = replace(text_table(record), after="\n".join(filter(None, (after, judged))).rstrip("\n"))
    return table.markdown(3).removesuffix("\n")


def text_table(record: TableRecord) -> TextTable:
    """Return the measured values, and the paper's beside them."""
    any_paper = any(row.paper for row in record.rows)
    # Title, and the index of a measured column, or of the paper's column; the paper's further columns come last.
    cells: list[tuple[str, int | None, int | None]] = []
    for index, (title, beside) in enumerate(zip(record.columns, record.beside, strict=True)):
        cells += [(title, index, None), *([("paper", None, beside)] if any_paper and beside is not None else [])]
    cells += [(f"paper, {title}", None, index) for index, title in record.alone.items()]
    rows = []
    for row in record.rows:
        texts = []
        # Only the first cell states the reason.
        lacking = "quoted" if row.quoted else f"not run: {row.reason}" if row.reason else "not run"
        for _, own, printed in cells:
            if own is not None:
                texts.append(_format(row.mean[own], row.interval[own]) if row.values else lacking)
                lacking = "quoted" if row.quoted else "not run"
            else:
                # The paper prints a dash for unknown values of a row.
                texts.append(_printed(row, printed, "-" if row.paper else ""))
        rows.append((row.title, *texts))
    return TextTable(("", *(title for title, _, _ in cells)), rows, record.title)


def _printed(row: RowRecord, index: int | None, lacking: str = "") -> str:
    """Return the paper's value of an index as text; `lacking` if there is none."""
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
    """Draw a table whose rows are steps of one quantity as a PNG: lines with intervals, dotted for the paper."""
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


def verdicts(record: TableRecord) -> list[str]:
    """State for each of the paper's claims whether it held, with the figures."""
    return [_verdict(claim, record) for claim in claims(record.key)]


def _verdict(claim: Claim, record: TableRecord) -> str:
    labels = list(dict.fromkeys(label for pair in claim.pairs for label in pair))
    missing = [label for label in labels if record.row(label) is None]
    if missing:
        return f"{claim.text}: not known; {', '.join(missing)} was not run."
    rows = {row.label: row for row in record.rows}
    columns = range(len(record.columns)) if claim.columns is None else claim.columns
    verdict = _judged(claim, rows, columns)
    figures = "; ".join(_closest(claim, rows, index, record) for index in columns)
    once = [label for label in labels if len(rows[label].values) == 1]
    networks = (
        "" if not once else "; one network each" if len(once) == len(labels) else f"; one network of {', '.join(once)}"
    )
    return f"{claim.text}: **{verdict}** ({figures}{networks})."


def _gaps(claim: Claim, rows: dict[str, RowRecord], index: int) -> list[tuple[float, str, str]]:
    """Return the lead of each pair's first row over its second row in a column, the smallest first."""
    return sorted(
        ((rows[better].mean[index] - rows[worse].mean[index], better, worse) for better, worse in claim.pairs),
        key=lambda gap: gap[0],
    )


def _judged(claim: Claim, rows: dict[str, RowRecord], columns: Sequence[int]) -> str:
    ahead, allowed = claim.tolerance is None, dict(zip(columns, claim.tolerance or (), strict=False))
    margins = []
    for index in columns:
        for gap, better, worse in _gaps(claim, rows, index):
            # The allowed figures have two decimals.
            margin = gap if ahead else allowed[index] - round(gap, 2)
            margins.append((margin, _noise(rows, better, worse, index), index, (better, worse)))
    within = "within the interval of the seeds"
    if lost := [one for one in margins if one[0] < 0 or (ahead and one[0] == 0)]:
        share = f" in {len(lost)} of {len(margins)} comparisons" if len(lost) < len(margins) else ""
        margin, _, index, _ = min(lost)
        limit = allowed.get(index, 0.0)
        what = share if ahead else f", {limit - margin:.1f} points where {limit:.1f} are allowed"
        near = any(one[0] for one in lost) and all(-margin <= noise for margin, noise, *_ in lost)
        return f"did not hold{what}" + (f", but {within}" if near else "")
    if close := [one for one in margins if one[0] < one[1] or (ahead and one[0] == one[1])]:
        labels = dict.fromkeys(label for *_, pair in close for label in pair)
        return f"held in the mean, but {within}" + (f" for {', '.join(labels)}" if ahead else "")
    return "held"


def _noise(rows: dict[str, RowRecord], better: str, worse: str, index: int) -> float:
    """Return half the width of the interval of the difference of two rows in a column."""
    return half_interval(*([values[index] for values in rows[label].values.values()] for label in (better, worse)))


def _closest(claim: Claim, rows: dict[str, RowRecord], index: int, record: TableRecord) -> str:
    """Return the figures of the deciding pair in a column."""
    gaps = _gaps(claim, rows, index)
    _, better, worse = gaps[0] if claim.tolerance is None else gaps[-1]
    first, second = (f"{label} {rows[label].mean[index]:.1f}" for label in (better, worse))
    return f"{record.columns[index]}: {first}, {second}"


def protocol_note(rows: Mapping[str, str]) -> str:
    """Merge the protocols of rows, by label: shared clauses first, then each other clause with its rows."""
    clauses = {label: text.removeprefix("Protocol: ").removesuffix(".").split("; ") for label, text in rows.items()}
    held: dict[str, list[str]] = {}
    for label, of_row in clauses.items():
        for clause in of_row:
            held.setdefault(clause, []).append(label)
    if not held:
        return "Nothing was measured."
    shared = [clause for clause, labels in held.items() if len(labels) == len(rows)]
    others = [f"{clause} ({_rows(labels, list(rows))})" for clause, labels in held.items() if len(labels) < len(rows)]
    apart = f" Not in every row: {'; '.join(others)}." if others else ""
    return f"Protocol: {'; '.join(shared)}.{apart}"


def _rows(labels: Sequence[str], every: Sequence[str]) -> str:
    """Name some rows of a table, or "all but" the others if these are fewer."""
    others = [label for label in every if label not in labels]
    return " / ".join(labels) if len(labels) <= len(others) else f"all but {' / '.join(others)}"


def data_notes(table: PaperTable, data: Sequence[Source], scale: Scale) -> list[str]:
    """Describe a table and the measured pictures."""
    notes = [table.google] if table.google and (not data or data[0].has_google) else []
    notes += table.notes
    if table.protocols:
        notes.append(table.protocols[scale.protocol])
    if not data:
        return notes
    if any(source.rendered for source in data):
        notes.append(
            "**Data: the rendered world, not the paper's data sets**; its figures compare with each other only."
        )
    else:
        notes.append(f"Data: {', '.join(f'{source.name} ({source.dataset.kind})' for source in data)}.")
    notes.append(f"Measured on {'; '.join(f'{source.name}: {source.sizes(table.measure)}' for source in data)}.")
    return notes


def network_notes(own: Sequence[TrainingJob], scale: Scale, seeds: Sequence[int]) -> list[str]:
    """Describe the trainings of all networks that the user did not supply."""
    notes: list[str] = []
    done = [job for job in own if job.done]
    if done:
        notes += [scale.described, f"Trained on {_places(done)}."]
        of = {job.recipe.backbone: job.start for job in done}
        begin = [f"{name} from {start.name if start else 'random weights'}" for name, start in of.items()]
        notes.append(f"Before training: {', '.join(begin)}.")
        if scale.changes:
            notes.append(changes_note(scale, [job.training for job in done]))
        if len(seeds) > 1:
            notes.append("Mean of the seeds trained so far, ± half the width of its 95 % interval (Student's t).")
    if lost := [job.name for job in own if job.ended == "diverged"]:
        notes.append(f"Diverged, and given up: {', '.join(lost)}.")
    return notes


def changes_note(scale: Scale, trainings: Sequence[Training]) -> str:
    """Name the user's changes, each with the networks that keep their own setting."""
    changes = []
    for name, value in scale.changes.items():
        kept = dict.fromkeys(training.name for training in trainings if name in scale.kept(training))
        changes.append(f"{name} = {value}" + (f" (not for {', '.join(kept)})" if kept else ""))
    return f"Changed: {', '.join(changes)}."


def _places(jobs: Sequence[TrainingJob]) -> str:
    """Count the training places, for each network if they differ."""
    of: dict[str, dict[str, None]] = {}
    for job in jobs:
        full = job.source.dataset.published_sizes.get("train/satellite")
        count = out_of(len(job.source.places(job.recipe.sets)), full.places if full else None)
        of.setdefault(f"{count} places", {})[job.training.name] = None
    return "; ".join(f"{places} ({', '.join(names)})" if len(of) > 1 else places for places, names in of.items())
