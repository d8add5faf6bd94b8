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
    verdict = _judged(claim, rows, columns)
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


def _judged(claim: Claim, rows: dict[str, RowRecord], columns: Sequence[int]) -> str:
    ahead, allowed = claim.tolerance is None, dict(zip(columns, claim.tolerance or (), strict=False))
    margins = []
    for index in columns:
        for gap, better, worse in _gaps(claim, rows, index):
            # The allowed figures have two digits.
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
    """Return half the width of the interval of the difference between two rows in a column."""
    return half_interval(*([values[index] for values in rows[label].values.values()] for label in (better, worse)))


def _closest(claim: Claim, rows: dict[str, RowRecord], index: int, record: TableRecord) -> str:
    """Give the figures of the pair that decides in a column."""
    gaps = _gaps(claim, rows, index)
    _, better, worse = gaps[0] if claim.tolerance is None else gaps[-1]
    first, second = (f"{label} {rows[label].mean[index]:.1f}" for label in (better, worse))
    return f"{record.columns[index]}: {first}, {second}"
