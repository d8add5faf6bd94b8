"""The html of one query. Everything that comes from a file goes through `figures.text`."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from lpn.analysis.task import Study
from lpn.core import images
from lpn.core.arrays import FloatingArray, UInt8Array
from lpn.drawing import overlays, verdicts
from lpn.report import figures
from lpn.report.cases import Case, Pair
from lpn.report.figures import colour, text

SIGNS: dict[bool | None, str] = {True: "✓", False: "✗", None: "?"}
KINDS: dict[bool | None, str] = {True: "true", False: "false", None: "unknown"}
_LARGE, _MAP, _SMALL = 280, 220, 60
"""Width of pictures in pixels; panoramas, which stand one below the other, are twice as wide."""
_PANORAMA = 2.0
"""Width of a picture as a multiple of its height from which on it is one."""
NOTE = (
    "Exact: the cells and the constant add up to each part's share of the score, on the side of the query and on that of the "
    "tile. They account for the score; they do not say what it would be were a cell not there. Bars: the query's side."
)


def section(case: Case, study: Study, number: int) -> str:
    """Everything about one query."""
    parts = [_head(case, study, number), _pictures(case, study), _ranked(case, study)]
    if all(pair.evidence is not None for pair in case.pairs):
        parts.append(_evidence(case, study))
    parts += [_margin(case, study), _profile(case, study)]
    look = "case wide-pictures" if _wide(study) else "case"
    return f'<section class="{look}" id="q{number}">{"".join(parts)}</section>'


def said(case: Case, study: Study) -> tuple[str, str]:
    """Headline and reason of a case."""
    if not case.known:
        gap = case.matches[0].gap
        apart = "there is no other tile" if gap is None else f"the next tile is {gap:.3f} further away (d²)"
        return "Nearest tile", f"Its true place is not known here; {apart}."
    metres = None if case.metres is None else case.metres[0]
    return verdicts.verdict(case.matches[0], case.truth, case.rival, study.part_names, metres)[1:]


def sign(true: bool | None) -> str:
    """A tick, a cross, or a question mark: the second sign beside the colour."""
    spoken = {True: "true", False: "wrong", None: "unknown"}[true]
    return f'<span class="sign {KINDS[true]}" role="img" aria-label="{spoken}">{SIGNS[true]}</span>'


def thumbnail(picture: UInt8Array, kind: str = "") -> str:
    """A small square picture."""
    uri = overlays.data_uri(overlays.square(picture, _SMALL), 72)
    return f'<img src="{uri}" class="{kind}" alt="">'


def parts_legend(names: Sequence[str]) -> str:
    """The parts' colours."""
    items = "".join(
        f'<span><i style="background:{colour(i)}"></i>part {text(name)}</span>' for i, name in enumerate(names)
    )
    return f'<div class="legend">{items}</div>'


def _head(case: Case, study: Study, number: int) -> str:
    headline, reason = said(case, study)
    true = case.verdict
    chips = "".join(f"<span><i>{text(name)}</i> {text(value)}</span>" for name, value in case.facts)
    spoken = [verdicts.left_out(case.without, study.part_names)] if case.without is not None else []
    if case.truth is not None and case.truth.rank > 1:
        spoken.append(verdicts.reweighted(case.change, case.effect))
    if case.profile is not None:
        spoken.append(verdicts.turned(case.profile, study.views))
    more = "".join(f"<p>{text(sentence)}</p>" for sentence in spoken)
    return (
        f'<div class="head"><h2>{sign(true)} Query {text(case.name)}</h2>'
        f'<span class="dim">{number} <a class="back" href="#top">↑ contents</a></span></div>'
        f'<div class="verdict {KINDS[true]}"><b>{text(headline)}</b><p>{text(reason)}</p>{more}</div>'
        + (f'<div class="chips">{chips}</div>' if chips else "")
    )


def _pictures(case: Case, study: Study) -> str:
    """The query with its rings beside the tiles it is compared with."""
    drawn = [
        f'<figure class="framed">{_ringed(case.picture, study, 0)}<figcaption><b>Query</b><br>{text(case.name)}, '
        f"{study.views[0]}</figcaption></figure>"
    ]
    for pair in case.pairs:
        match = pair.match
        drawn.append(
            f'<figure class="framed {KINDS[match.true]}">{_ringed(pair.picture, study, 1)}<figcaption>{sign(match.true)} '
            f"<b>{text(_role(case, pair))}</b><br>{text(study.gallery[match.index].name)}, rank {match.rank:,}, "
            f"d² {match.distance2:.3f}</figcaption></figure>"
        )
    return f'<div class="three keep">{"".join(drawn)}</div>{parts_legend(study.part_names)}'


def _role(case: Case, pair: Pair) -> str:
    """What a tile is in the comparison."""
    match = pair.match
    if match.rank == 1:
        return {True: "Top match, the true tile", False: "Top match, wrong", None: "Top match"}[match.true]
    if match.true is None:
        return "Tile looked at"
    if match.true:
        return "The true tile" if case.truth is not None and match.index == case.truth.index else "Another true tile"
    return "Best wrong tile" if case.rival is not None and match.index == case.rival.index else "A wrong tile"


def _ringed(picture: UInt8Array, study: Study, side: int) -> str:
    view = study.views[side]
    shown = images.resize(picture, *_size(study, _LARGE))
    shown = overlays.with_rings(shown, study.spec.partition(view), study.map_sizes[view])
    return f'<img src="{overlays.data_uri(shown, 70)}" alt="{view} picture with its parts">'


def _size(study: Study, width: int) -> tuple[int, int]:
    """Height and width at which a picture is shown."""
    height, across = study.spec.input_size
    width = 2 * width if _wide(study) else width
    return max(1, round(width * height / across)), width


def _wide(study: Study) -> bool:
    height, width = study.spec.input_size
    return width >= _PANORAMA * height


def _ranked(case: Case, study: Study) -> str:
    """The nearest tiles, each with its distance as a bar of the parts' shares, all to one scale."""
    full = max(match.distance2 for match in case.matches)
    rows = []
    for place, match in enumerate(case.matches):
        entry = study.gallery[match.index]
        far = "" if case.metres is None else f'<td class="r">{case.metres[place]:,.0f} m</td>'
        gap = ' class="gap"' if place and match.rank > case.matches[place - 1].rank + 1 else ""
        rows.append(
            f'<tr{gap}><td class="r"><b>{match.rank:,}</b></td><td>{sign(match.true)}</td>'
            f"<td>{thumbnail(images.load_picture(entry.path), KINDS[match.true])}</td><td>{text(entry.name)}</td>{far}"
            f'<td class="bar">{figures.shares(match.shares, full, study.part_names)}</td>'
            f'<td class="r"><b>{match.distance2:.3f}</b></td></tr>'
        )
    far = "" if case.metres is None else '<th class="r">off by</th>'
    return (
        '<div class="keep"><h3>Nearest tiles</h3><div class="wide"><table class="ranked"><thead><tr><th class="r">rank</th>'
        f"<th></th><th></th><th>tile</th>{far}<th>squared distance, part by part</th><th class='r'>d²</th></tr></thead>"
        f"<tbody>{''.join(rows)}</tbody></table></div></div>"
    )


def _evidence(case: Case, study: Study) -> str:
    """Each pair with its cells for and against, to one scale, and each part's sum as bars."""
    found = [pair.evidence for pair in case.pairs if pair.evidence is not None]
    maps = [(one.query.total(one.weights), one.tile.total(one.weights)) for one in found]
    limit = max(*(float(np.abs(cells).max()) for both in maps for cells in both), 1e-9)
    span = figures.evidence_span(found)
    columns = []
    for pair, one, (here, there) in zip(case.pairs, found, maps, strict=True):
        name = text(study.gallery[pair.match.index].name)
        sides = ((case.picture, here, 0, "query"), (pair.picture, there, 1, f"tile {name}"))
        drawn = "".join(
            f'<figure><img src="{_mapped(picture, cells, limit, study, side)}" alt="evidence for and against">'
            f"<figcaption>{label}</figcaption></figure>"
            for picture, cells, side, label in sides
        )
        why = verdicts.why(one, study.part_names, *study.views)
        columns.append(
            f'<div class="keep"><p>{sign(pair.match.true)} <b>{text(_role(case, pair))}</b>, {name}: score {one.score:.3f}</p>'
            f'<div class="pair">{drawn}</div><p>{text(why)}</p>{figures.evidence_bars(one, study.part_names, span)}</div>'
        )
    scale = overlays.data_uri(overlays.evidence_scale(240, 20), 90)
    legend = (
        f'<div class="legend"><span>one cell: {-limit:+.4f}<img src="{scale}" alt="">{limit:+.4f} of the score</span>'
        f'<span><i style="background:{figures.FOR}"></i>cells for</span><span><i style="background:{figures.AGAINST}"></i>'
        'cells against</span><span><i style="background:var(--constant)"></i>constant, from no cell</span>'
        '<span><i style="background:var(--ink);width:3px"></i>sum: what the part adds to the score</span></div>'
    )
    return (
        f'<h3>Evidence for and against</h3><div class="two">{"".join(columns)}</div>{legend}<p class="note">{NOTE}</p>'
    )


def _mapped(picture: UInt8Array, cells: FloatingArray, limit: float, study: Study, side: int) -> str:
    shown = overlays.with_evidence(images.resize(picture, *_size(study, _MAP)), cells, limit)
    view = study.views[side]
    return overlays.data_uri(overlays.with_rings(shown, study.spec.partition(view), cells.shape), 66)


def _margin(case: Case, study: Study) -> str:
    """The true tile against the wrong one, as steps from part to part, and the truth's rank without and by each part alone."""
    if case.margin is None:
        return ""
    cosines = case.ranking.cosines[case.margin.true], case.ranking.cosines[case.margin.wrong]
    falls = figures.waterfall(case.margin)
    rows = []
    for part, name in enumerate(study.part_names):
        rows.append(
            f'<tr><td><span class="swatch" style="background:{colour(part)}"></span>{text(name)}</td>'
            f'<td class="r">{cosines[0][part]:.3f}</td><td class="r">{cosines[1][part]:.3f}</td>'
            f'<td class="fall">{falls[part]}</td>{_ranks_without(case, part)}</tr>'
        )
    scores = (case.ranking.scores[case.margin.true], case.ranking.scores[case.margin.wrong])
    others = "" if case.without is None else f'<td class="r">{case.without.now.rank:,}</td><td class="r"></td>'
    total = (
        f'<tr class="sum"><td>all</td><td class="r">{scores[0]:.3f}</td><td class="r">{scores[1]:.3f}</td>'
        f'<td class="fall">{falls[-1]}</td>{others}</tr>'
    )
    names = [text(study.gallery[index].name) for index in (case.margin.true, case.margin.wrong)]
    ranks = '<th class="r">its rank<br>without the part</th><th class="r">its rank by<br>the part alone</th>'
    direction = f"← {sign(False)} nearer &nbsp; difference of d² &nbsp; {sign(True)} nearer →"
    return (
        f'<div class="keep"><h3>True tile {names[0]} against wrong tile {names[1]}</h3><div class="wide">'
        f'<table class="falls"><thead><tr><th>part</th><th class="r">cosine {sign(True)}</th>'
        f'<th class="r">cosine {sign(False)}</th><th class="fall">{direction}</th>'
        f"{'' if case.without is None else ranks}</tr></thead><tbody>{''.join(rows)}{total}</tbody></table></div></div>"
    )


def _ranks_without(case: Case, part: int) -> str:
    """Two cells: the nearest true tile's rank without a part, and by it alone."""
    if case.without is None:
        return ""
    left = case.without.without[part]
    rank = "–" if left is None else f"{left.rank:,}"
    alone = case.without.alone[part]
    return f'<td class="r">{rank}</td><td class="r">{"–" if alone is None else f"{alone.rank:,}"}</td>'


def _profile(case: Case, study: Study) -> str:
    """What becomes of score and rank while the query is turned."""
    if case.profile is None:
        return ""
    who = (
        "the true tile"
        if case.profile.points[0].true
        else f"tile {text(study.gallery[case.profile.points[0].tile].name)}"
    )
    legend = (
        f'<div class="legend"><span><i class="line"></i>{who}</span><span><i class="line dash"></i>best score of any tile</span>'
        "<span>colours: cosine of each part</span><span>circle: best rank</span></div>"
    )
    return (
        '<div class="keep"><h3>The query turned once around, counter-clockwise</h3>'
        f"{figures.profile(case.profile, study.part_names)}{legend}</div>"
    )
