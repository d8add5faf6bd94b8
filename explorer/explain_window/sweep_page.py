"""The tab "Turn, shift, zoom": rank, score, and part cosines of one query, drawn while they are computed."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from markupsafe import Markup

from explorer.explain_window.whole_task import TurnChoice, WholeTaskSection
from explorer.web.render import render, send
from explorer.workspace import StateAnalysis
from lpn.core.texts import ordinal
from lpn.drawing import charts, verdicts
from lpn.drawing.words import capitalised, plain, say
from lpn.explain.sweeps import SweepPoint, SweepResult, SweptProperty, signed_value, swept_label

CHOICES: dict[SweptProperty, str] = {
    "rotation": "Turn",
    "shift": "Shift right",
    "shift-down": "Shift down",
    "zoom": "Zoom",
    "weather": "Weather",
}
# The turns of all queries, see `WholeTask.measure`.
TURNS: dict[TurnChoice, str] = {"this": "As this query", "paper": "As in Table IV", "circle": "Every 30°"}
_WIDTH = 720


def page(
    analysis: StateAnalysis,
    over: SweptProperty | None,
    profile: SweepResult | None,
    total: int,
    names: Sequence[str],
    stopped: bool = False,
    whole: WholeTaskSection | None = None,
    judged: str = "",
) -> str:
    """Render the tab.

    Args:
        over: the swept property; None before a sweep is requested.
        profile: the points so far; None before the first.
        total: number of points of the whole sweep.
        stopped: the sweep was cancelled or failed before its last point.
        whole: what is known of the whole task with turned queries; None to leave it out.
        judged: what the right piece is called where its judge is doubtful, see `explorer.judge.judged_piece`.
    """
    angle = analysis.state.angle
    turns = {
        choice: f"{label} ({angle:g}°)" if choice == "this" else label
        for choice, label in TURNS.items()
        if angle or choice != "this"
    }
    # A tile has no weather.
    choices = {
        key: label for key, label in CHOICES.items() if key != "weather" or analysis.task.query_view != "satellite"
    }
    if over is None or profile is None:
        return render("explain/sweep", choices=choices, over=over, done=0, stopped=stopped, whole=whole, turns=turns)
    current = signed_value(over, analysis.state.change)
    recalls = whole.recalls if whole is not None and over == "rotation" else ()
    followed = f"the compared {say('tile')}"
    if profile.best.true:
        followed = judged or f"the {say('positive')}"
    ended = stopped or len(profile.points) >= total
    return render(
        "explain/sweep",
        choices=choices,
        over=over,
        done=len(profile.points),
        total=total,
        stopped=stopped,
        region=analysis.state.region,
        charts=charts.profile_charts(profile, names, _WIDTH, current, _attributes, recalls),
        whole=whole,
        turns=turns,
        followed=followed,
        sentences=[*_sentences(profile, analysis, followed), *_weathers(profile, names, followed)] if ended else [],
        claim=analysis.task.contract.claim,
        several=len(names) > 1,
    )


def _attributes(point: SweepPoint) -> Markup:
    """Make a point's circle apply its change to the query when it is clicked."""
    change = point.change
    return send("take", [change.rotate, change.shift, change.down, change.scale, change.weather.name])


def _sentences(profile: SweepResult, analysis: StateAnalysis, followed: str) -> list[str]:
    over, best, ranked, blind = profile.over, profile.best, profile.best_rank, profile.best_top_match
    sentences = [
        f"Best for {followed}: {_place(over, best)}, {_figures(best.score)}, {ordinal(best.rank)}"
        f"{_before(profile, best)}."
    ]
    if ranked.rank < best.rank:
        sentences.append(f"Its best {say('rank')} is elsewhere: {ordinal(ranked.rank)} at {_place(over, ranked)}.")
    if best.true is not None and over not in ("rotation", "weather"):
        place = _place(over, blind)
        sentences.append(f"The nearest of all {say('tile', 2)} is at {place} ({_figures(blind.top_score)}).")
    if guess := verdicts.describe_heading(profile, analysis.task.views, _known_heading(analysis)):
        sentences.append(guess)
    if over in ("shift", "shift-down"):
        sentences.append(
            "LPN assumes that the target is in the middle: its rings stay where they are while the target moves."
        )
    return sentences


def _weathers(profile: SweepResult, names: Sequence[str], followed: str) -> list[str]:
    """Say which weather costs the followed tile most, and which part loses most in it; nothing of another sweep."""
    clear = next((point for point in profile.points if not point.change.weather), None)
    worst = min(profile.points, key=lambda point: point.score)
    if profile.over != "weather" or clear is None or worst is clear:
        return []
    text = (
        f"{capitalised(followed)} suffers most {worst.change.weather.describe()}: {_figures(worst.score)}, "
        f"{ordinal(worst.rank)}."
    )
    if len(names) > 1:
        part = int(np.argmin(worst.cosines - clear.cosines))
        text += (
            f" {capitalised(say('part'))} {names[part]} loses most there: its {say('part cosine')} "
            f"falls from {clear.cosines[part]:.3f} to {worst.cosines[part]:.3f}."
        )
    return [text]


def _place(over: SweptProperty, point: SweepPoint) -> str:
    return swept_label(over, signed_value(over, point.change))


def _before(profile: SweepResult, point: SweepPoint) -> str:
    """Compare a point with the query as it is."""
    before = profile.unchanged
    if before is None:
        return ""
    return ", as it is" if point is before else f" ({ordinal(before.rank)} with {_figures(before.score)} as it is)"


def _figures(score: float) -> str:
    distance2 = f"{say('d²')} {verdicts.distance2(score):.3f}"
    return distance2 if plain() else f"{distance2} ({say('score')} {score:.3f})"


def _known_heading(analysis: StateAnalysis) -> float | None:
    places = analysis.task.geometry
    place = None if places is None or analysis.state.upload else places.queries[analysis.state.query]
    return None if place is None else place.heading
