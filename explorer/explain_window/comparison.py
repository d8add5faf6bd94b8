"""The true tile against a wrong one as html: the margin by part, what leaving a part out would do, and the smallest change."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from html import escape

import numpy as np

from explorer.web.render import SIGNS, send
from explorer.workspace import StateAnalysis, Workspace
from lpn.drawing import overlays, verdicts
from lpn.drawing.verdicts import ordinal
from lpn.explain import counterfactual
from lpn.explain.counterfactual import Effect, Reweighting, Without
from lpn.retrieval import Match


@dataclass(frozen=True, eq=False)
class Comparison:
    """Two tiles of one ranking.

    Attributes:
        ahead: the true tile, or where the truth is not known the compared one.
        rival: the compared tile, or where that is `ahead` the nearest other one that is not true.
        without: where `ahead` would stand without each part.
        change: the nearest weights that put it first; None when none do.
    """

    ahead: Match
    rival: Match
    without: Without | None
    change: Reweighting | None

    @classmethod
    def of(cls, analysis: StateAnalysis) -> Comparison | None:
        """The contest of an answer; None when the gallery has no two tiles for it."""
        ranking, chosen = analysis.ranking, analysis.chosen
        ahead = analysis.truth or chosen
        rival = chosen
        if rival.index == ahead.index or rival.true:
            others = (m for m in analysis.matches if m.index != ahead.index and not m.true)
            found = next(others, None)
            if found is None:
                return None
            rival = found
        follow = None if analysis.truth else ahead.index
        return cls(
            ahead, rival, counterfactual.without(ranking, follow), counterfactual.smallest_change(ranking, follow)
        )


def page(
    analysis: StateAnalysis, workspace: Workspace, contest: Comparison | None, effect: Effect | None, busy: bool
) -> str:
    """The whole tab.

    Args:
        effect: of the smallest change over all queries, where it has been asked for.
        busy: it is being computed.
    """
    if contest is None:
        return "<div class='lpn' id='lpn-versus'>There is no other tile to compare with; choose one among the matches.</div>"
    ahead, rival = contest.ahead, contest.rival
    margin = counterfactual.margin(analysis.ranking, ahead.index, rival.index)
    names = workspace.part_names
    region = " ⚠ This is of the painted cells alone." if analysis.state.region else ""
    return (
        f"<div class='lpn' id='lpn-versus'>{_sides(analysis, workspace, ahead, rival)}"
        f"<div class='said'>{escape(_said(margin.distance2, names, ahead))}{region}</div>"
        f"{_waterfall(margin.distance2, names)}{_left_out(contest, names, ahead)}"
        f"{_changed(analysis, contest, names, effect, busy)}</div>"
    )


def _sides(analysis: StateAnalysis, workspace: Workspace, ahead: Match, rival: Match) -> str:
    def one(match: Match) -> str:
        entry = analysis.task.gallery[match.index]
        colour = overlays.css(overlays.verdict_colour(match.true))
        return (
            f"<div class='row' {send('compare', match.index)} title='Compare with the query'>"
            f"<img src='{workspace.thumbnail(entry.path)}' style='border-color:{colour};width:64px;height:64px' alt=''>"
            f"<span><b style='color:{colour}'>{SIGNS[match.true]}</b> {escape(entry.name)}<br>"
            f"<span class='dim num'>{ordinal(match.rank)}, d² {match.distance2:.3f}</span></span></div>"
        )

    return f"<div class='facts two'>{one(ahead)}<span class='dim'>against</span>{one(rival)}</div>"


def _said(parts: np.ndarray, names: Sequence[str], ahead: Match) -> str:
    total = float(parts.sum())
    who = "The true tile" if ahead.true else "This tile"
    if total >= 0:
        most = int(np.argmax(parts))
        return f"{who} leads by {total:.3f} (d²); part {names[most]} does most of it ({parts[most]:+.3f})."
    least = int(np.argmin(parts))
    return f"{who} is {-total:.3f} (d²) behind; part {names[least]} costs it most ({parts[least]:+.3f})."


def _waterfall(parts: np.ndarray, names: Sequence[str]) -> str:
    """One bar a part from where the one before ended, and the sum from zero."""
    ends = np.concatenate([[0.0], np.cumsum(parts)])
    low, high = float(min(ends.min(), 0)), float(max(ends.max(), 0))
    scale = 100 / max(high - low, 1e-9)
    rows = []
    spans = [(names[i], overlays.part_colour(i), ends[i], ends[i + 1], parts[i]) for i in range(len(parts))]
    spans.append(("sum", overlays.FOR if ends[-1] >= 0 else overlays.AGAINST, 0.0, ends[-1], ends[-1]))
    for name, colour, begin, end, value in spans:
        left, width = (min(begin, end) - low) * scale, abs(end - begin) * scale
        bold = " class='total'" if name == "sum" else ""
        label = overlays.css(colour) if name != "sum" else "inherit"
        rows.append(
            f"<tr{bold}><td style='color:{label}'>{escape(name)}</td>"
            f"<td class='wide'><div class='sum'><i style='left:{left:.2f}%;width:max(1px,{width:.2f}%);"
            f"background:{overlays.css(colour)}'></i><u style='left:{-low * scale:.2f}%'></u></div></td>"
            f"<td>{value:+.3f}</td></tr>"
        )
    return (
        "<table class='num sums fall'><tr class='dim'><th>part</th><th>← speaks for the rival · speaks for it →</th>"
        f"<th>d² rival − d²</th></tr>{''.join(rows)}</table>"
    )


def _left_out(contest: Comparison, names: Sequence[str], ahead: Match) -> str:
    found = contest.without
    if found is None:
        return ""
    said = verdicts.left_out(found, names, "the true tile" if ahead.true else "this tile")
    cells = "".join(
        f"<tr><td style='color:{overlays.css(overlays.part_colour(i))}'>{escape(name)}</td>"
        f"<td>{_rank(found.without[i])}</td><td>{_rank(found.alone[i])}</td></tr>"
        for i, name in enumerate(names)
    )
    return (
        f"<div class='said'>{escape(said)}</div><table class='num'><tr class='dim'><th>part</th><th>rank without it</th>"
        f"<th>rank by it alone</th></tr>{cells}</table>"
    )


def _rank(standing: counterfactual.Standing | None) -> str:
    return "–" if standing is None else ordinal(standing.rank)


def _changed(
    analysis: StateAnalysis, contest: Comparison, names: Sequence[str], effect: Effect | None, busy: bool
) -> str:
    ahead, change = contest.ahead, contest.change
    if ahead.rank == 1:
        return "<div class='dim'>It is first already, so no weights need to change.</div>"
    who = "the true tile" if ahead.true else "this tile"
    if change is None:
        return f"<div class='said' id='lpn-change'>No part weights at all put {who} first.</div>"
    if analysis.state.region:
        # The weights would be tried on whole queries, and these are the painted cells' own.
        effect, busy = None, False
    pairs = ", ".join(
        f"{name} {100 * now:.1f} → {100 * new:.1f} %"
        for name, now, new in zip(names, analysis.ranking.weights, change.weights, strict=True)
    )
    if effect is None:
        asked = "computing over all queries …" if busy else f"<a {send('effect')}>Does it help over all queries?</a>"
        asked = "" if analysis.state.region else asked
    else:
        said = verdicts.helps(effect)
        asked = f"{said[0].upper()}{said[1:]}."
    return (
        f"<div id='lpn-change'><div class='said'>The smallest change of weights that puts {who} first: {escape(pairs)}.</div>"
        f"<div class='chips'><a {send('weigh')}>Use these weights</a></div><div id='lpn-effect'>{asked}</div></div>"
    )


STYLE = """<style>
.lpn .fall .wide{width:62%}
.lpn .facts.two{align-items:center;margin-bottom:.4em}
.lpn .total td{font-weight:650;border-top:1px solid rgba(128,128,128,.5)}
.lpn #lpn-effect a,.lpn .act{cursor:pointer;text-decoration:underline}
</style>"""
