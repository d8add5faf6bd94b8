"""Verdicts on the paper's claims, from a table's record alone."""

from __future__ import annotations

from collections.abc import Sequence

from lpn.analysis.statistics import half_interval
from lpn.reproduce.record import RowRecord, TableRecord
from lpn.reproduce.tables import Claim, claims


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
    verdict = _not_ahead(claim, rows, columns) if claim.tolerance is not None else _ahead(claim, rows, columns)
    figures = "; ".join(_closest(claim, rows, index, record) for index in columns)
    once = [label for label in labels if len(rows[label].values) == 1]
    networks = (
        "" if not once else "; one network each" if len(once) == len(labels) else f"; one network of {', '.join(once)}"
    )
    return f"{claim.text}: **{verdict}** ({figures}{networks})."


def _gaps(claim: Claim, rows: dict[str, RowRecord], index: int) -> list[tuple[float, str, str]]:
    """Return how far the first row of each pair is ahead of the other in a column, the smallest distance first."""
    return sorted(
        ((rows[better].mean[index] - rows[worse].mean[index], better, worse) for better, worse in claim.pairs),
        key=lambda gap: gap[0],
    )


def _ahead(claim: Claim, rows: dict[str, RowRecord], columns: Sequence[int]) -> str:
    gaps = [(*gap, index) for index in columns for gap in _gaps(claim, rows, index)]
    lost = [gap for gap in gaps if gap[0] <= 0]
    if lost:
        share = f" in {len(lost)} of {len(gaps)} comparisons" if len(lost) < len(gaps) else ""
        near = all(-gap <= _noise(rows, better, worse, index) for gap, better, worse, index in lost)
        return f"did not hold{share}" + (
            ", but within the interval of the seeds" if near and any(g[0] for g in lost) else ""
        )
    close = [gap for gap in gaps if gap[0] <= _noise(rows, *gap[1:])]
    if close:
        return "held in the mean, but within the interval of the seeds for " + ", ".join(
            dict.fromkeys(label for _, *pair, _ in close for label in pair)
        )
    return "held"


def _not_ahead(claim: Claim, rows: dict[str, RowRecord], columns: Sequence[int]) -> str:
    assert claim.tolerance is not None
    largest = {index: _gaps(claim, rows, index)[-1][0] for index in columns}
    allowed = dict(zip(columns, claim.tolerance, strict=True))
    gaps = [
        # The figures have two digits.
        (round(gap, 2) - allowed[index], _noise(rows, better, worse, index))
        for index in columns
        for gap, better, worse in _gaps(claim, rows, index)
    ]
    beyond = [(over, noise) for over, noise in gaps if over > 0]
    if not beyond:
        near = any(-over < noise for over, noise in gaps)
        return "held in the mean, but within the interval of the seeds" if near else "held"
    worst = max(columns, key=lambda index: largest[index] - allowed[index])
    near = all(over <= noise for over, noise in beyond)
    return f"did not hold, {largest[worst]:.1f} points where {allowed[worst]:.1f} are allowed" + (
        ", but within the interval of the seeds" if near else ""
    )


def _noise(rows: dict[str, RowRecord], better: str, worse: str, index: int) -> float:
    """Return half the width of the interval of the difference between two rows in a column."""
    return half_interval(*([values[index] for values in rows[label].values.values()] for label in (better, worse)))


def _closest(claim: Claim, rows: dict[str, RowRecord], index: int, record: TableRecord) -> str:
    """Give the figures of the pair that decides in a column."""
    gaps = _gaps(claim, rows, index)
    _, better, worse = gaps[0] if claim.tolerance is None else gaps[-1]
    first, second = (f"{label} {rows[label].mean[index]:.1f}" for label in (better, worse))
    return f"{record.columns[index]}: {first}, {second}"
