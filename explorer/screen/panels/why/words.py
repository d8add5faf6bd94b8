"""The page in words and numbers: figures from the task's ranking, and this photo's numbers from its result."""

from __future__ import annotations

from typing import Any

import numpy as np

from explorer.compute.ranking_job import RankingJob
from explorer.screen.result import ScreenResult
from lpn.analysis import answer_context
from lpn.core.numbers import distance
from lpn.core.texts import counted
from lpn.core.version import __version__
from lpn.datasets.rendered import shows_rendered
from lpn.tasks import measure

# Points of the curve of errors in metres.
_POINTS = 120
_DEPTHS = (1, 5, 10)
_PROJECTS = (
    "The method is LPN: Wang et al., Each Part Matters: Local Patterns Facilitate Cross-View Geo-Localization, 2021.",
    "The 3-D scene is drawn by viser (Apache 2.0), and charts by uPlot (MIT).",
)


def page(result: ScreenResult, ranking: RankingJob) -> dict[str, Any]:
    """Return the page's message: sections of sentences, figures, the curves of errors and of leads, and the rings."""
    return {
        "did": _did(result),
        "judged": _judged(result, ranking),
        "answer": _answer(result, ranking),
        "scored": _scored(result),
        "pictures": _pictures(result),
        "sweeps": result.workspace.model is not None,
        "protocol": measure.sentence(result.task),
        "ranked": [ranking.n_ranked, len(ranking.task.queries)] if ranking.result is None else [],
        "error": ranking.error,
        **_measured(result, ranking),
    }


def _did(result: ScreenResult) -> list[str]:
    n, size = result.analysis.query.descriptor.shape
    noun, tiles = result.workspace.contract.part_noun, f"each of {counted(result.task.tiles, 'tile')}"
    described = "The network" if result.workspace.model is not None else "Another program"
    ends = "" if result.task.neighbours else ": 0 for the same, 4 at most"  # CSLS shifts these limits
    made = [
        f"LPN cut the photo and {tiles} into {n} {noun}s.",
        f"{described} described each {noun} by {size:,} numbers.",
        f"A tile's distance is the sum over its {n} {noun}s{ends}.",
    ]
    if n == 1:
        made = [
            f"{described} described the photo and {tiles} as a whole, by {size:,} numbers.",
            f"A tile's distance is that of these numbers{ends}.",
        ]
    title = result.task.gallery[result.first.index].title
    return [*made, f"The nearest tile is the answer: {title}, at {result.first.distance2:.3f}."]


def _measured(result: ScreenResult, ranking: RankingJob) -> dict[str, Any]:
    """Return the figures of all photos under equal part weights; none until they are ranked."""
    workspace, ranked = result.workspace, ranking.result
    figures = workspace.results(ranking)
    right, graded = workspace.counts(ranking)
    if ranked is None or figures is None or not graded:
        return {"figures": [], "metres": None, "leads": None, "rings": None}
    known, missed = workspace.graded(ranking), graded - right
    near = int(np.count_nonzero(known & (ranking.ranks > 0) & (ranking.ranks < _DEPTHS[-1])))
    listed = [("found", f"{right:,}", f"of {counted(graded, 'photo')}")]
    listed += [
        ("R@1" if depth == 1 else f"R@{depth}", f"{figures[f'recall@{depth}']:.1f} %", _meaning(depth))
        for depth in _DEPTHS
    ]
    listed.append(("AP", f"{figures['ap']:.1f} %", "average precision: 100 % if all true tiles come first"))
    listed.append(("missed", f"{missed:,}", f"in {near:,} of them, the truth is among the first {_DEPTHS[-1]}"))
    metres = None
    if ranked.errors is not None and "median error m" in figures:
        errors = np.sort(ranked.errors[known & np.isfinite(ranked.errors)])
        shares = np.linspace(0, 100, min(_POINTS, len(errors)))
        metres = [[round(max(float(one), 0.1), 1) for one in np.percentile(errors, shares)], shares.round(1).tolist()]
        within = ", ".join(f"{figures[f'within {one} m']:.0f} % within {one} m" for one in measure.WITHIN)
        listed.append(
            ("median", distance(figures["median error m"]), f"from the photo's place to the answer; {within}")
        )
    return {
        "figures": listed,
        "metres": metres,
        "leads": _leads(result, ranking),
        "rings": _rings(result),
    }


def _meaning(depth: int) -> str:
    return "found: a true tile comes first" if depth == 1 else f"a true tile is among the first {depth}"


def _leads(result: ScreenResult, ranking: RankingJob) -> list[list[float]] | None:
    """Return leads and the percentage of photos found with each; None where photos are few."""
    assert ranking.result is not None
    groups = answer_context.found_by_lead(ranking.result.ranking, result.workspace.graded(ranking))
    return [[round(of.lead, 4), round(100 * of.found / of.queries, 1)] for of in groups] or None


def _rings(result: ScreenResult) -> list[dict[str, Any]] | None:
    """Return each part's mean share of the truth's lead over the best wrong tile, for found and for missed photos."""
    known = result.workspace.outcomes(result.task)
    if known is None or result.workspace.contract.n_parts == 1:
        return None
    outcomes = known[0]
    means = []
    for rows in (outcomes.hits, outcomes.failed):
        terms = outcomes.parts[rows & np.isfinite(outcomes.margin)]
        means.append(terms.mean(axis=0).tolist() if len(terms) else [None] * terms.shape[1])
    decides = np.bincount(
        outcomes.deciding_part[outcomes.hits & (outcomes.deciding_part >= 0)], minlength=terms.shape[1]
    )
    return [
        {
            "name": name,
            "found": None if found is None else round(found, 4),
            "missed": None if missed is None else round(missed, 4),
            "most": int(most),
        }
        for name, found, missed, most in zip(result.workspace.part_names, *means, decides, strict=True)
    ]


def _judged(result: ScreenResult, ranking: RankingJob) -> list[str]:
    workspace, task = result.workspace, result.task
    flight = workspace.flight
    if task.no_truth:
        said = [task.no_truth]
    elif flight is not None:
        by = "its GPS tag" if result.state.own else flight.judge_of(result.state.query)
        said = [f"Found: the middle of the photo lies on the nearest tile, by {by}."]
    elif task.of_map:
        said = ["Found: the photo's GPS tag lies on the nearest tile."]
    elif shows_rendered(workspace.root):
        said = ["Found: the nearest tile shows the photo's place, by the plan that the pictures are drawn from."]
    elif task.truth is not None:
        said = ["Found: the nearest tile is one that the data set lists as true for the photo."]
    else:
        said = ["Found: the nearest tile has the photo's place number in the data set."]
    graded, queries = workspace.counts(ranking)[1], len(task.queries)
    if ranking.result is not None and 0 < graded < queries:
        said.append(f"Of {queries:,} photos, {queries - graded:,} do not count, as their place is not sure.")
    return [*said, "Missed: a wrong tile is nearer than every true one."]


def _answer(result: ScreenResult, ranking: RankingJob) -> dict[str, Any]:
    """Return sentences that compare the lead of this answer with other leads, and the lead."""
    analysis, workspace, state = result.analysis, result.workspace, result.state
    own = bool(state.own)
    gap, said = result.first.shown_gap, list[str]()
    if gap is not None:
        said.append(f"It leads the next tile by {gap:.3f}.")
    rendered = shows_rendered(workspace.root)
    if own and rendered:
        said.append("Computers drew this place, so a photo of yours has no true tile here.")
    elif state.weights:
        said.append("No other photo was ranked under these part weights, so it is unknown how typical that is.")
    elif ranking.result is not None:
        graded = workspace.graded(ranking)
        of_lead = result.first.gap
        alike = answer_context.answers_alike(ranking.result.ranking, of_lead, graded, None if own else state.query)
        if alike is not None and not (own and _names_junk(result)):
            share = 100 * alike.right / alike.queries
            said.append(
                f"Of {alike.queries:,} other photos with about this lead, {alike.right:,} ({share:.0f} %) are found."
            )
        if own:
            said += _far(result)
        elif (
            result.first.true and not result.question.change and (known := workspace.outcomes(result.task)) is not None
        ):
            rival = analysis.verdict.rival
            if rival is not None and rival.rank > 2:
                said.append(f"It leads the nearest wrong tile by {analysis.verdict.lead:.3f}.")
            said.append(answer_context.describe_lead(known[0], analysis.verdict.lead))
        if result.question.change:
            said.append("Those photos are not turned; this one is.")
    return {
        "said": [one for one in said if one],
        "lead": None if result.first.gap is None else round(result.first.gap, 4),
    }


def _names_junk(result: ScreenResult) -> bool:
    """Return whether the truth lists tiles that do not count; a user's photo has no such list."""
    return any(len(of.junk) or of.among is not None for of in result.task.truth or ())


def _far(result: ScreenResult) -> list[str]:
    """Compare the answer's distance from a user's photo with distances of photos whose place is, and is not, in the gallery."""
    measured, ranking = result.workspace.answer_distances(result.task), result.analysis.ranking
    if measured is None:
        return []
    plain = 2.0 - 2.0 * float(ranking.cosines[result.first.index] @ ranking.weights)  # before CSLS
    shares = measured.farther(plain)
    if shares is None:
        return []
    nearer, absent = (f"{100 * share:.0f} %" for share in shares)
    return [
        f"Of {len(measured.right):,} found photos here, {nearer} are nearer to their tiles.",
        f"Without their true tiles, {absent} of all photos would be at least this far from the nearest.",
    ]


def _scored(result: ScreenResult) -> list[str]:
    task, workspace, state = result.task, result.workspace, result.state
    said = [f"Model: {workspace.model_name}, {workspace.description}."]
    if task.calibration is None:
        said.append("Distances are plain: as the network gives them, not calibrated.")
    else:
        said.append("Distances are calibrated without labels: the mean of each view is subtracted.")
        zooms = {zoom for of_view in task.calibration.zooms.values() for zoom in of_view.values()}
        if zooms != {1.0}:
            said.append(
                f"Pictures are zoomed by {min(zooms):.2f} to {max(zooms):.2f}, so that both views show as much ground."
            )
    if task.neighbours:
        said.append(
            f"A tile that is near to many photos is moved away, by its {task.neighbours} nearest photos (CSLS)."
        )
    if workspace.weather:
        said.append(f"All photos are drawn {workspace.weather.describe()}.")
    if state.weights:
        shown = ", ".join(f"{weight:g}" for weight in state.weights)
        said.append(f"Part weights of this photo: {shown}. The figures are for equal weights.")
    return [*said, task.no_map] if task.no_map else said


def _pictures(result: ScreenResult) -> list[dict[str, str]]:
    """Return the authors of pictures, model, and program: texts, some with an address."""
    workspace = result.workspace
    said = [{"text": f"Data: {workspace.data_name}."}]
    place = None if workspace.basemap is None else workspace.basemap.place
    if place is not None and place.credit:
        said.append({"text": f"Pictures: {place.credit}.", "href": place.source})
    elif shows_rendered(workspace.root):
        said.append({"text": "Pictures: drawn by a computer from a plan; the place does not exist."})
    else:
        said.append({"text": "Pictures: under the licence of their data set, which its authors state."})
    return [*said, *({"text": text} for text in _PROJECTS), {"text": f"LPN Explorer {__version__}, MIT licence."}]
