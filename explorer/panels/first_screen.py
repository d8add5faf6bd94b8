"""The first screen: one query, its answer, one sentence, and on request the reason; it lies over the rest of the page."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from pathlib import Path

import cv2
import numpy as np
import viser
from markupsafe import Markup
from numpy.typing import NDArray

from explorer import judge, lab_choices, session_state
from explorer.browse.own_pictures import OwnPictures
from explorer.compute.cache import SingleFlightCache
from explorer.lab_choices import Tab
from explorer.panels import answer_text, place_text, wrong_answer
from explorer.panels.answer_lines import AnswerLines, answer_lines
from explorer.panels.details_pair import details_pair
from explorer.panels.navigation import Navigation
from explorer.panels.radius_text import check
from explorer.session_state import SessionState, StateChange
from explorer.stage.pictures import draw_parts, lead_cells, lead_colours, no_place
from explorer.web.coordinates import MapCoordinate
from explorer.web.html import Html
from explorer.web.render import call, render, run
from explorer.web.style import verdict_ink
from explorer.web.terms import term
from explorer.workspace import StateAnalysis, Workspace
from lpn.core import images
from lpn.core.arrays import BoolArray, Float64Array, FloatingArray, UInt8Array
from lpn.core.errors import PictureError
from lpn.core.files import printable
from lpn.core.numbers import heading_figure
from lpn.core.progress import CountProgress
from lpn.core.views import View
from lpn.datasets.rendered import shows_rendered
from lpn.drawing import captions, overlays, theme, verdicts, words
from lpn.drawing.theme import Colour
from lpn.explain.lead_places import LeadPlace, lead_place
from lpn.flights.cut import TurnedFrame
from lpn.flights.photo_file import PhotoFile
from lpn.library.matching_turn import MatchingTurn, matching_turn
from lpn.locate.belief import belief, disagreements, tag_figures
from lpn.locate.coverage import outline
from lpn.locate.grades import is_disputed, off_window, window_of
from lpn.locate.located import LocatedFrame, StageRecord
from lpn.locate.retrieval import heading_is_certain
from lpn.maps import Map
from lpn.maps.named_window import describe_offset
from lpn.maps.tag_placed import placing_sentence
from lpn.report import Said, SaidPicture
from lpn.retrieval import DescribedPicture

# Map files, and bytes of them, up to which a saved answer has their SHA-256.
_MOST_MAP_FILES, _MOST_MAP_BYTES = 20, 1_000_000_000
# The SHA-256 of files, by path and time of the last change, and the bytes that are read at once for one.
_digests: SingleFlightCache[tuple[Path, int], str] = SingleFlightCache(64)
_PIECE_BYTES = 16_000_000
# Sentences for a photo whose tag and registration contradict each other, by whether the answer is right by the tag.
_DISPUTED = {
    False: "By its GPS tag the photo lies elsewhere. Laid over the map by its details, it lies on this piece.",
    True: "By its GPS tag the photo lies on this piece. Laid over the map by its details, it lies elsewhere.",
}
# The commands for a place of one's own.
_BRING = """\
pip install "lpn-explorer[maps]"
lpn map ortho.tif --out maps/here
lpn explore photos/ --map maps/here --model city-lpn"""
# Height of the pictures in pixels, and the largest width of a panorama.
_SIZE = 420, 1100
# The grey of a map's places without data.
_NOTHING = 40
_ON_MAP = "On the map, by its details"
# A turn of fewer degrees is not worth a word.
_LEVEL = 3
_TURNED_BY = {
    "heading": "The top of the query points another way than north, by its known heading; the answer is turned to lie like it.",
    "registration": "The answer is turned to lie like the photo, by where the photo fits the map.",
    "model": "The answer is turned to where its places fit those of the query best, as the model sees both; no heading is known.",
}


@dataclass(frozen=True)
class LaidPhoto:
    """A photo laid over its map by its details.

    Attributes:
        picture: the map with the ground that the photo shows, as a data URI.
        sign: True, or None where its GPS tag disagrees.
        offset: where the place lies on the map, in words.
        coordinate: the place; None on a rendered map.
        camera: whether the place is the camera's, and not that of the picture's middle.
        by_tags: whether the map's own place on earth is that of the GPS tags of photos, whose error is not known.
        sentence: how far its GPS tag lies from there; "" without one, and for an own photo, whose verdict says it.
    """

    picture: str
    sign: bool | None
    offset: str
    coordinate: MapCoordinate | None
    camera: bool
    by_tags: bool
    sentence: str


@dataclass(frozen=True)
class _Verdicts:
    """The verdicts on an answer: each whether it is right (None: unknown), a headline, and a sentence.

    Attributes:
        look: on the look alone.
        concluded: of all methods; None without others.
        disputed: whether GPS tag and details place the photo on two sides of the answer's edge.
        look_errs: whether the look is known to be wrong.
    """

    look: tuple[bool | None, str, str]
    concluded: tuple[bool | None, str, str] | None
    disputed: bool
    look_errs: bool


class FirstScreen:
    """One browser's first screen; it is visible while `SessionState.first_screen` is set.

    Args:
        change: updates the browser's state with a function.
        show_lab: has the laboratory show what a state says of it.
        own: the user's own pictures; None where there is no model to describe them.
    """

    def __init__(
        self,
        gui: viser.GuiApi,
        workspace: Workspace,
        navigation: Navigation,
        change: Callable[[StateChange], None],
        show_lab: Callable[[SessionState], None],
        own: OwnPictures | None,
    ) -> None:
        self._workspace, self._change = workspace, change
        self._show_lab, self._own = show_lab, own
        self._html = Html(gui)
        self._actions: dict[str, StateChange] = {
            "next": navigation.random,
            "own": lambda state: None if own is None else own.reopen(state),
            "forget": self._forget,
            "own-previous": navigation.previous,
            "own-next": navigation.next,
            "failure": navigation.next_failure,
            "why": session_state.flip_why,
            "start": session_state.to_first_screen,
            "data": lambda state: replace(session_state.leave_upload(state), why=False),
            "first": lambda state: session_state.start_place(
                state, workspace.first_query, len(workspace.tasks[state.task].queries)
            ),
            "all": session_state.show_everything,
            "workbench": lambda state: replace(state, first_screen=False, why=False),
            "cells": lambda state: replace(state, first_screen=False, why=True, why_tab="comparison"),
            "lab": lambda state: self._to_lab(state, "table"),
            "fails": self._to_fails,
            "charts": lambda state: self._to_lab(state, "breakdown"),
            "fail-next": navigation.next,
            "fail-previous": navigation.previous,
            "map": lambda state: replace(state, map=True, why=False),
            "apart": lambda state: replace(state, exploded=True, why=False),
            "on-map": session_state.show_map_alone,
            "flight": lambda state: replace(state, flight=True, why=False),
        }

    def act(self, action: str) -> None:
        """Do what a control of the screen says; an unknown name does nothing."""
        if action in self._actions:
            self._change(self._actions[action])

    def show(self, analysis: StateAnalysis, stories: Sequence[str]) -> None:
        """Show an analysis and the names of stories, or close the screen, as the state says."""
        state = analysis.state
        content = ""
        if state.first_screen:
            position, held, brought = None, 0, False
            if self._own is not None:
                position, held, brought = self._own.position(state.upload), self._own.held, self._own.brought
            content = page(analysis, self._workspace, stories, position, held, brought)
        elsewhere = state.why or state.lab or state.flight or state.map or state.exploded
        self._html.show(run(call("first", content, not elsewhere, not state.upload)))

    def fail(self, reason: str) -> None:
        """Say why there is no first answer, with buttons that load the page again and choose another picture."""
        self._html.show(run(call("unopened", reason, True)))

    def _to_fails(self, state: SessionState) -> SessionState:
        """Show the wrong answers in plain words; else, without any, or before they are known, the laboratory's charts."""
        wrong = wrong_answer.rows(self._workspace, state) if state.plain else None
        if wrong is None or not len(wrong):
            return self._to_lab(state, "breakdown")
        return session_state.show_fails(state, int(wrong[0]), len(self._workspace.tasks[state.task].queries))

    def _forget(self, _: SessionState) -> None:
        """Forget all own pictures, which shows a query of the data set again."""
        if self._own is not None:
            self._own.close()

    def _to_lab(self, state: SessionState, tab: Tab) -> SessionState:
        """Open a tab of the laboratory with all queries, whatever was chosen or filtered there before."""
        all_queries = replace(lab_choices.show_all(state.laboratory), tab=tab)
        state = replace(state, lab=True, why=False, laboratory=all_queries)
        self._show_lab(state)
        return state


def page(
    analysis: StateAnalysis,
    workspace: Workspace,
    stories: Sequence[str] = (),
    own_position: tuple[int, int] | None = None,
    own_held: int = 0,
    own_brought: bool = False,
) -> str:
    """Return the screen's content as HTML.

    Args:
        own_position: of the own picture that is shown, and the number of those held; None without one.
        own_held: number of own pictures held.
        own_brought: the one that was shown last was sent at another place.
    """
    state, task = analysis.state, analysis.task
    rendered = shows_rendered(workspace.root)
    found = _verdicts(analysis, workspace)
    disputed = found.disputed
    wrong = None if state.why else wrong_answer.wrong_answer(analysis, workspace)
    errs = found.look[0] is False and not state.upload
    lead = answer_text.lead(analysis, judge.judged_piece(analysis, workspace)) if state.why else None
    cells_of_parts = None if lead is None else _lead_cells(analysis, lead)
    why_wrong = f"{analysis.verdict.headline}." if errs and analysis.positive is not None else ""
    # The page of wrong answers and the explanation of the look have this sentence, too.
    off_map = "" if wrong or state.why else place_text.off_map(task.gallery[analysis.chosen.index], "this answer")
    cells = None if lead is None or cells_of_parts is None else cells_of_parts.sum(axis=0)
    # What speaks for a picture has the colour of its frame.
    sure = lead is not None and lead.sure and found.look[0] is not None
    colours = lead_colours(sure)
    positive, third = analysis.positive, None if lead is None else lead.index
    own = analysis.registered
    located = workspace.located(analysis)
    laid = None if state.why or wrong else _laid(located, workspace, own is not None)
    lines = _lines(analysis, workspace, found, laid)
    headline = found.concluded[1] if found.concluded else found.look[1]
    if third is None and laid is None and (found.look_errs or wrong) and positive is not None:
        third = positive.index
    turn, matched = _turn(analysis, workspace), details_pair(analysis, workspace) if state.why else None
    because = _because(analysis, workspace, lead, cells_of_parts, matched is not None)
    return render(
        "wrong_answer" if wrong else "first_screen",
        wrong=wrong,
        third_name="" if third is None else place_text.piece(task.gallery[third]),
        workspace=workspace,
        task=task,
        state=state,
        name=analysis.name,
        lines=lines,
        waits=lines.waits and not state.why,
        answer_name=place_text.piece(task.gallery[analysis.chosen.index]),
        query=_picture(analysis, workspace, analysis.query, task.query_view, cells, colours),
        tile=_picture(analysis, workspace, analysis.tile, task.gallery_view),
        chosen=analysis.chosen,
        sign=_frame_sign(analysis, found),
        sure=sure,
        laid=laid,
        turn=turn,
        turned_by=_turned_by(analysis, workspace, turn),
        third=_third_tile(analysis, workspace, third, disputed, found.look[0] is None)
        if third is not None and analysis.chosen.rank == 1
        else None,
        matched=matched,
        lead=lead,
        because=because,
        errs=" ".join(filter(None, (off_map, why_wrong))) if errs and not wrong else "",
        failures=_failures(workspace, state),
        context=answer_text.context(analysis, workspace, lead.shown) if lead is not None else "",
        bring=_BRING,
        gap=analysis.matches[0].shown_gap,
        bars=_bar_colours(sure),
        places=None if cells is None else float(cells.sum()),
        no_place=no_place(analysis),
        nowhere=own is not None and not own.answer.accepted,
        full=0.0 if lead is None else max(float(abs(lead.terms).max()), 1e-9),
        part_names=workspace.part_names,
        part_word=workspace.contract.part_noun,
        stories=stories,
        own_position=own_position,
        own_held=own_held,
        own_elsewhere=own_brought and rendered,
        no_link=answer_text.NO_LINK if state.upload else "",
        elsewhere=state.upload is not None
        and (headline in answer_text.ELSEWHERE or (own is not None and not own.answer.accepted)),
        heat=[] if cells is None else [theme.css(colour) for colour in colours],
        kept=answer_text.OWN_KEPT if state.upload else "",
        rendered=rendered,
        untried=place_text.untried(workspace),
        damage=place_text.UNTRIED,
        moved_on=state.task == next(iter(workspace.tasks)) and (state.query != workspace.first_query or state.why),
    )


def _verdicts(analysis: StateAnalysis, workspace: Workspace) -> _Verdicts:
    look = answer_text.plain_verdict(analysis, workspace)
    right, state = look[0], analysis.state
    disputed = (
        workspace.flight is not None
        and state.upload is None
        and right is not None
        and is_disputed(workspace.flight, analysis.task, state.query, analysis.matches[0].index, right)
    )
    look_errs = right is False and not disputed
    look, concluded = answer_text.flight_verdict(analysis, workspace, look)
    if disputed and concluded is not None and concluded[0]:
        look = None, "Not graded", "Its GPS tag and its place by its details lie on two sides of this piece's border."
    elif disputed:
        look = None, "Its GPS tag and the map disagree", _DISPUTED[right is True]
    return _Verdicts(look, concluded, disputed, look_errs)


def _frame_sign(analysis: StateAnalysis, found: _Verdicts) -> bool | None:
    """Return if the answer that is shown is right; None where that is not known, or its judge is in doubt."""
    return None if found.look[0] is None else analysis.chosen.true


def _lines(
    analysis: StateAnalysis, workspace: Workspace, verdict: _Verdicts, laid: LaidPhoto | None, linked: bool = True
) -> AnswerLines:
    own = analysis.registered is not None or analysis.state.why
    details = "" if own else _details(workspace.details(analysis), "the photo")
    ground = _ground(details, laid, linked)
    return answer_lines(analysis, workspace, verdict.look, verdict.concluded, ground, verdict.look_errs, linked)


def _ground(details: str, laid: LaidPhoto | None, linked: bool) -> str:
    """Return HTML that says how a photo lies on the map, and where on earth.

    Args:
        details: how many of them agree with the map; "" if that is said elsewhere.
        linked: the coordinate has a link to OpenStreetMap.
    """
    before, name, after = details.partition("details")
    sentences = [Markup("{}{}{}.").format(before, term(name), after) if name else "", laid.sentence if laid else ""]
    if laid and laid.coordinate:
        whose = "The drone was above" if laid.camera else "The photo's middle lies at"
        by_tags = ", on earth no better than the GPS tags by which the map was made" if laid.by_tags else ""
        sentences.append(Markup("{} {}{}.").format(whose, laid.coordinate.html(linked), by_tags))
    return Markup(" ").join(filter(None, sentences))


def said(analysis: StateAnalysis, workspace: Workspace, on_read: CountProgress = lambda *_: None) -> Said:
    """Return what the screen says of an answer, and its pictures, for a file that is read without it.

    Args:
        on_read: see `_map_facts`.
    """
    analysis = replace(analysis, state=replace(analysis.state, why=False))
    laid = _laid(workspace.located(analysis), workspace, analysis.registered is not None)
    found, positive = _verdicts(analysis, workspace), analysis.positive
    lines = _lines(analysis, workspace, found, laid, linked=False)
    task, turn, chosen = analysis.task, _turn(analysis, workspace), analysis.chosen
    middle = ", its middle" if workspace.has_flight and analysis.state.upload is None else ""
    pictures = [
        SaidPicture(
            lines.query, f"{analysis.name}{middle}", _picture(analysis, workspace, analysis.query, task.query_view)
        ),
    ]
    if not lines.waits:
        answer = SaidPicture(
            lines.answer,
            place_text.piece(task.gallery[chosen.index]),
            _picture(analysis, workspace, analysis.tile, task.gallery_view),
            _frame_sign(analysis, found),
            0.0 if turn is None else -turn.degrees,
        )
        pictures.append(answer)
    if laid is not None:
        doubt = "" if laid.sign else ": in doubt"
        offset = f"{laid.offset}, north up"
        pictures.append(SaidPicture(f"{_ON_MAP}{doubt}", offset, laid.picture, laid.sign, doubted=laid.sign is None))
    elif found.look_errs and chosen.rank == 1 and positive is not None:
        picture, caption, right = _third_tile(
            analysis, workspace, positive.index, found.disputed, found.look[0] is None
        )
        pictures.append(SaidPicture(caption, place_text.piece(task.gallery[positive.index]), picture, right))
    registered = workspace.details(analysis)
    checked = check(workspace) if registered is not None and registered.accepted else ""
    lead = None if lines.waits else answer_text.lead(analysis, judge.judged_piece(analysis, workspace))
    reasons = _because(analysis, workspace, lead, None if lead is None else _lead_cells(analysis, lead))
    return Said(
        lines.question,
        lines.headline,
        lines.told,
        tuple(pictures),
        _photo_facts(analysis),
        _map_facts(workspace, on_read),
        tuple((method, tuple(sentences)) for method, sentences in reasons),
        tuple(filter(None, [lines.criterion, checked])),
        details_pair(analysis, workspace),
    )


def _map_facts(workspace: Workspace, on_read: CountProgress = lambda *_: None) -> tuple[tuple[str, str], ...]:
    """Return names and SHA-256 of the map's files that can be read; of many or large ones their number and size alone.

    Args:
        on_read: called while files are read, which may take seconds at the first time: with the bytes that are read, and all.
    """
    sheets = () if workspace.basemap is None else workspace.basemap.sheets
    # Files within an archive are none of their own.
    paths = sorted({path for sheet in sheets for path in sheet.raster.files() if path.is_file()})
    try:
        size = sum(path.stat().st_size for path in paths)
        if len(paths) > _MOST_MAP_FILES or size > _MOST_MAP_BYTES:
            return (
                ("Map", f"{len(paths):,} files of {size / 1e6:,.0f} MB, too many or too large for their SHA-256 here"),
            )
        digests, before = [], 0
        for path in paths:
            digests.append((path.name, _digest(path, partial(_count, on_read, before, size))))
            before += path.stat().st_size
    except OSError:  # a file has gone meanwhile
        return ()
    return tuple(("Map", f"{printable(name)}, SHA-256 {digest}") for name, digest in digests)


def _count(on_read: CountProgress, before: int, size: int, read: int) -> None:
    on_read(min(before + read, size), size)


def _digest(path: Path, on_read: Callable[[int], None]) -> str:
    """Return the SHA-256 of a file in hexadecimal digits; a file that has changed is read again.

    Args:
        on_read: called with the bytes that are read.
    """

    def compute() -> str:
        digest, read = hashlib.sha256(), 0
        with path.open("rb") as file:
            while piece := file.read(_PIECE_BYTES):
                digest.update(piece)
                read += len(piece)
                on_read(read)
        return digest.hexdigest()

    return _digests.get((path, path.stat().st_mtime_ns), compute)


def _photo_facts(analysis: StateAnalysis) -> tuple[tuple[str, str], ...]:
    """Return what the file of the photo says of it; () where there is no file that can be read."""
    state = analysis.state
    if state.upload is not None:
        return state.upload.facts
    picture = analysis.task.queries[state.query]
    path = picture.cut.frame.file if isinstance(picture.cut, TurnedFrame) else picture.path
    try:
        return tuple(PhotoFile.of(path.read_bytes(), path).facts)
    except (OSError, PictureError):
        return ()


def _bar_colours(sure: bool) -> tuple[str, str]:
    """Return the colours of bars for and against: those of the frames, darker where they stand beside a text."""
    if not sure:
        leader, follower = lead_colours(False)
        return theme.css(leader), theme.css(follower)
    return verdict_ink(True), verdict_ink(False)


def _failures(workspace: Workspace, state: SessionState) -> int:
    """Return the number of wrong answers; 0 until all queries are ranked."""
    ranking = workspace.rankings[state.ranking_key]
    right, graded = workspace.counts(ranking)
    return graded - right


def _lead_cells(analysis: StateAnalysis, lead: answer_text.Lead) -> Float64Array | None:
    """Return each cell's share of the lead, part by part; None where the answer is not what is compared."""
    if analysis.chosen.rank != 1:
        return None
    answer = analysis.chosen.index
    return lead_cells(analysis, *((answer, lead.index) if lead.of_answer else (lead.index, answer)))


def _because(
    analysis: StateAnalysis,
    workspace: Workspace,
    lead: answer_text.Lead | None,
    cells: Float64Array | None,
    matched: bool = False,
) -> list[tuple[str, list[str]]]:
    """Say from measured facts alone where what speaks for the answer lies, and where what speaks against it does.

    Each method has its sentences, the model's look those on the answer; a name is "" where it is the only one. Parts are ranked
    by their terms of the lead, as the table of the numbers and the workbench rank them.

    Args:
        cells: each cell's share of the lead, part by part.
        matched: the details are shown, and their number is said beside them.
    """
    query, tile, task = analysis.query.trace, analysis.tile.trace, analysis.task
    if lead is None or cells is None or query is None or tile is None:
        return []
    sign = 1 if lead.of_answer else -1
    whose = "your picture" if analysis.state.upload else "the picture"
    sentences = []
    located = workspace.located(analysis)
    details = workspace.details(analysis)
    if analysis.registered is not None and not analysis.registered.answer.accepted:
        sentences.append(f"Nothing shows that {lead.answer} is of the same place.")
    errs = not lead.of_answer
    if located is not None and analysis.registered is not None:
        answer = window_of(task, analysis.matches[0].index)
        errs = (off_window(located, answer) or 0.0) > 0
    off_map = place_text.off_map(task.gallery[analysis.chosen.index], lead.answer)
    if off_map and errs:
        sentences.append(off_map)
    for side in (sign, -sign):
        place = _speaking_place(analysis, workspace, lead, cells, side)
        ahead, behind = (lead.answer, lead.other)[:: 1 if side == sign else -1]
        if place is None:
            single = "; only single places do" if (side * cells.sum(axis=0)).max() > 0 else ""
            whole = f"No {words.say('part')} as a whole speaks for {ahead}"
            if len(lead.terms) == 1:
                whole = f"The picture as a whole does not speak for {ahead}"
            sentences.append(f"{whole}{single}.")
            continue
        names = ahead, behind
        sentences.append(verdicts.describe_lead_place(place, workspace.part_names, task.query_view, names, whose))
    if off_map and not errs:
        sentences.append(off_map)
    if details is None:
        return [("", sentences)]
    photo = "your picture" if analysis.state.upload else "the photo"
    known = [] if matched else [f"{_details(details, photo) or 'They fit this map'}: they place it."]
    if not details.accepted:
        everywhere = analysis.registered is not None and analysis.registered.whole_map
        where = "nowhere on this map" if everywhere else "nowhere that was searched on this map"
        known = [f"They fit {where} well enough to place it, so no detail is shown.", details.sentence]
    doubts, which = [], ", which errs" if errs else ""
    if located is not None:
        contradictions = disagreements([located])
        concluded = belief(located, contradictions)
        doubts = [one.told(concluded) for one in contradictions if one.one == "registration"]
        if errs and details.accepted and not concluded.sign:
            which += " if its details are right"
    return [("By its details", [*known, *doubts]), (f"By its look{which}", sentences)]


def _speaking_place(
    analysis: StateAnalysis, workspace: Workspace, lead: answer_text.Lead, cells: Float64Array, side: int
) -> LeadPlace | None:
    """Return the place of the query that does most for a tile; None if no part as a whole speaks for it.

    Args:
        cells: each cell's share of the lead, part by part.
        side: 1 for the leader, -1 for the follower.
    """
    query, tile, task = analysis.query.trace, analysis.tile.trace, analysis.task
    terms, places = side * lead.terms, side * cells.sum(axis=0)
    if query is None or tile is None or terms.max() <= 0:
        return None
    ahead, behind = (analysis.chosen.index, lead.index)[:: 1 if (side == 1) is lead.of_answer else -1]
    turn = _turn(analysis, workspace, least=0)
    return lead_place(
        terms,
        verdicts.leading_parts(terms),
        places,
        (query.cells[0] != 0, tile.cells[0] != 0),
        (workspace.ground_of(task, ahead), workspace.ground_of(task, behind)),
        None if turn is None else turn.degrees,
    )


def _details(registered: StageRecord | None, photo: str) -> str:
    """Say how many details of a photo, which is called `photo`, agree with the map; "" if it is not laid over it by them."""
    if registered is None or not registered.accepted or registered.inliers is None:
        return ""
    return f"{registered.inliers} details of {photo} lie where the map has them"


def _picture(
    analysis: StateAnalysis,
    workspace: Workspace,
    described: DescribedPicture,
    view: View,
    cells: Float64Array | None = None,
    colours: tuple[Colour, Colour] | None = None,
) -> str:
    """Return a picture of the pair as a data URI: as it is, or with its parts and what `cells` say while they are explained."""
    if analysis.state.why:
        turn = None if described is analysis.query else _turn(analysis, workspace)
        drawn = draw_parts(workspace, described, view, _SIZE, cells, colours=colours)
        return overlays.data_uri(_numbered(workspace, drawn, described, view, turn), 85)
    if analysis.state.upload and described is analysis.query:  # in its own shape; explained, it is as the model sees it
        height, width = described.picture.shape[:2]
        share = _SIZE[0] / max(height, width)
        whole = images.resize(described.picture, max(round(share * height), 1), max(round(share * width), 1))
        return overlays.data_uri(whole, 85)
    across, down = workspace.layout.picture
    width = min(round(_SIZE[0] * across / down), _SIZE[1])
    picture = images.resize(workspace.as_partitioned(described.picture, view), round(width * down / across), width)
    return overlays.data_uri(picture, 85)


def _numbered(
    workspace: Workspace, drawn: UInt8Array, described: DescribedPicture, view: View, turn: MatchingTurn | None
) -> UInt8Array:
    """Write the numbers of the parts into a drawn picture; they are upright when it is turned as the page turns it."""
    degrees = 0.0 if turn is None else turn.degrees
    return captions.with_part_numbers(drawn, workspace.areas(view, described), workspace.part_names, degrees)


def _turned_by(analysis: StateAnalysis, workspace: Workspace, turn: MatchingTurn | None) -> str:
    """Say why the answers are turned; of a photo of a flight with its headings, as the turn is their difference."""
    if turn is None:
        return ""
    text, upload = _TURNED_BY[turn.source], analysis.state.upload
    cut = None if upload is not None else analysis.task.queries[analysis.state.query].cut
    details = workspace.details(analysis)
    by_hand = analysis.state.angle != 0
    if (
        turn.source != "registration"
        or by_hand
        or not isinstance(cut, TurnedFrame)
        or details is None
        or details.heading is None
    ):
        return text
    return (
        f"{text} Its top points to {heading_figure(details.heading)}° by its details, and to {heading_figure(cut.heading)}° by "
        "the heading with which the model searched, which has turned it here; the turn is the difference."
    )


def _third_tile(
    analysis: StateAnalysis, workspace: Workspace, index: int, disputed: bool, unsure: bool
) -> tuple[str, str, bool | None]:
    """Return the tile beside the answer: its picture as a data URI, its caption, and whether it is true.

    Where the tag is disputed, or the judge is in doubt (`unsure`), that is not known. Parts that differ from picture to picture
    are not drawn, as they would take a forward pass.
    """
    task, judged = analysis.task, judge.judged_piece(analysis, workspace)
    lead = answer_text.lead(analysis, judged)
    known = analysis.ranking.relevant is not None and not disputed
    right: bool | None = not disputed and analysis.positive is not None and analysis.positive.index == index
    caption = "The right one" if lead is None or (right and not judged) else words.capitalised(lead.other)
    if right and unsure:
        caption, right = "Right, if its details are right", None
    if disputed and analysis.positive is not None and analysis.positive.index == index:
        caption = "The one of its GPS tag"
    if not analysis.state.why:
        return overlays.data_uri(workspace.card(task, index), 85), caption, right
    try:
        picture = task.gallery[index].load_zoomed()
    except PictureError:
        picture = workspace.card(task, index)  # grey
    described = replace(analysis.tile, picture=picture, trace=None)
    drawn = draw_parts(workspace, described, task.gallery_view, _SIZE)
    drawn = _numbered(workspace, drawn, described, task.gallery_view, _turn(analysis, workspace))
    return overlays.data_uri(drawn, 85), caption, right if known else None


def _laid(located: LocatedFrame | None, workspace: Workspace, own: bool) -> LaidPhoto | None:
    """Return where a photo fits the map; None without an accepted registration."""
    basemap = workspace.basemap
    if located is None or basemap is None:
        return None
    answer, ground = located.stages.get("registration"), outline(located)
    if answer is None or not answer.accepted or ground is None or answer.x is None or answer.y is None:
        return None
    west, south, east, north = basemap.bounds
    picture, valid = _map_picture(basemap)
    # The map lies in the middle of a square, as large as the pictures beside it.
    height, width = valid.shape
    top, left = (_SIZE[0] - height) // 2, (_SIZE[0] - width) // 2
    drawn = np.full((_SIZE[0], _SIZE[0], 3), _NOTHING, np.uint8)
    drawn[top : top + height, left : left + width][valid] = picture[valid]

    def pixels(points: FloatingArray) -> NDArray[np.int32]:
        shares = (np.asarray(points).reshape(-1, 2) - (west, north)) / (east - west, south - north)
        cells: NDArray[np.int32] = np.rint(shares * (width, height) + (left, top)).astype(np.int32)
        return cells

    contradictions = disagreements([located])
    concluded = belief(located, contradictions)
    for colour, thickness in (((0, 0, 0), 6), (theme.placed_colour(concluded.sign), 3)):
        cv2.polylines(drawn, [pixels(ground.corners)], True, colour, thickness, cv2.LINE_AA)
    at = answer.x, answer.y
    sentence = ""
    if located.tag is not None:
        place, tag = pixels(np.array([at, located.tag]))
        cv2.line(drawn, place.tolist(), tag.tolist(), (255, 255, 255), 2, cv2.LINE_AA)
        cv2.circle(drawn, tag.tolist(), 6, (255, 255, 255), 2, cv2.LINE_AA)
        metres, allowed = tag_figures(located, contradictions)
        limit = f", where {allowed} are allowed"
        near = all(one.other != "tag" for one in contradictions)
        if near and words.plain():  # the limit is told where it is explained
            limit = ", which is within what is allowed"
        sentence = f"Its GPS tag, the white circle, lies {metres} from there{limit}."
    unchecked = "" if answer.agreement is None else answer.agreement.unchecked
    sentence = " ".join(
        filter(None, [sentence, unchecked, *(one.told(concluded) for one in contradictions if one.other == "map")])
    )
    return LaidPhoto(
        overlays.data_uri(drawn, 85),
        concluded.sign,
        describe_offset(*at),
        None if shows_rendered(workspace.root) else MapCoordinate.on(basemap, at),
        answer.camera,
        not answer.on_earth and bool(placing_sentence(basemap.notes)),
        "" if own else sentence,
    )


@lru_cache(maxsize=4)
def _map_picture(basemap: Map) -> tuple[UInt8Array, BoolArray]:
    """Return a map and its valid pixels, see `Map.overview`; a small one is read several times as quickly as a large one."""
    return basemap.overview(_SIZE[0])


def _turn(analysis: StateAnalysis, workspace: Workspace, least: float = _LEVEL) -> MatchingTurn | None:
    """Return how far the answers are turned to lie like the query; None where that is less than `least` degrees, or not known."""
    state, query = analysis.state, None if analysis.state.upload else analysis.state.query
    registered = None
    if analysis.registered is not None and analysis.registered.answer.accepted:
        registered = analysis.registered.answer.heading
    if workspace.flight is not None and query is not None:
        located, cut = workspace.flight.frames[query], analysis.task.queries[query].cut
        answer = located.stages.get("registration")
        if answer is not None and answer.accepted and answer.heading is not None and isinstance(cut, TurnedFrame):
            registered = answer.heading - cut.heading
        elif not heading_is_certain(located.frame):  # it is the best of those that were tried
            query = None
    turn = matching_turn(analysis, query, state.angle, registered)
    return None if turn is None or abs(turn.degrees) < least else turn
