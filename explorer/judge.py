"""The judge of a flight's photo, see `lpn.locate.located.LocatedFlight.judge_of`, and how far it may be believed."""

from __future__ import annotations

from dataclasses import replace

from explorer.workspace import StateAnalysis, Workspace
from lpn.locate.belief import belief
from lpn.locate.grades import is_doubtful
from lpn.locate.located import Judge

# The words for the piece that each judge calls right.
_PIECES: dict[Judge, str] = {
    "its details": "the piece where details place the photo",
    "its GPS tag": "the piece where the photo's GPS tag lies",
    "its GPS tag without its lag": "the piece where the photo's GPS tag lies without its lag",
}


def judged_piece(analysis: StateAnalysis, workspace: Workspace) -> str:
    """Return what the piece is called that is right by a judge of a flight's photo whom nothing confirms; "" for any other judge.

    Nothing confirms one that another method contradicts, nor any of a flight whose check does not confirm the radii.
    """
    flight = workspace.flight
    if flight is None or analysis.state.upload is not None or flight.rendered:
        return ""
    query = analysis.state.query
    if not belief(flight.frames[query]).contradicted and confirmed(workspace) is not False:
        return ""
    return _PIECES[flight.judge_of(query)]


def is_sure(analysis: StateAnalysis, workspace: Workspace) -> bool:
    """Return False for a photo whose judge is in doubt, see `is_doubtful`, or by whose judge no piece can be right."""
    if workspace.flight is None or analysis.state.upload is not None:
        return True
    if analysis.positive is None:
        return False
    first = analysis.matches[0]
    return first.true is None or not is_doubtful(
        workspace.flight, analysis.task, analysis.state.query, first.index, first.true
    )


def shown(analysis: StateAnalysis, workspace: Workspace) -> StateAnalysis:
    """Return an analysis for signs and colours: without grades where the judge is not sure.

    Of `Analysis.ungraded` it differs in the piece that this judge calls right, which stays, as the screen names it.
    """
    if is_sure(analysis, workspace):
        return analysis
    positive = analysis.positive
    named = None if positive is None else replace(positive, true=None)
    return replace(analysis.ungraded(), ranking=analysis.ranking, positive=named)


def confirmed(workspace: Workspace) -> bool | None:
    """Return if the tags of the flight's photos lie within three radii as often as with radii that are right; None without."""
    return None if workspace.flight is None else workspace.flight.radii_confirmed.get("registration")
