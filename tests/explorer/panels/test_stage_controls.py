"""The controls over the stage: bars of one scale, and messages that change what they say."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from explorer.layout import layout_for
from explorer.opening import open_model
from explorer.panels import answer_text, messages
from explorer.panels.navigation import Navigation
from explorer.panels.stage_controls import StageControls, part_bars
from explorer.session_state import SessionState, StateChange
from explorer.workspace import StateAnalyser, StateAnalysis, Workspace
from lpn.drawing import verdicts

TASK = "drone-to-satellite"


@pytest.fixture(scope="module")
def workspace(data: Path, model_file: Path) -> Workspace:
    return open_model(data, model_file)


@pytest.fixture(scope="module")
def analyses(workspace: Workspace) -> list[StateAnalysis]:
    analyser = StateAnalyser(workspace)
    count = len(workspace.tasks[TASK].queries)
    return [analyser.analyse(SessionState(TASK, 4, query=query), 10) for query in range(count)]


def test_bars_of_all_pictures_have_one_scale(workspace: Workspace, analyses: list[StateAnalysis]) -> None:
    for analysis in analyses:
        bars, lead, full = part_bars(analysis, workspace.part_names)
        shares = [bar.share[1] for bar in bars]
        # A part that agrees as two unrelated pictures do, at a cosine of 0, fills its bar.
        longest = max(analysis.chosen.contributions.max(), 0.0 if lead is None else 2 * abs(lead.terms).max())
        assert full == 0.5 if longest <= 0.5 else full / 2 < longest <= full
        np.testing.assert_allclose(shares, np.maximum(100 * analysis.chosen.contributions / full, -100), atol=0.06)


def test_the_bars_of_the_parts_that_the_verdict_names_are_marked(
    workspace: Workspace, analyses: list[StateAnalysis]
) -> None:
    signs = set()
    for analysis in analyses:
        bars, lead, _ = part_bars(analysis, workspace.part_names)
        right, headline, _ = answer_text.verdict(analysis, workspace)
        assert lead is not None
        marked = [part for part, bar in enumerate(bars) if bar.decisive]
        assert marked == list(analysis.verdict.parts)
        np.testing.assert_allclose(lead.terms, (1 if lead.of_answer else -1) * analysis.verdict.gains)
        if right and headline.startswith("Ring"):
            named = re.match(r"Rings? ([\d, and]+) (adds?|decides?)", headline)
            assert named is not None
            assert [int(number) - 1 for number in re.findall(r"\d", named[1])] == marked
        signs.add(right)
    assert signs == {True, False}


def test_a_tile_that_the_verdict_does_not_speak_of_is_compared_with_the_answer(
    workspace: Workspace, analyses: list[StateAnalysis]
) -> None:
    first = analyses[0]
    spoken = answer_text.lead(first)
    assert spoken is not None
    other = next(match for match in first.matches[1:] if match.index != spoken.index)
    compared = StateAnalyser(workspace).analyse(replace(first.state, selected=other.index), 10)
    bars, lead, _ = part_bars(compared, workspace.part_names)
    assert lead is not None
    assert lead.terms.sum() == pytest.approx(other.distance2 - first.matches[0].distance2, abs=1e-5)
    assert [part for part, bar in enumerate(bars) if bar.decisive] == verdicts.leading_parts(lead.terms)


def test_the_controls_change_what_they_say(workspace: Workspace, analyses: list[StateAnalysis]) -> None:
    changes: list[StateChange] = []
    controls = StageControls(workspace, Navigation(workspace, lambda *_: None), changes.append)
    state = analyses[0].state

    def after(message: messages.StageMessage) -> SessionState | None:
        controls.receive(message)
        return changes.pop()(state)

    assert after(messages.TurnQuery(-35.0)) == replace(state, angle=-35.0)
    assert after(messages.FlipLook("exploded")) == replace(state, exploded=True)
    assert after(messages.ShowHeat("off")) == replace(state, heat=False)
    assert after(messages.ShowHeat("evidence")) == replace(state, heat=True, heat_kind="evidence")
    assert after(messages.SetOpacity(0.25)) == replace(state, opacity=0.25)
    assert after(messages.FlipPart(2)) == replace(state, enabled=(True, False, True, True))
    stepped = after(messages.StepQuery("next"))
    assert stepped is not None
    assert stepped.query == 1
    controls.receive(messages.FlipPart(9))
    assert not changes


def test_the_controls_lie_where_the_pictures_are(workspace: Workspace, analyses: list[StateAnalysis]) -> None:
    controls = StageControls(workspace, Navigation(workspace, lambda *_: None), lambda _: None)
    layout = layout_for(workspace.contract.input_size, 4, (1000, 900))
    html = controls.html(analyses[0], layout)
    side = round(layout.picture[0] * layout.unit)
    assert f"width:{side}px;height:{side}px" in html
    low = controls.html(analyses[0], layout_for(workspace.contract.input_size, 4, (390, 388)))
    assert "lpn-bars" in html
    assert "lpn-bars" not in low
    assert not controls.html(replace(analyses[0], state=replace(analyses[0].state, first_screen=True)), layout)


def test_notes_below_the_pair_explain_what_is_drawn(workspace: Workspace, analyses: list[StateAnalysis]) -> None:
    controls = StageControls(workspace, Navigation(workspace, lambda *_: None), lambda _: None)
    layout = layout_for(workspace.contract.input_size, 4, (390, 352))
    apart = replace(analyses[0], state=replace(analyses[0].state, exploded=True))
    flat, pulled = controls.html(analyses[0], layout), controls.html(apart, layout)
    assert "joins a part to its counterpart" in pulled
    assert "joins a part" not in flat
    pictures, notes = pulled.split('class="lpn notes"')
    assert "Opacity of the heatmap" not in pictures
    assert "Opacity of the heatmap" in notes
