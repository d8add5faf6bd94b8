"""The sentences on one answer, made once for the first screen and for a report."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

from markupsafe import Markup, escape

from explorer import session_state
from explorer.panels import answer_text, place_text
from explorer.panels.radius_text import dependence, holds, with_radius
from explorer.web.render import SIGNS
from explorer.workspace import StateAnalysis, Workspace
from lpn.datasets.rendered import shows_rendered
from lpn.drawing import words

# The figure of a flight is that of retrieval alone.
_ALONE = "each searched by itself"
_FROM = {"drone": "from a drone", "satellite": "from a satellite", "street": "from the street"}
_NOT_ENDED = "When this was saved, its details were still being compared with the map."
# True if it is right (None: unknown), a headline, and a sentence.
_Verdict = tuple[bool | None, str, str]


@dataclass(frozen=True)
class AnswerLines:
    """The sentences on an answer; one that has nothing to say is "".

    Attributes:
        question: to which the pictures are the answer.
        purpose: what the program searches, as HTML.
        query, answer: what the two pictures are.
        verdict: what the program concludes.
        doubted: details place the photo, and something contradicts them.
        radius: how exact the place should be, as HTML.
        dependence: that the tags which place the map are no second witness.
        by_look: the verdict on the look alone where `verdict` is of all methods; else None.
        comparing: how far the comparison of an own picture's details with the map is.
        waits: that comparison has not ended.
        ground: where the photo lies on the map, as HTML.
        next_step: what a person can do about a doubt.
        altered: what alters the query or the search, by the argument of `session_state.undo`.
        trust_name, trust: how far one may trust the answer.
        overall: how often answers are right here, or what becomes of an own picture.
        season: if map and photos are of two seasons.
        criterion: when an answer counts as right, who judges, on which side of the edge this one lies, and how far a tag may.
    """

    question: str
    purpose: str
    query: str
    answer: str
    verdict: _Verdict
    doubted: bool
    radius: str
    dependence: str
    by_look: _Verdict | None
    comparing: str
    waits: bool
    ground: str
    next_step: str
    altered: Mapping[str, str]
    trust_name: str
    trust: str
    overall: str
    season: str
    criterion: str

    @property
    def headline(self) -> str:
        """The verdict in some words, without HTML."""
        return _headline(self.verdict).striptags()

    @property
    def told(self) -> tuple[str, ...]:
        """The other lines as paragraphs without HTML, but for `criterion`."""
        lines = (
            self.verdict[2],
            Markup("{} {}").format(self.radius, self.dependence),
            _NOT_ENDED if self.waits else self.comparing,
            self.ground,
            "" if self.by_look is None else Markup("{} {}").format(_headline(self.by_look), self.by_look[2]),
            self.next_step and f"What next: {self.next_step}",
            self.altered and f"Altered by: {', '.join(self.altered.values())}.",
            self.trust and f"{self.trust_name}: {self.trust}",
            f"{self.overall} {self.season}",
            self.purpose,
        )
        return tuple(filter(None, (escape(line).striptags() for line in lines if line)))


def answer_lines(
    analysis: StateAnalysis,
    workspace: Workspace,
    looked: _Verdict,
    concluded: _Verdict | None,
    ground: str,
    errs: bool,
    linked: bool = True,
) -> AnswerLines:
    """Return the sentences on an answer in the words that are spoken.

    Args:
        looked: the verdict on its look.
        concluded: that of all methods; None without others.
        ground: where the photo lies on the map, as HTML.
        errs: the look is known to be wrong.
        linked: places have a link to OpenStreetMap.
    """
    state, task, registered = analysis.state, analysis.task, workspace.details(analysis)
    right, headline, sentence = concluded or looked
    own, job = state.upload is not None, analysis.own_photo
    answer = "The model’s answer" if analysis.chosen.rank == 1 else f"Rank {analysis.chosen.rank}"
    if own and workspace.own_photos and analysis.chosen.rank == 1:
        answer = "Most similar by its look"
    altered = session_state.alterations(state, math.prod(workspace.map_sizes[task.query_view]))

    judged = (
        place_text.criterion(workspace, task),
        answer_text.limit(analysis, workspace),
        answer_text.tag_limit(analysis, workspace),
        answer_text.doubts(workspace),
    )

    def told(text: str) -> str:
        return with_radius(text, registered, workspace)

    return AnswerLines(
        question="Where was this picture taken?"
        if task.gallery_view == "satellite"
        else "Which picture shows this place?",
        purpose=Markup(place_text.place(workspace, task, linked)),
        query="Your picture" if own else f"A picture {_FROM[task.query_view]}",
        answer=answer,
        verdict=(right, told(headline), told(sentence)),
        doubted=right is None and registered is not None and registered.accepted,
        radius=holds(registered, workspace, right is None),
        dependence=dependence(registered, workspace),
        by_look=None if concluded is None else looked,
        comparing="" if job is None else answer_text.comparing(job),
        waits=job is not None and job.value is None and job.error is None,
        ground=ground,
        next_step=answer_text.next_step(analysis, workspace),
        altered={str(kind): label for kind, label in altered.items()},
        trust_name="How far one would trust it, not knowing that it is wrong"
        if errs and not own and not workspace.has_flight
        else "How far to trust it",
        trust=answer_text.trust(analysis, workspace),
        overall=_overall(analysis, workspace, bool(altered)),
        season="" if own else place_text.season(workspace),
        criterion="" if own else " ".join(filter(None, judged)),
    )


def _headline(verdict: _Verdict) -> Markup:
    right, headline, _ = verdict
    return Markup("{} {}.").format(SIGNS[right], headline)


def _overall(analysis: StateAnalysis, workspace: Workspace, altered: bool) -> str:
    """Say how often the model is right, and if it is calibrated; of the user's own picture, how it is seen."""
    if analysis.state.upload:
        rendered = shows_rendered(workspace.root)
        city = (
            f"The city is {words.say('rendered')}: a photo of a real place has no right answer in it."
            if rendered
            else ""
        )
        return " ".join(filter(None, (city, answer_text.own_shape(analysis, workspace))))
    text = answer_text.overall(*workspace.counts(workspace.rankings[analysis.task.key]), altered)
    if text and workspace.has_flight:
        text = "" if answer_text.few_photos(workspace, analysis.task) else f"{text[:-1]}, {_ALONE}."
    if not text or not analysis.task.calibration:
        return text
    if words.plain():
        return f"{text} The model is adjusted to these pictures."
    csls = ", and its answers are re-ranked by CSLS" if analysis.task.neighbours else ""
    return f"{text} The model is calibrated on these pictures{csls}."
