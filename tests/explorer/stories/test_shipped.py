"""The shipped stories show what their captions say."""

from __future__ import annotations

import re
from collections.abc import Callable

import pytest

from explorer.opening import open_model
from explorer.session_state import SessionState
from explorer.stage.cards import SHOWN
from explorer.stories import library
from explorer.url_state import UrlState
from explorer.workspace import StateAnalyser, StateAnalysis
from lpn.core.demo import DEMO, DEMO_MODEL
from lpn.core.numbers import signed
from lpn.drawing.verdicts import ordinal
from lpn.retrieval import Match
from lpn.tasks.task import scored_key


def negative(shown: StateAnalysis) -> Match:
    return next(match for match in shown.matches if not match.true)


def positive(shown: StateAnalysis) -> Match:
    assert shown.positive is not None
    return shown.positive


def margin(shown: StateAnalysis) -> float:
    return negative(shown).distance2 - positive(shown).distance2


def off_m(shown: StateAnalysis, match: Match) -> str:
    assert shown.errors_m is not None
    return f"{shown.errors_m[match.index]:,.0f} m"


def adds(wrong: Match, part: int) -> str:
    return f"adds only {wrong.contributions[part]:.3f} to the wrong picture's difference of {wrong.distance2:.3f}"


def is_found(shown: StateAnalysis) -> bool:
    return positive(shown).rank == 1


def costs_most(shown: StateAnalysis, part: int) -> float:
    """Return what a part costs the true tile against the answer, and check that no other costs it more."""
    cost = positive(shown).contributions - shown.matches[0].contributions
    assert cost.argmax() == part
    return -float(cost[part])


# For each step: the compared tile, whether the true tile is first, and what the caption must say by the analysis.
FACTS: list[list[tuple[str, bool, Callable[[StateAnalysis], list[str]]]]] = [
    [
        ("0394", True, lambda a: [f"Of {len(a.task.gallery)} satellite pictures"]),
        ("0338", True, lambda a: [off_m(a, a.chosen), f"behind by {a.chosen.distance2 - positive(a).distance2:.2f}"]),
        (
            "0394",
            True,
            lambda a: [f"{signed((negative(a).contributions - positive(a).contributions)[2], 2)} of the lead"],
        ),
        ("0394", True, lambda a: [off_m(a, a.chosen)]),
    ],
    [
        ("0447", True, lambda a: [f"a lead of {margin(a):.2f}"]),
        ("0459", True, lambda a: [off_m(a, a.chosen), "comes second"][: a.chosen.rank]),
        ("0459", True, lambda a: ["Without ring 2", f"to {margin(a):.2f}"]),
        ("0452", False, lambda a: ["rings 3 and 4 alone", f"is {ordinal(positive(a).rank)}"]),
        ("0447", True, lambda a: ["ring 2 alone", f"a lead of {margin(a):.2f}"]),
    ],
    [
        ("0450", False, lambda a: [f"is {ordinal(positive(a).rank)}", off_m(a, a.chosen)]),
        ("0449", False, lambda a: [f"{-margin(a):.2f} behind", f"most: {signed(costs_most(a, 2), 2)}"]),
        (
            "0450",
            False,
            lambda a: [adds(a.chosen, 2), f"but {positive(a).contributions[2]:.3f} to the right picture's"],
        ),
        ("0449", True, lambda a: ["centre and ring 3", f"a lead of {margin(a):.2f}"]),
        ("0450", False, lambda _: ["both frames overlap"]),
    ],
]


@pytest.mark.slow
def test_each_step_of_the_shipped_stories_shows_what_its_caption_says() -> None:
    workspace = open_model(DEMO, DEMO_MODEL)
    url_state, analyser = UrlState(workspace), StateAnalyser(workspace)
    stories = list(library.read_all(DEMO).by_name.values())
    assert [len(told.steps) for told in stories] == [len(facts) for facts in FACTS]
    for told, facts in zip(stories, FACTS, strict=True):
        for step, (compared, found, said) in zip(told.steps, facts, strict=True):
            plain = SessionState(next(iter(workspace.tasks)), workspace.contract.n_parts)
            state, problems = url_state.read(step.shows, plain)
            assert not problems
            assert url_state.write(state) == step.shows, "as it would be recorded"
            shown = analyser.analyse(state, SHOWN)
            assert shown.task.gallery[shown.chosen.index].name == compared, step.caption
            assert is_found(shown) is found, step.caption
            for text in said(shown):
                assert text in step.caption
            # By CSLS, or, where that tells another story, by the plain scoring, which the first step names.
            assert shown.task.scoring == ("csls" if told.name != "A twin" else "plain")
    assert "Compared as they are, without adjusting" in stories[1].steps[0].caption
    parts_off = [step.shows.partition("off=")[2] for told in stories for step in told.steps if "off=" in step.shows]
    assert parts_off == ["2", "1,2", "1,3,4", "1,3"]
    task = next(iter(workspace.tasks.values()))
    ranking = workspace.rankings[scored_key(task.name, "csls")]
    assert ranking.result is not None
    of_place = [i for i, entry in enumerate(task.queries) if entry.name.startswith("0449/")]
    answers = [task.gallery[int(ranking.result.ranking.best[i])].name for i in of_place]
    assert len(answers) == sum(name != "0449" for name in answers) == 8
    assert answers.count("0450") == 7
    assert "All eight pictures of this place fail, seven of them with this twin" in stories[2].steps[0].notes
    overlap = stories[2].steps[-1]
    state, _ = url_state.read(overlap.shows, SessionState(next(iter(workspace.tasks)), 4))
    shown = analyser.analyse(state, SHOWN)
    places = shown.task.geometry
    assert state.map
    assert places is not None
    apart = abs(places.ground[shown.chosen.index] - places.ground[positive(shown).index])
    assert (apart < places.width).all(), "the frames overlap"


def test_the_shipped_stories_are_told_in_plain_words() -> None:
    for told in library.read_all(DEMO).by_name.values():
        for step in told.steps:
            said = f"{step.caption} {step.notes}"
            assert not re.search(
                r"\b(tiles?|margin|d²|query|queries|parts?|descriptors?|rank|evidence)\b|n = ", said
            ), said


def test_the_demo_s_first_screen_offers_three_stories() -> None:
    assert list(library.read_all(DEMO).by_name) == ["Found", "A twin", "Not found"]
