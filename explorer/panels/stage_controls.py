"""The controls over the stage's pictures: steps, what is shown, the handle that turns the query, and the bars of the parts."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

from explorer import judge, session_state
from explorer.layout import Box, ScreenLayout
from explorer.panels import answer_text, messages, pages
from explorer.panels.messages import StageMessage
from explorer.panels.navigation import Navigation
from explorer.session_state import SessionState, StateChange
from explorer.stage.pictures import lead_colours
from explorer.web.render import render
from explorer.workspace import StateAnalysis, Workspace
from lpn.core.numbers import rounded_to_sum, shown_difference, signed
from lpn.drawing import theme
from lpn.drawing.theme import Colour

# A full bar, relative to the largest part weight: the share of d² of a part whose cosine is 0, and room for the terms of CSLS.
_UNLIKE, _UNLIKE_CSLS = 2.0, 3.5


@dataclass(frozen=True)
class PartBar:
    """The bars of one part.

    Attributes:
        share: the part's share of d² in figures, and in percent of the bar's room.
        lead: the part's term of the lead in figures, and in percent of half of the bar's room, negative to the left;
            None without a lead.
        decisive: the verdict names the part.
        off: the part does not count.
    """

    name: str
    share: tuple[str, float]
    lead: tuple[str, float] | None
    decisive: bool
    off: bool


def part_bars(
    analysis: StateAnalysis, names: list[str], judged: str = ""
) -> tuple[list[PartBar], answer_text.Lead | None, float]:
    """Return the bars of the compared pair's parts, the lead that they show, and the d² of a full bar.

    All pictures have one scale, which depends on the part weights and on CSLS alone; it doubles where a bar would not fit. Where
    the verdict speaks of the compared tile, the lead is the verdict's, and the parts that its headline names are marked.

    Args:
        judged: see `answer_text.lead`.
    """
    chosen, lead = analysis.chosen, answer_text.lead(analysis, judged)
    first, marked = analysis.matches[0], analysis.verdict.parts
    if chosen.index not in (first.index, None if lead is None else lead.index):
        terms = chosen.contributions - first.contributions
        lead = answer_text.Lead(
            terms,
            shown_difference(chosen.distance2, first.distance2),
            "this tile",
            chosen.index,
            answer_text.answer_name(analysis),
            sure=bool(first.true),
        )
        marked = tuple(lead.decisive)
    full = (_UNLIKE if chosen.constants is None else _UNLIKE_CSLS) * float(analysis.ranking.weights.max())
    most = max([*chosen.contributions.tolist(), *([] if lead is None else (2 * abs(lead.terms)).tolist())])
    while most > full:
        full *= 2
    shares = rounded_to_sum(chosen.contributions.tolist())
    figures = [] if lead is None else lead.figures
    bars = []
    for part, name in enumerate(names):
        share = float(chosen.contributions[part])
        off = analysis.ranking.weights[part] == 0
        bars.append(
            PartBar(
                name,
                ("off" if off else f"{shares[part]:.3f}", _percent(share, full)),
                None if lead is None else (signed(figures[part]), _percent(float(lead.terms[part]), full / 2)),
                part in marked,
                bool(off),
            )
        )
    return bars, lead, full


def _percent(value: float, full: float) -> float:
    return round(100 * max(-1.0, min(value / full, 1.0)), 1)


class StageControls:
    """One browser's controls over the stage.

    Args:
        change: updates the browser's state with a function.
        look: looks through the photo's camera for True, and takes note for False that the view has been moved away.
    """

    def __init__(
        self,
        workspace: Workspace,
        navigation: Navigation,
        change: Callable[[StateChange], None],
        look: Callable[[bool], None] = lambda _: None,
    ) -> None:
        self._workspace, self._change, self._look = workspace, change, look
        self._steps: dict[str, StateChange] = {
            "previous": navigation.previous,
            "next": navigation.next,
            "random": navigation.random,
            "failure": navigation.failure,
        }

    def html(self, analysis: StateAnalysis, layout: ScreenLayout) -> str:
        """Return the controls over the pictures of an analysis; empty on the first screen."""
        state, workspace = analysis.state, self._workspace
        if state.first_screen:
            return ""
        bars, lead, full = part_bars(analysis, workspace.part_names, judge.judged_piece(analysis, workspace))
        sure = lead is not None and lead.sure and judge.is_sure(analysis, workspace)
        colours = _lead_names(*lead_colours(sure))
        areas = [
            workspace.areas(view, described)
            for view, described in zip(analysis.task.views, (analysis.query, analysis.tile), strict=True)
        ]
        boxes = [[] if one is None or state.exploded else one.outlines for one in areas]
        turn = math.radians(state.angle)
        return render(
            "panels/stage",
            state=state,
            layout=layout,
            css=lambda box: _css(box, layout),
            boxes=boxes,
            bars=bars,
            lead=lead,
            colours=colours,
            total=analysis.chosen.distance2,
            full=full,
            network=workspace.model is not None,
            knob=(50 - 42 * math.sin(turn), 50 - 42 * math.cos(turn)),
            heat="off" if not state.heat else state.heat_kind,
            cells=not workspace.without_cells,
            legend=pages.heat_legend(analysis, workspace),
            mapped=analysis.task.geometry is not None,
            partitioned=areas[0] is not None and workspace.has_parts,
            several=workspace.has_parts,
            parts_word=f"{workspace.contract.part_noun}s",
            graded=analysis.ranking.relevant is not None,
        )

    def receive(self, message: StageMessage) -> None:
        """Do what a message of the controls asks for; one that means nothing in this state changes nothing."""
        match message:
            case messages.StepQuery(step):
                self._change(self._steps[step])
            case messages.FlipLook(look):
                self._change(lambda state: self._flip(state, look))
            case messages.LookThrough():
                self._look(True)
            case messages.LookAway():
                self._look(False)
            case messages.ShowHeat(kind):
                self._change(lambda state: _heat(state, kind))
            case messages.SetOpacity(opacity):
                self._change(lambda state: replace(state, opacity=opacity))
            case messages.TurnQuery(angle) if self._workspace.model is not None:
                self._change(lambda state: replace(state, angle=angle))
            case messages.FlipPart(part) if part <= self._workspace.contract.n_parts:
                self._change(lambda state: session_state.flip_part(state, part - 1))

    def _flip(self, state: SessionState, look: str) -> SessionState:
        if look == "map":
            return session_state.show_map(
                state, not state.map and self._workspace.tasks[state.task].geometry is not None
            )
        return session_state.with_field(state, look, not getattr(state, look))


def _heat(state: SessionState, kind: str) -> SessionState:
    return (
        replace(state, heat=False)
        if kind == "off"
        else session_state.with_field(replace(state, heat=True), "heat_kind", kind)
    )


def _lead_names(leader: Colour, follower: Colour) -> tuple[str, str]:
    """Return the names of two colours in the table of the theme."""
    names = {colour: name for name, colour in theme.COLOURS.items()}
    return names[leader], names[follower]


def _css(box: Box, layout: ScreenLayout) -> str:
    """Return a box of the stage as CSS has it, in pixels of the stage."""
    (x, y), (width, height) = box
    left, top = (
        (x - width / 2) * layout.unit + layout.stage[0] / 2,
        layout.stage[1] / 2 - (y + height / 2) * layout.unit,
    )
    return f"left:{left:.0f}px;top:{top:.0f}px;width:{width * layout.unit:.0f}px;height:{height * layout.unit:.0f}px"
