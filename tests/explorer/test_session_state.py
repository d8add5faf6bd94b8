from __future__ import annotations

import math
import threading
import time
from dataclasses import replace
from random import Random

import numpy as np
import pytest

from explorer import session_state
from explorer.compute.worker import Worker
from explorer.session_state import SessionState
from lpn.core.errors import PictureError
from lpn.library.analyser import OwnPicture


@pytest.fixture
def state() -> SessionState:
    return SessionState("drone-to-satellite", 4, query=3, angle=20, selected=7)


def test_the_flight_window_opens_in_place_of_the_others_and_comes_back_when_they_close() -> None:
    state = SessionState("drone-to-satellite", 4, why=True, lab=True)
    opened = session_state.flip_flight(state)
    assert (opened.flight, opened.why, opened.lab) == (True, False, False)
    behind = session_state.flip_why(opened)
    assert behind.flight
    assert session_state.flip_flight(behind) == replace(opened, why_tab="best")
    assert not session_state.flip_flight(opened).flight


def test_another_query_starts_upright_with_its_top_match(state: SessionState) -> None:
    stepped = session_state.step(state, 1, 10)
    assert (stepped.query, stepped.angle, stepped.selected) == (4, 0, None)
    assert session_state.step(SessionState("t", 4), -1, 10).query == 9
    assert session_state.choose_query(state, 99, 10) is state
    own = session_state.choose_query(
        SessionState("t", 4, upload=OwnPicture("mine", np.zeros((2, 2, 3), np.uint8))), 0, 10
    )
    assert own.upload is None


def test_weather_alters_a_ranking_and_is_undone(state: SessionState) -> None:
    foggy = replace(state, angle=0.0, weather="fog", weather_strength=0.5)
    assert session_state.alterations(foggy, 64) == {"weather": "in fog (strength 0.5)"}
    assert not session_state.undo(foggy, "weather").change
    assert not session_state.choose_query(foggy, 4, 9).change
    assert not replace(foggy, weather_strength=0.0).change


def test_another_task_starts_upright_with_its_top_match(state: SessionState) -> None:
    moved = replace(state, shift=8, down=-8, zoom=2.0, region=(1, 2), heat_part=2)
    chosen = session_state.choose_task(moved, "satellite-to-drone", 14)
    assert chosen == SessionState("satellite-to-drone", 4, query=14, heat_part=2)
    assert session_state.choose_task(moved, state.task, 14) is moved


def test_a_tile_chosen_from_an_old_answer_is_not_compared_with_a_new_query(state: SessionState) -> None:
    assert session_state.compare(state, state, 5).selected == 5
    turned = session_state.turn(state, 5)
    assert session_state.compare(turned, state, 5).selected == 5
    stepped = session_state.step(state, 1, 10)
    assert session_state.compare(stepped, state, 5) is stepped
    other = replace(state, task="satellite-to-drone")
    assert session_state.compare(other, state, 5) is other


def test_random_choices_move_and_failures_fail(state: SessionState) -> None:
    rng = Random(1)
    assert all(session_state.random_query(state, 10, rng).query != 3 for _ in range(50))
    assert session_state.random_query(state, 1, rng) is state
    failed = np.array([False, False, True, True, False, True])
    chosen = {session_state.random_failure(state, failed, rng).query for _ in range(50)}  # type: ignore[union-attr]
    assert chosen == {2, 5}
    assert session_state.random_failure(state, np.zeros(4, bool), rng) is None
    shown = [3]
    for _ in range(3):
        after = session_state.next_failure(replace(state, query=shown[-1]), failed)
        assert after is not None
        shown.append(after.query)
    assert shown == [3, 5, 2, 3]
    assert session_state.next_failure(state, np.zeros(4, bool)) is None
    shown, order = [0], np.array([0, 0, 2, 1, 0, 0])
    for _ in range(3):
        after = session_state.next_failure(replace(state, query=shown[-1]), failed, order)
        assert after is not None
        shown.append(after.query)
    assert shown == [0, 5, 3, 2]


@pytest.mark.parametrize(("angle", "by", "expected"), [(0, 5, 5), (178, 5, -177), (-178, -5, 177), (90, -270, 180)])
def test_turning_goes_around_the_circle(angle: float, by: float, expected: float) -> None:
    assert session_state.turn(SessionState("t", 4, angle=angle), by).angle == expected


def test_values_from_the_page_are_not_trusted() -> None:
    assert session_state.number(99999, 0, 10, 3) == 10
    assert session_state.number(-5, 0, 10, 3) == 0
    for value in ("7", None, math.nan, math.inf, True, [1]):
        assert session_state.number(value, 0, 10, 3) == 3


def test_parts_switched_off_count_nothing_and_never_all() -> None:
    state = SessionState("t", 3, weights=(1.0, 2.0, 0.5), enabled=(True, False, True))
    assert state.part_values() == (1.0, 0.0, 0.5)
    off = SessionState("t", 3, enabled=(False, False, False))
    assert not off.parts_left()
    assert off.part_values() == (1.0, 1.0, 1.0)


def test_names_are_found_by_any_part_of_them() -> None:
    assert session_state.matching_names(["0010", "0100", "Ab"], " 10 ") == [0, 1]
    assert session_state.matching_names(["0010", "Ab"], "aB") == [1]
    assert session_state.matching_names(["a", "b"], "") == [0, 1]


def test_a_worker_never_queues_stale_work() -> None:
    newest, done = [0], []
    started, release, last = threading.Event(), threading.Event(), threading.Event()

    def work() -> None:
        value = newest[0]
        started.set()
        release.wait(60)
        done.append(value)
        if value == 199:
            last.set()

    worker = Worker(work, lambda _: None)
    worker.wake()
    assert started.wait(60)
    for value in range(200):
        newest[0] = value
        worker.wake()
    release.set()
    assert last.wait(60)
    time.sleep(0.3)
    worker.stop()
    assert done == [0, 199]


@pytest.mark.parametrize(("error", "traced"), [(ValueError("first"), True), (PictureError("first"), False)])
def test_a_worker_survives_a_failure(error: Exception, traced: bool, caplog: pytest.LogCaptureFixture) -> None:
    failures: list[Exception] = []
    answered = threading.Event()

    def work() -> None:
        if not failures:
            raise error
        answered.set()

    def failed(error: Exception) -> None:
        assert worker.failed
        failures.append(error)
        worker.wake()

    worker = Worker(work, failed)
    worker.wake()
    assert answered.wait(60)
    worker.stop()
    assert [str(e) for e in failures] == ["first"]
    assert not worker.failed, "the run after it has ended well"
    assert [bool(record.exc_info) for record in caplog.records] == [traced]


def test_next_and_previous_go_through_an_order() -> None:
    session, order = SessionState("drone-to-satellite", 4, query=7), np.array([3, 7, 5])
    assert session_state.step_in_order(session, 1, order, 13).query == 5
    assert session_state.step_in_order(replace(session, query=5), 1, order, 13).query == 3
    assert session_state.step_in_order(session, -1, order, 13).query == 3
    assert [session_state.step_in_order(replace(session, query=0), by, order, 13).query for by in (1, -1)] == [3, 5]
    assert session_state.step_in_order(session, 1, order[:0], 13) is session


def test_escape_closes_one_thing_after_another_and_nothing_under_the_laboratory(state: SessionState) -> None:
    both = replace(state, map=True, exploded=True)
    apart = session_state.leave_stage_view(both)
    assert (apart.map, apart.exploded) == (False, True)
    assert session_state.leave_stage_view(apart) == state
    explained = replace(both, why=True)
    assert session_state.leave_stage_view(explained) == both
    for window in ("lab", "flight"):
        covered = session_state.with_field(both, window, True)
        assert session_state.leave_stage_view(covered) == covered


def test_a_map_that_opens_is_not_hidden_by_the_explanation(state: SessionState) -> None:
    explained = replace(state, why=True)
    shown = session_state.show_map(explained, True)
    assert (shown.map, shown.why) == (True, False)
    both = replace(explained, map=True)  # the explanation was opened over the map
    assert session_state.show_map(both, True) == both
    assert session_state.show_map(both, False) == explained


def test_the_map_of_the_first_screen_stands_alone_in_plain_words_and_leads_back() -> None:
    first = SessionState("task", 4, first_screen=True, why=True, plain=True)
    alone = session_state.leave_first_screen(first, session_state.show_map_alone(first))
    assert (alone.flight, alone.map_alone, alone.first_screen, alone.why) == (True, True, False, False)
    stepped = session_state.leave_first_screen(alone, session_state.step(alone, 1, 5))
    assert (stepped.map_alone, stepped.query) == (True, 1)
    back = session_state.leave_first_screen(stepped, replace(stepped, flight=False))
    assert (back.first_screen, back.map_alone, back.query) == (True, False, 1)
    assert not session_state.leave_first_screen(alone, replace(alone, why=True)).map_alone, (
        "another window lies in the workbench"
    )
    changed = session_state.leave_first_screen(alone, replace(alone, plain=False))
    assert (changed.flight, changed.map_alone) == (True, False), "the words were changed meanwhile"
    in_terms = replace(first, plain=False)
    opened = session_state.leave_first_screen(in_terms, session_state.show_map_alone(in_terms))
    assert (opened.flight, opened.map_alone) == (True, False), "experts have the workbench beside it"


def test_a_place_starts_clean_at_its_first_picture() -> None:
    walked = SessionState(
        "task", 4, query=3, first_screen=True, why=True, angle=30.0, weights=(0.5, 1, 1, 1), plain=True
    )
    start = session_state.start_place(walked, 1, 5)
    assert (start.query, start.why, start.angle, start.first_screen) == (1, False, 0.0, True)
    assert not start.altered_weights
    fails = session_state.show_fails(walked, 2, 5)
    start = session_state.start_place(fails, 1, 5)
    assert (start.query, start.fails, start.came_from) == (1, False, None)
