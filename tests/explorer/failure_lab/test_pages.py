from __future__ import annotations

import json
import re
from dataclasses import replace
from html import unescape

import numpy as np

from explorer.browse.feeds import Feeds
from explorer.failure_lab import breakdown_page, messages, state, table
from explorer.failure_lab.service import Findings
from explorer.failure_lab.state import LabState
from explorer.lab_choices import Selection
from explorer.workspace import Workspace
from lpn.drawing import words
from lpn.tasks import notes


def test_names_and_metadata_never_become_html(workspace: Workspace, findings: Findings, lab: LabState) -> None:
    chosen = replace(lab, columns=("weather",))
    columns, rows = table.visible_columns(findings, chosen), findings.table.rows()
    html = "".join(cells for _, cells in table.lines(findings, columns, Feeds(workspace), rows))
    html += table.table(findings, chosen, 13, 1, 300)
    html += breakdown_page.page(findings, chosen, workspace) + table.column_choice(findings, chosen)
    assert "<b>rain" not in html
    assert "&lt;b&gt;rain" in html
    # The message of a bin holds the name unescaped.
    assert re.search(r'\["weather", \d, "say \\"hi\\""\]', unescape(html))
    form = table.note(findings, 0, notes.Note(("a",), "</textarea><script>"), 1)
    assert "<script>" not in form


def test_what_is_offered_and_shown_fits_the_number_of_queries_and_the_filter(findings: Findings, lab: LabState) -> None:
    assert "lab-report" in table.bar(findings, lab, 200)
    for count in (0, 201):
        html = table.bar(findings, lab, count)
        assert "lab-report" not in html
        assert f"A report holds up to 200 queries; {count} are shown" in html
        assert '>Report<span class="roomy"> (at most 200)<' in html
    rows = findings.table.rows()
    for before, shown in (("", "without a filter"), ("rank > 1", "of the last filter that could be read, rank &gt; 1")):
        wrong = state.set_filter(replace(lab, filter=before), "rank > 5 and", findings.table)
        assert f"The rows below are those {shown}." in table.summary(findings, wrong, rows)


def test_a_share_of_failures_is_left_out_where_failures_are_the_filter(findings: Findings, lab: LabState) -> None:
    rows, failed = findings.table.rows(), findings.outcomes.failed
    assert f"{len(rows)} of {len(rows)} queries, {failed.sum()} failed ({100 * failed.mean():.1f} %)" in table.summary(
        findings, lab, rows
    )
    assert f"{failed.sum()} of {len(rows)} queries, all failed" in table.summary(findings, lab, rows[failed])


def test_rows_are_fetched_in_the_tables_order_and_an_empty_table_says_what_to_do(
    workspace: Workspace, findings: Findings, lab: LabState
) -> None:
    feeds, rows = Feeds(workspace), state.sorted_rows(findings, lab)
    feed = table.publish(feeds, "me", findings, lab, rows)
    piece = feeds.find(f"{feeds.address.partition('/')[2]}{feed}0")
    assert piece is not None
    fetched = json.loads(piece().data)
    assert [row for row, _ in fetched] == rows.tolist()
    columns = [column.name for column in table.visible_columns(findings, lab)]
    for row, html in fetched:
        cells = re.findall(r"<td[^>]*>(.*?)</td>", html, re.DOTALL)
        assert len(cells) == 1 + len(columns)
        assert findings.task.queries[row].name in cells[1 + columns.index("name")]
        address = re.findall(r'data-src="([^"]+)"', html)[0]
        assert address == feeds.thumbnail(findings.task, "query", row)
    assert "lab-clear" in table.table(findings, lab, 0, 1, 300)


def test_a_chart_says_which_queries_it_counts(workspace: Workspace, findings: Findings, lab: LabState) -> None:
    some = Selection.of(
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


def test_near_duplicates_are_pairs_of_tiles_and_a_click_chooses_their_queries(
    workspace: Workspace, findings: Findings, lab: LabState
) -> None:
    card = next(card for card in breakdown_page.cards(findings, lab, workspace) if card.style == "alike")
    cosines = [line.content[2] for line in card.lines]  # type: ignore[index]
    assert cosines == sorted(cosines, reverse=True)
    line, task = card.lines[0], findings.task
    first, second = line.value  # type: ignore[misc]
    chosen = messages.apply(messages.SelectAlike(first, second), lab, findings)
    places = set(task.query_labels[list(chosen.selections[0].rows)].tolist())
    assert places == {int(task.gallery_labels[first]), int(task.gallery_labels[second])}
    again = next(card for card in breakdown_page.cards(findings, chosen, workspace) if card.style == "alike")
    assert [one.chosen for one in again.lines].count(True) == 1
    assert messages.apply(messages.SelectAlike(first, second), chosen, findings).selections == ()


def test_a_bar_is_as_long_as_its_share(workspace: Workspace, findings: Findings, lab: LabState) -> None:
    cards = [card for card in breakdown_page.cards(findings, lab, workspace) if card.style == "rate"]
    contents = [line.content for card in cards for line in card.lines]
    assert contents
    for _, bar, share in contents:  # type: ignore[misc]
        assert bar.share == 100 * share
        assert bar.low + bar.width <= 100.5


def test_the_charts_keep_their_places_while_one_chooses(
    workspace: Workspace, findings: Findings, lab: LabState
) -> None:
    def heights(lab: LabState) -> list[tuple[str, int]]:
        html = breakdown_page.page(findings, lab, workspace)
        return [
            (re.findall(r"[^,;]*", title)[0], card.count('<div class="line') + card.count('<div class="dim"'))
            for title, card in re.findall(
                r'class="title"[^>]*>(.*?)</div>(.*?)(?=<div class="card">|$)', html, re.DOTALL
            )
        ]

    one = Selection.of("some", "some", np.flatnonzero(findings.outcomes.failed)[:1])
    whole, narrow = heights(lab), heights(state.add_selection(lab, one))
    assert len(whole) > 2
    assert whole == narrow


def test_plain_words_name_no_level_of_evidence(findings: Findings, lab: LabState) -> None:
    rows = findings.table.rows()
    for vocabulary, told in ((words.Vocabulary(plain=True), False), (words.EXPERT, True)):
        with words.speaking(vocabulary):
            assert ("of evidence" in table.summary(findings, lab, rows)) == told
