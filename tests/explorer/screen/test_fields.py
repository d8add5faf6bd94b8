from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import pytest

from explorer.screen import fields
from explorer.screen.fields import ScreenState
from explorer.screen.panels import PANELS
from explorer.workspace import Workspace


@pytest.fixture
def opened(workspace: Workspace) -> ScreenState:
    return fields.opening(workspace)


def test_the_table_gives_each_field_of_the_state_a_kind() -> None:
    of_panels = {row.name for panel in PANELS.values() for row in panel.fields}
    assert set(fields.FIELDS) == {*ScreenState.__dataclass_fields__, *of_panels} - {"of_panels"}
    keys = [row.key for row in fields.FIELDS.values() if row.key]
    assert len(set(keys)) == len(keys)


def test_an_address_leads_back_to_its_state(workspace: Workspace, opened: ScreenState) -> None:
    state = replace(
        opened,
        task="satellite-to-drone",
        query=3,
        angle=-37.5,
        compare=2,
        weights=(1.0, 0.5, 0.0, 2.0),
        heat="evidence",
        filter="missed",
        find="00",
        view="apart",
        theme="light",
    )
    address = fields.to_address(state, workspace)
    assert fields.from_values(fields.parsed(address), workspace) == (state, [])
    other = replace(state, model="1", weights=())
    assert fields.from_values(fields.parsed(fields.to_address(other, workspace)), workspace) == (other, [])
    assert "query=0005" in address


def test_an_opened_page_has_no_address_but_its_query(workspace: Workspace, opened: ScreenState) -> None:
    assert fields.to_address(opened, workspace) == "query=0002"
    assert fields.to_address(replace(opened, own="abcd"), workspace) == "", "an own photo has no address"


@pytest.mark.parametrize(
    ("name", "value", "says"),
    [
        ("angle", math.nan, "expected a number from -180 to 180"),
        ("angle", "1e9", "expected a number"),
        ("angle", 10**400, "expected a number"),
        ("angle", True, "expected a number"),
        ("angle", [3], "expected a number"),
        ("task", "moon-to-mars", "expected drone-to-satellite or satellite-to-drone"),
        ("model", "2", "expected 0 or 1"),
        ("query", 8, "names are such as 0002"),
        ("query", -1, "no such picture"),
        ("query", True, "no such picture"),
        ("query", "<img>", "no such picture"),
        ("compare", 99, "no such picture"),
        ("compare", "nowhere", "no such picture"),
        ("weights", [1, 2], "expected 4 numbers from 0 to 2"),
        ("weights", [0, 0, 0, 0], "not all 0"),
        ("weights", [1, 1, 1, 3], "expected a number from 0 to 2"),
        ("weights", "a,b,c,d", "expected a number"),
        ("find", "x" * 300, "letters at most"),
        ("find", "a\nb", "that can be printed"),
        ("theme", "pink", "expected dark or light"),
        ("panel", "none", "expected compare or "),
        ("panel", "flight", "expected compare or "),
    ],
)
def test_a_value_that_cannot_be_used_changes_nothing_and_is_named(
    workspace: Workspace, opened: ScreenState, name: str, value: Any, says: str
) -> None:
    state, problems = fields.changed(opened, {name: value}, workspace)
    assert state == opened
    assert len(problems) == 1
    assert says in problems[0]


def test_an_unknown_field_is_named_without_control_characters(workspace: Workspace, opened: ScreenState) -> None:
    state, problems = fields.changed(opened, {"a\x1bb": 1}, workspace)
    assert state == opened
    assert "there is no such choice" in problems[0]
    assert "\x1b" not in problems[0]


def test_another_query_is_upright_and_compared_with_nothing(workspace: Workspace, opened: ScreenState) -> None:
    turned = replace(opened, angle=30.0, compare=1, weights=(1.0, 1.0, 0.0, 1.0), own="abcd")
    same, _ = fields.changed(turned, {"query": turned.query}, workspace)
    assert (same.angle, same.own) == (0.0, ""), "the query takes the own photo's place"
    other, _ = fields.changed(replace(turned, own=""), {"query": 2}, workspace)
    assert other == replace(turned, own="", query=2, angle=0.0, compare=None)


def test_another_task_begins_with_its_first_query(workspace: Workspace, opened: ScreenState) -> None:
    state, problems = fields.changed(replace(opened, query=3), {"task": "satellite-to-drone"}, workspace)
    assert (state.query, problems) == (0, [])
    named, _ = fields.changed(opened, {"query": "0004", "task": "satellite-to-drone"}, workspace)
    assert (named.task, named.query) == ("satellite-to-drone", 2), "the task tells the query's names"


def test_a_picture_whose_name_is_another_s_too_is_written_by_its_position(
    workspace: Workspace, opened: ScreenState, monkeypatch: pytest.MonkeyPatch
) -> None:
    task = workspace.tasks[opened.task]
    twins = [replace(picture, name="twin") for picture in task.queries]
    monkeypatch.setitem(workspace.tasks, opened.task, replace(task, queries=twins))
    assert fields.to_address(replace(opened, query=0), workspace) == "query=twin"
    address = fields.to_address(replace(opened, query=2), workspace)
    assert address == "query=~2"
    assert fields.from_values(fields.parsed(address), workspace)[0].query == 2


def test_equal_weights_are_none(workspace: Workspace, opened: ScreenState) -> None:
    assert fields.changed(opened, {"weights": [2, 2, 2, 2]}, workspace)[0] == opened
    assert fields.changed(opened, {"weights": [1, 1, 1, 0.333333]}, workspace)[0].weights == (1, 1, 1, 0.33)


def test_what_only_the_page_shows_needs_no_answer(opened: ScreenState) -> None:
    page = replace(opened, filter="missed", find="00", view="apart", theme="light")
    assert not fields.needs_answer(opened, page)
    assert fields.needs_answer(opened, replace(page, angle=1.0))


def test_a_hostile_address_is_read_in_no_time(workspace: Workspace, opened: ScreenState) -> None:
    assert fields.from_values(fields.parsed("&".join(f"k{i}=1" for i in range(500))), workspace) == (opened, [])
    assert fields.from_values(fields.parsed("?angle=" + "9" * 100_000), workspace)[0] == opened
