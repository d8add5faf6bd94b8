"""The radius of a place in words: what it means, where it comes from, and what the check of the flight says of it."""

from __future__ import annotations

from markupsafe import Markup

from explorer.judge import confirmed
from explorer.web.terms import explained
from explorer.workspace import Workspace
from lpn.core.numbers import SIGMA, error_figure, upper_bound
from lpn.core.texts import listed
from lpn.drawing.words import plain
from lpn.locate.belief import on_what
from lpn.locate.located import StageRecord
from lpn.locate.measures import RIGHT_CALIBRATION
from lpn.maps.tag_placed import placing_sentence

# Radii of 1 sigma within which nearly all places lie, which plain words tell in place of the radius.
_NEARLY_ALL = 3


def with_radius(text: str, answer: StageRecord | None, workspace: Workspace) -> str:
    """Return a text in which an answer's radius, where it is first told, explains itself and says if it is not confirmed."""
    if answer is None or answer.radius is None:
        return text
    before, told, after = text.partition(_radius(answer))
    if not told:
        return text
    unconfirmed = " (not confirmed)" if confirmed(workspace) is False else ""
    return Markup("{}{}{}{}").format(before, explained(told, _meaning(answer, workspace)), unconfirmed, after)


def reach(radius: float) -> float:
    """Return the metres that a place may be off in the words that are spoken: three radii in plain ones, else the radius."""
    return _NEARLY_ALL * radius if plain() else radius


def told_reach(answer: StageRecord) -> str:
    """Return how far an answer with a radius may be off, and on what."""
    assert answer.radius is not None
    if plain():
        return f"within {upper_bound(reach(answer.radius))} m {on_what(answer)}"
    return _radius(answer)


def dependence(answer: StageRecord | None, workspace: Workspace) -> str:
    """Say of an answer that is accepted that the map and the tags that place it are no two witnesses; "" if no tags place it."""
    basemap = workspace.basemap
    if answer is None or not answer.accepted or basemap is None or not placing_sentence(basemap.notes):
        return ""
    return "GPS tags place this map, so a tag of the same flight is no independent proof."


def _radius(answer: StageRecord) -> str:
    return f"± {answer.radius:.1f} m {on_what(answer)}"


def holds(answer: StageRecord | None, workspace: Workspace, doubted: bool = False) -> str:
    """Say how exact an accepted answer should be, and if a check confirms it, as HTML; "" without one.

    In plain words that is one distance within which nearly all places should lie, which is three radii; of a doubted place they
    tell none, unless nobody knows it of any.
    """
    if answer is None or answer.radius is None or not answer.accepted:
        return ""
    sure = confirmed(workspace)
    if plain():
        return "" if doubted and sure is not False else _nearly_all(answer, workspace, sure, doubted)
    first, second = RIGHT_CALIBRATION[1], RIGHT_CALIBRATION[2]
    text = (
        f"± {answer.radius:.1f} m should hold for {first:.0f} of 100 photos, and {error_figure(2 * answer.radius)} m for "
        f"{second:.0f}"
    )
    return f"{text}; the check of this flight does not confirm it." if sure is False else f"{text}."


def _nearly_all(answer: StageRecord, workspace: Workspace, sure: bool | None, doubted: bool) -> str:
    assert answer.radius is not None
    limit = explained(f"{upper_bound(reach(answer.radius))} m", _meaning(answer, workspace))
    where = Markup("{} of the true place {}").format(limit, on_what(answer))
    of = Markup("{:.0f} of 100 photos").format(RIGHT_CALIBRATION[_NEARLY_ALL])
    if sure is None:
        return Markup("<strong>It should lie within {}</strong>, as {} should; nothing here checks that.").format(
            where, of
        )
    assert workspace.flight is not None
    summary = workspace.flight.registration_summary
    assert summary is not None
    near = f"{round(summary.calibration[3] / 100 * summary.answered)} of {summary.answered}"
    if sure:
        return Markup(
            "<strong>It should lie within {}</strong>, as {} should; {} here lie that near to their {}."
        ).format(where, of, near, _truths(workspace))
    off = "" if workspace.flight.rendered else " The tags may be off, too."
    if doubted:
        as_near = explained("as near", _meaning(answer, workspace))
        return Markup(
            "<strong>Nobody knows how exact that is:</strong> only {} photos here lie {} to their {} as nearly all should.{}"
        ).format(near, as_near, _truths(workspace), off)
    return Markup(
        "<strong>It should lie within {}; nobody knows if it does:</strong> only {} photos here lie that near to their {}, where "
        "nearly all should.{}"
    ).format(where, near, _truths(workspace), off)


def _truths(workspace: Workspace) -> str:
    return "places" if workspace.flight is None or workspace.flight.rendered else "GPS tags"


def _meaning(answer: StageRecord, workspace: Workspace) -> str:
    assert answer.radius is not None
    radius = answer.radius
    first, second, third = RIGHT_CALIBRATION.values()
    estimated = "If the errors are as estimated,"
    if plain():
        sentences = [
            f"{estimated} {third:.0f} of 100 places lie within {upper_bound(reach(radius))} m of the true one. That is three "
            f"times ± {radius:.1f} m, which is {SIGMA}, east and north."
        ]
    else:
        sentences = [
            f"± {radius:.1f} m is no limit. {estimated} {first:.0f} of 100 places lie within {radius:.1f} m of the true one, and "
            f"{second:.0f} within {2 * radius:.1f} m: it is {SIGMA}, east and north."
        ]
    basemap = workspace.basemap
    if basemap is not None and answer.on_earth:
        by_tags = "the GPS tags of its photos give it" if placing_sentence(basemap.notes) else "as it was surveyed"
        sentences.append(
            f"It joins ± {answer.radius_on_map:.1f} m for the place on this map and ± {error_figure(answer.place_error)} m for "
            f"the map's own place on earth: {by_tags}."
        )
    sentences.append(check(workspace))
    return " ".join(filter(None, sentences))


def check(workspace: Workspace) -> str:
    """Return how many of the flight's places lie within 1, 2, and 3 radii of their GPS tags; "" where none has both."""
    summary = None if workspace.flight is None else workspace.flight.registration_summary
    if summary is None or not summary.calibration:
        return ""
    shares, right = (
        f"{listed([f'{share:.0f}' for share in of.values()])} %" for of in (summary.calibration, RIGHT_CALIBRATION)
    )
    text = (
        f"Check: {shares} of the flight's photos lie within one, two, and three radii of their {_truths(workspace)}, where "
        f"{right} should."
    )
    if confirmed(workspace):
        return text
    return (
        f"{text} So the check does not confirm the radius: tags that are late or wrong would do the same, and so would a radius "
        "that is too small."
    )
