"""The html of the panels. Everything that comes from a file is escaped; a click is handed to a hidden viser button."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape

from explorer.panels import answer_text
from explorer.web.bridge import PRESSED, send
from explorer.web.style import part_ink, verdict_ink
from explorer.workspace import StateAnalysis, Task, Workspace
from lpn.drawing import overlays
from lpn.retrieval import Match

SIGNS: dict[bool | None, str] = {True: "✓", False: "✗", None: "?"}


def hidden(ids: Sequence[str]) -> str:
    """A style that takes bridge buttons, and the space around them, out of sight."""
    selectors = ",".join(f'div:has(>[id="{escape(i)}"])' for i in ids)
    return f"<style>{selectors}{{display:none!important}}</style>"


def press(button: str) -> str:
    """The attribute that hands a click to a viser button."""
    return f"{PRESSED} onclick=\"document.getElementById('{escape(button)}').click()\""


_ACTS = (
    "<span class='tools'><a onclick='lpn.copy()' title='Copy the address that brings back what you see (I)'>Link</a>"
    f"<a {send('dark')} title='Light or dark (O)'><span class='when-dark'>Light</span><span class='when-light'>Dark</span></a>"
    "<a onclick='lpn.tour()' title='Show the tour'>Tour</a></span>"
)


def header(workspace: Workspace, task: Task) -> str:
    """Which model, data set, task, n, and how good it is on it."""
    return (
        f"<div class='lpn' id='lpn-header'><div class='top'><h2>{escape(workspace.model_name)} "
        f"<span class='dim'>on</span> {escape(workspace.data_name)}</h2>{_ACTS}</div>"
        f"<div class='facts dim'><span>{escape(workspace.description)}</span></div>"
        f"<div class='facts'><span>{escape(task.query_view)} → {escape(task.gallery_view)}</span>"
        f"<span class='num'>{len(task.queries):,} queries</span><span class='num'>{len(task.gallery):,} tiles</span></div>"
        f"{_results(task)}</div>"
    )


def _results(task: Task) -> str:
    """How good it is, or how far the ranking of all queries is that says so."""
    if task.found is None:
        done, flaw = task.standing.done, task.standing.flaw
        said = (
            f"⚠ Results: none. {escape(flaw)}"
            if flaw
            else f"<span class='busy'></span>Results: ranking {done:,} of {len(task.queries):,} queries"
        )
        return f"<div class='facts num' id='lpn-ranking'><span>{said}</span></div>"
    results = task.results
    return (
        f"<div class='facts num'><span><span class='big'>{results['recall@1']:.1f} %</span> R@1</span>"
        f"<span class='dim'>R@5 {results['recall@5']:.1f} %</span><span class='dim'>R@10 {results['recall@10']:.1f} %</span>"
        f"<span class='dim'>AP {results['ap']:.1f} %</span></div>{_metres(results)}"
    )


def _metres(results: dict[str, float]) -> str:
    if "median error m" not in results:
        return ""
    return (
        f"<div class='facts num dim'><span>median error {results['median error m']:,.0f} m</span>"
        f"<span>within 50 m {results['within 50 m']:.1f} %</span></div>"
    )


def verdict(analysis: StateAnalysis, workspace: Workspace) -> str:
    """The answer in words, and a status line that also tells tests what is shown."""
    true, headline, reason = answer_text.verdict(analysis, workspace.part_names)
    colour = overlays.css(overlays.verdict_colour(true))
    warning = (
        ""
        if analysis.state.parts_left()
        else "<div>⚠ Every part is off, so all count equally until one is switched on.</div>"
    )
    return (
        f"<div class='lpn'><div class='verdict' style='border-color:{colour}' id='lpn-verdict'>"
        f"<b>{SIGNS[true]} {escape(headline)}</b><div>{escape(reason)}</div>{warning}</div></div>"
    )


def status(analysis: StateAnalysis, sequence: int, drawing: float) -> str:
    """How long the last answer took to compute and to draw; its attributes say which state the page shows."""
    state = analysis.state
    return (
        f"<div class='lpn dim num' id='lpn-status' data-seq='{sequence}' data-query='{state.query}' "
        f"data-name='{escape(analysis.name)}' data-angle='{state.angle:g}' data-chosen='{analysis.chosen.index}' "
        f"data-top='{analysis.matches[0].index}'><span>answered in {1000 * (analysis.seconds + drawing):.0f} ms ({1000 * analysis.seconds:.0f} computing, {1000 * drawing:.0f} drawing)</span></div>"
    )


_BUSY = "<span class='busy'></span>computing … the newest change counts"
_FULL = "<span class='busy'></span>Busy: too many people ask just now. This page asks again by itself; the newest change counts."
FIRST = (
    "<div class='lpn dim' id='lpn-status' data-seq='0'><span class='busy'></span>describing the first picture …</div>"
)


def busy(status: str) -> str:
    """The same status line while the next answer is being computed: it still says which state the page shows."""
    before, between, _ = status.partition("<span>")
    return f"{before}<span>{_BUSY}</span></div>" if between else status


def full(status: str) -> str:
    """The same status line where too many people ask: the page will ask again."""
    return f"{status.partition('<span')[0]}<span>{_FULL}</span></div>"


def matches(analysis: StateAnalysis, workspace: Workspace, buttons: Sequence[str]) -> str:
    """The ranked tiles as rows: picture, rank, sign, name, distance, gap, and the parts' shares.

    A true tile below them gets a row of its own; the last button is its.
    """
    shown = list(zip(analysis.matches, buttons, strict=False))
    truth = analysis.truth
    below = truth is not None and truth.rank > len(analysis.matches)
    full = max(match.distance2 for match in (*analysis.matches, *([truth] if truth and below else [])))
    rows = [_row(analysis, workspace, match, button, full) for match, button in shown]
    if truth is not None and below:
        rows += [
            "<div class='dim' id='lpn-truth'>… and the true tile:</div>",
            _row(analysis, workspace, truth, buttons[-1], full),
        ]
    return f"<div class='lpn' id='lpn-matches'>{''.join(rows)}</div>"


def _row(analysis: StateAnalysis, workspace: Workspace, match: Match, button: str, full: float) -> str:
    entry = analysis.task.gallery[match.index]
    chosen = " chosen" if match.index == analysis.chosen.index else ""
    colour = overlays.css(overlays.verdict_colour(match.true))
    segments = "".join(
        f"<i style='width:{100 * max(float(share), 0) / max(full, 1e-9):.2f}%;background:{overlays.css(overlays.part_colour(i))}' "
        f"title='part {escape(workspace.part_names[i])}: {share:.4f}'></i>"
        for i, share in enumerate(match.shares)
    )
    off = "" if analysis.off is None else f"<span class='dim'>{analysis.off[match.index]:,.0f} m</span>"
    gap = "" if match.gap is None else f"<span class='dim'>+{match.gap:.3f}</span>"
    return (
        f"<div class='row{chosen}' data-index='{match.index}' {press(button)} title='Compare with the query'>"
        f"<img src='{workspace.thumbnail(entry.path)}' style='border-color:{colour}' alt=''>"
        f"<div class='what'><div class='line num'><b>{match.rank}</b><b style='color:{verdict_ink(match.true)}'>{SIGNS[match.true]}</b>"
        f"<span class='name'>{escape(entry.name)} {off}</span><span>{match.distance2:.3f}</span>{gap}</div>"
        f"<div class='bar'>{segments}</div></div></div>"
    )


def parts_table(analysis: StateAnalysis, workspace: Workspace) -> str:
    """The compared pair part by part; the shares add up to the distance."""
    chosen = analysis.chosen
    rows = "".join(
        f"<tr><td style='color:{part_ink(i)}'>{escape(name)}</td>"
        f"<td>{100 * analysis.ranking.weights[i]:.0f} %</td><td>{chosen.cosines[i]:+.3f}</td><td>{chosen.shares[i]:.3f}</td></tr>"
        for i, name in enumerate(workspace.part_names)
    )
    return (
        f"<div class='lpn num' id='lpn-parts'><table><tr class='dim'><th>part, query with rank {chosen.rank}</th><th>weight</th>"
        f"<th>cosine</th><th>share of d²</th></tr>{rows}<tr><td>sum</td><td>100 %</td><td>{chosen.score:+.3f}</td>"
        f"<td><b>{chosen.distance2:.3f}</b></td></tr></table></div>"
    )


def picker(
    workspace: Workspace,
    task: Task,
    shown: Sequence[int],
    query: int | None,
    page: int,
    pages: int,
    buttons: Sequence[str],
) -> str:
    """Thumbnails of one page of queries; the last two buttons turn the page."""
    if not shown:
        return "<div class='lpn dim' id='lpn-picker'>No picture has this in its name; change the text above.</div>"
    thumbs = "".join(
        f"<div class='thumb{' chosen' if i == query else ''}' data-query='{i}' {press(buttons[slot])}>"
        f"<img src='{workspace.thumbnail(task.queries[i].path)}' alt=''>"
        f"<span>{_sign(task, i)} {escape(task.queries[i].name)}</span></div>"
        for slot, i in enumerate(shown)
    )
    pager = (
        f"<div class='pager'><a {press(buttons[-2])} title='Earlier'>‹</a><span class='dim num'>page {page + 1} of {pages}</span>"
        f"<a {press(buttons[-1])} title='Later'>›</a></div>"
    )
    return f"<div class='lpn' id='lpn-picker'><div class='thumbs'>{thumbs}</div>{pager}</div>"


def _sign(task: Task, query: int) -> str:
    if task.found is None:
        return ""
    true = bool(task.ranks[query] == 0)
    return f"<b style='color:{verdict_ink(true)}'>{SIGNS[true]}</b>"


KEYS = (
    "<div class='lpn dim' id='lpn-keys' style='margin-top:.3em'><kbd>N</kbd> <kbd>P</kbd> next, previous · <kbd>R</kbd> random · "
    "<kbd>F</kbd> failure · <kbd>J</kbd> <kbd>L</kbd> turn 5° · <kbd>K</kbd> upright · <kbd>H</kbd> heatmap, <kbd>V</kbd> of evidence · "
    "<kbd>Y</kbd> why · <kbd>B</kbd> all failures · <kbd>G</kbd> rings · <kbd>X</kbd> take apart · <kbd>M</kbd> map, <kbd>C</kbd> its "
    "city · <kbd>1</kbd>…<kbd>9</kbd> compare · <kbd>T</kbd> the true tile · <kbd>O</kbd> light or dark · <kbd>I</kbd> copy link · "
    "<kbd>U</kbd> my own picture · <kbd>Ctrl K</kbd> every command</div>"
)
HEAT_NOTE = (
    "Activation (channel sum of the last feature map) belongs to one picture. Evidence belongs to the pair: "
    "orange adds to its score, violet takes."
)
SHIFT_NOTE = "<div class='lpn dim'>In pixels of the network's input, after turning. LPN assumes that the target is in the middle.</div>"
SAVED_NOTE = (
    "<div class='lpn dim' id='lpn-saved'>A saved result without its network: queries cannot be turned or replaced by your own, "
    "and there are no heatmaps. Rings are drawn as published.</div>"
)
PARTS_NOTE = (
    "<div class='lpn dim'>Switch parts off or weight them: the ranking follows at once. "
    "R@1 at the top right stays that of all parts alike.</div>"
)
