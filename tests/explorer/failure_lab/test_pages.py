from __future__ import annotations

import re
from dataclasses import replace
from html import unescape

import numpy as np

from explorer.failure_lab import breakdown_page, state, table
from explorer.failure_lab.service import Findings
from explorer.failure_lab.state import LabState, Selection
from explorer.workspace import Workspace
from lpn.analysis import notes


def test_names_and_metadata_never_become_html(workspace: Workspace, findings: Findings, lab: LabState) -> None:
    chosen = replace(lab, columns=("weather",))
    html = table.table(findings, chosen, workspace, findings.table.rows(), 3)
    html += breakdown_page.page(findings, chosen, workspace) + table.column_choice(findings, chosen)
    assert "<b>rain" not in html
    assert "&lt;b&gt;rain" in html
    assert html.count('class="chosen" data-row="3"') == 1
    # The message of a bin holds the name unescaped.
    assert re.search(r'\["weather", \d, "say \\"hi\\""\]', unescape(html))
    form = table.note(findings, 0, notes.Note(("a",), "</textarea><script>"), 1)
    assert "<script>" not in form


def test_a_page_has_as_many_rows_as_are_shown_and_an_empty_one_says_what_to_do(
    workspace: Workspace, findings: Findings, lab: LabState
) -> None:
    assert table.table(findings, lab, workspace, findings.table.rows()[:5], None).count("<tr data-row") == 5
    assert "lab-clear" in table.table(findings, lab, workspace, findings.table.rows()[:0], None)


def test_a_chart_says_which_queries_it_counts(workspace: Workspace, findings: Findings, lab: LabState) -> None:
    some = Selection(
        "some",
        "some",
        np.array([np.flatnonzero(outcome)[0] for outcome in (findings.outcomes.failed, ~findings.outcomes.failed)]),
    )
    assert "Failures by weather, of all 13 queries" in breakdown_page.page(findings, lab, workspace)
    assert "Failures by weather, of 2 queries" in breakdown_page.page(
        findings, state.add_selection(lab, some), workspace
    )
    # Among failures alone, every rate would be 100 %.
    assert "Failures by weather, of all 13 queries" in breakdown_page.page(
        findings, replace(lab, filter="rank > 1"), workspace
    )
