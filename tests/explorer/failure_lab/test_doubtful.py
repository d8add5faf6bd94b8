"""Counts, filters, and charts of the laboratory leave out photos whose judge is in doubt."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np

from explorer.failure_lab import breakdown_page, state, table
from explorer.failure_lab.service import Findings
from explorer.failure_lab.state import LabState
from explorer.workspace import Workspace


def test_a_photo_whose_judge_is_in_doubt_counts_neither_as_found_nor_as_failed(
    findings: Findings, lab: LabState, workspace: Workspace
) -> None:
    failed, found = np.flatnonzero(findings.outcomes.failed), np.flatnonzero(findings.outcomes.hits)
    assert len(failed) > 1
    doubtful = np.zeros(len(findings.table), bool)
    doubtful[[failed[0], found[0]]] = True
    graded = replace(findings, doubtful=doubtful)
    masks = state.outcome_masks(graded)
    np.testing.assert_array_equal(np.flatnonzero(masks["failed"]), failed[1:])
    np.testing.assert_array_equal(np.flatnonzero(masks["found"]), found[1:])
    rows = state.selected_rows(graded, replace(lab, outcome="failed"))
    np.testing.assert_array_equal(rows, failed[1:])
    told = re.sub(r"<[^>]*>|\s+", " ", table.summary(graded, lab, np.arange(len(findings.table))))
    queries = len(findings.table)
    share = 100 * (len(failed) - 1) / (queries - 2)
    assert f"{queries} of {queries} queries, {len(failed) - 1} failed ({share:.1f} %), 2 not graded" in told, told
    told = table.summary(graded, lab, np.array([failed[0], found[0]]))
    assert f"2 of {queries} queries, 0 failed, 2 not graded<" in told, "there is no share of none"
    (column, *_) = state.charted_columns(graded)
    rates = state.failure_rates(graded, lab, column)
    assert sum(rate.failures for rate in rates) == len(failed) - 1
    assert sum(rate.queries for rate in rates) == len(findings.table) - 2
    cards = breakdown_page.cards(graded, lab, workspace)
    assert any(f"in {len(failed) - 1} " in card.title for card in cards)
    confused = [query for one in state.confusions(graded, lab) for query in one.queries]
    assert set(confused) == set(failed[1:].tolist())
