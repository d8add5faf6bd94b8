"""Lines of the plan that is printed before anything is trained: which rows of a table can be made."""

from __future__ import annotations

from collections.abc import Mapping

from lpn.reproduce.tables import PaperTable


def rows(table: PaperTable, reasons: Mapping[str, str]) -> str:
    """Count the rows of a table that can be made, and say why the others cannot.

    Args:
        reasons: for each row by its label, why it cannot be made; empty if it can.
    """
    own = [row.label for row in table.rows if not row.quoted]
    quoted = len(table.rows) - len(own)
    lacking: dict[str, list[str]] = {}
    for label in own:
        if reasons[label]:
            lacking.setdefault(reasons[label], []).append(label)
    made = len(own) - sum(map(len, lacking.values()))
    text = f"{table.key}: {made} of {len(own)} rows" + (f", and {quoted} quoted" if quoted else "")
    for reason, labels in lacking.items():
        text += f"; {reason}" + (f" ({', '.join(labels)})" if len(labels) < len(own) else "")
    return text
