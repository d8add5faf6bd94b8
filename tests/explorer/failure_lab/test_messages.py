from __future__ import annotations

from typing import Any

import pytest

from explorer.failure_lab import messages, state
from explorer.failure_lab.messages import LabMessage, SelectBin
from explorer.failure_lab.service import Findings
from explorer.failure_lab.state import LabState
from explorer.web.messages import decode


@pytest.mark.parametrize(
    ("kind", "value"),
    [
        ("lab-tab", "other"),
        ("lab-tab", ["table"]),
        ("lab-outcome", None),
        ("lab-sort", "password"),
        ("lab-sort", {"a": 1}),
        ("lab-find", 7),
        ("lab-where", None),
        ("lab-column", []),
        ("lab-unpick", 3),
        ("lab-pair", [1, "2"]),
        ("lab-pair", [True, 2]),
        ("lab-pair", 3),
        ("lab-hub", -1),
        ("lab-alike", [0, 10**6]),
        ("lab-bin", ["weather", 0, None]),
        ("lab-bin", ["weather", True, "sun"]),
        ("lab-bin", ["weather", "sun"]),
        ("lab-bin", ["margin", 0, "1"]),
        ("lab-map", "moon"),
        ("lab-sort", "\ud800"),
        ("lab-open", -1),
        ("lab-open", 1e400),
        ("lab-part", 4),
        ("lab-lasso", ["pca", [0, 0]]),
        ("lab-stop", []),
        ("lab-tab", "\ud800"),
        ("lab-go", "attic"),
    ],
)
def test_a_malformed_message_changes_nothing(findings: Findings, lab: LabState, kind: str, value: Any) -> None:
    message = decode(LabMessage, kind, value)
    assert message is None or messages.apply(message, lab, findings) is lab


def test_a_second_click_removes_a_selection(findings: Findings, lab: LabState) -> None:
    index = [rate.name for rate in state.failure_rates(findings, lab, findings.table.columns["weather"])].index("sun")
    message = SelectBin("weather", index, "sun")
    once = messages.apply(message, lab, findings)
    assert [selection.label for selection in once.selections] == ["weather sun"]
    assert messages.apply(message, once, findings).selections == ()


def test_the_ground_is_the_first_map_until_another_is_chosen(findings: Findings, lab: LabState) -> None:
    assert findings.task.geometry is not None
    maps = messages.apply(messages.ShowTab("maps"), lab, findings)
    assert (maps.tab, maps.map) == ("maps", "ground")
    chosen = messages.apply(messages.ShowMap("pca"), maps, findings)
    table = messages.apply(messages.ShowTab("table"), chosen, findings)
    assert messages.apply(messages.ShowTab("maps"), table, findings).map == "pca"
    linked = state.with_choices(
        findings, lab, state.choices(chosen)
    )  # an older address names no other map than the PCA
    assert messages.apply(messages.ShowTab("maps"), linked, findings).map == "pca"
