"""The shipped stories show what their captions say."""

from __future__ import annotations

import re
from collections.abc import Callable

import pytest

from explorer.opening import open_model
from explorer.screen import fields
from explorer.screen.panels.stories.story import NAME, Story, read_stories
from explorer.screen.result import STRIP
from explorer.workspace import WorkspaceAnalyser
from lpn.core.demo import DEMO, DEMO_MODEL
from lpn.core.numbers import signed
from lpn.core.texts import ordinal
from lpn.library.answer import Answer
from lpn.retrieval import Match
from lpn.tasks.task import scored_key

STORIES = {story.name: story for story in read_stories(DEMO / NAME)}


def negative(shown: Answer) -> Match:
    return next(match for match in shown.matches if not match.true)


def positive(shown: Answer) -> Match:
    return shown.positive


def margin(shown: Answer) -> float:
    return negative(shown).distance2 - positive(shown).distance2


def off_m(shown: Answer, match: Match) -> str:
    return f"{shown.errors_m[match.index]:,.0f} m"


def adds(wrong: Match, part: int) -> str:
    return f"adds only {wrong.contributions[part]:.3f} to the wrong picture's difference of {wrong.distance2:.3f}"


def costs_most(shown: Answer, part: int) -> float:
    """Return a part's gain of the answer over the true tile, and check that no part's is larger."""
    cost = positive(shown).contributions - shown.matches[0].contributions
    assert cost.argmax() == part
    return -float(cost[part])


def prefer(shown: Answer, answer: tuple[int, ...], other: tuple[int, ...]) -> list[str]:
    """Check which rings, from 1, prefer the answer to the tile that the verdict compares it with."""
    gains = shown.verdict.gains
    assert all(gains[ring - 1] > 0 for ring in answer)
    assert all(gains[ring - 1] < 0 for ring in other)
    return []


def decides(shown: Answer, ring: int) -> list[str]:
    assert shown.verdict.headline.startswith(f"Ring {ring} decides")
    return prefer(shown, (3, 4), (1, 2))


# For each step: the first or compared tile, whether the true tile is first, and the words that the caption must have.
FACTS: dict[str, list[tuple[str, bool, Callable[[Answer], list[str]]]]] = {
    "A first look": [
        ("0394", True, lambda a: [f"with {len(a.task.gallery)} satellite tiles"]),
        ("0394", True, lambda _: ["magenta speaks for", "green against"]),
        ("0328", True, lambda a: decides(a, 4)),
        ("0394", True, lambda _: ["at every angle"]),
        ("0450", False, lambda a: [*prefer(a, (1, 3), (2, 4)), "is second", f"{off_m(a, a.chosen)} away"]),
        ("0450", False, lambda _: ["ring's share of the distance"]),
        ("0394", True, lambda _: []),
    ],
    "Found": [
        ("0394", True, lambda a: [f"Of {len(a.task.gallery)} satellite pictures"]),
        ("0338", True, lambda a: [off_m(a, a.chosen), f"behind by {a.chosen.distance2 - positive(a).distance2:.2f}"]),
        (
            "0394",
            True,
            lambda a: [f"{signed((negative(a).contributions - positive(a).contributions)[2], 2)} of the lead"],
        ),
        ("0394", True, lambda a: [off_m(a, a.chosen)]),
    ],
    "A twin": [
        ("0447", True, lambda a: [f"a lead of {margin(a):.2f}"]),
        ("0459", True, lambda a: [off_m(a, a.chosen), "comes second"][: a.chosen.rank]),
        ("0459", True, lambda a: ["Without ring 2", f"to {margin(a):.2f}"]),
        ("0452", False, lambda a: ["rings 3 and 4 alone", f"is {ordinal(positive(a).rank)}"]),
        ("0447", True, lambda a: ["ring 2 alone", f"a lead of {margin(a):.2f}"]),
    ],
    "Not found": [
        ("0450", False, lambda a: [f"is {ordinal(positive(a).rank)}", off_m(a, a.chosen)]),
        ("0450", False, lambda a: [f"{-margin(a):.2f} behind", f"most: {signed(costs_most(a, 2), 2)}"]),
        (
            "0450",
            False,
            lambda a: [adds(a.chosen, 2), f"but {positive(a).contributions[2]:.3f} to the right picture's"],
        ),
        ("0449", True, lambda a: ["centre and ring 3", f"a lead of {margin(a):.2f}"]),
        ("0450", False, lambda _: ["both frames overlap"]),
    ],
}
SCORINGS = {"A first look": "calibrated", "A twin": "plain", "Found": "csls", "Not found": "csls"}


@pytest.mark.slow
def test_each_step_of_the_shipped_stories_shows_what_its_caption_says() -> None:
    workspace = open_model(DEMO, DEMO_MODEL)
    analyser = WorkspaceAnalyser(workspace)
    assert {name: len(story.steps) for name, story in STORIES.items()} == {
        name: len(one) for name, one in FACTS.items()
    }
    for name, facts in FACTS.items():
        for step, (compared, found, said) in zip(STORIES[name].steps, facts, strict=True):
            state, problems = fields.from_values(fields.parsed(step.shows), workspace)
            assert not problems
            assert (state.scoring, fields.parsed(step.shows)["scoring"]) == (SCORINGS[name],) * 2
            shown = analyser.analyse(workspace.ranking(state.task, state.scoring).task, state.question(), STRIP)
            assert shown.task.scoring == SCORINGS[name]
            assert shown.task.gallery[shown.chosen.index].name == compared, step.caption
            assert (positive(shown).rank == 1) is found, step.caption
            for text in said(shown):
                assert text in step.caption
    states = {name: [fields.parsed(step.shows) for step in story.steps] for name, story in STORIES.items()}
    assert [one.get("weights") for one in states["A twin"]] == [None, None, "1,0,1,1", "0,0,1,1", "0,1,0,0"]
    assert [one.get("shows") for one in states["A first look"]] == [None, "evidence", *[None] * 5]
    assert states["A first look"][5]["view"] == "apart"
    assert states["Not found"][3]["weights"] == "0,1,0,1"

    task = next(iter(workspace.tasks.values()))
    ranking = workspace.rankings[scored_key(task.name, "csls")]
    of_place = [i for i, entry in enumerate(task.queries) if entry.name.startswith("0449/")]
    answers = [task.gallery[int(ranking.result.ranking.best[i])].name for i in of_place]
    assert len(answers) == sum(name != "0449" for name in answers) == 8
    assert answers.count("0450") == 7
    assert "All eight pictures of this place fail, seven of them with this twin" in STORIES["Not found"].steps[0].notes
    state, _ = fields.from_values(fields.parsed(STORIES["Not found"].steps[-1].shows), workspace)
    shown = analyser.analyse(workspace.ranking(state.task, state.scoring).task, state.question(), STRIP)
    places = shown.task.geometry
    apart = abs(places.ground[shown.chosen.index] - places.ground[positive(shown).index])
    assert (apart < places.width).all(), "the frames overlap"

    turned = STORIES["A first look"].steps[3]
    state, _ = fields.from_values(fields.parsed(turned.shows), workspace)
    angles = [state.with_value("angle", float(angle)) for angle in range(-180, 180, 15)]
    ranks = [
        positive(analyser.analyse(workspace.ranking(one.task, one.scoring).task, one.question(), STRIP)).rank
        for one in angles
    ]
    assert set(ranks) == {1}, "it is found at every angle of the curve"


@pytest.mark.parametrize("story", STORIES.values(), ids=str)
def test_the_shipped_stories_are_told_in_plain_words(story: Story) -> None:
    for step in story.steps:
        said = f"{step.caption} {step.notes}"
        assert not re.search(r"\b(margin|d²|query|queries|parts?|descriptors?)\b|n = ", said), said
        assert all(len(one.split()) <= 30 for one in re.split(r"[.:!?] ", said)), said
