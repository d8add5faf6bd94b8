"""Sentences about the numbers of an explanation."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence

import numpy as np

from lpn.core.arrays import Float32Array, Float64Array
from lpn.core.numbers import rounded_to_sum, signed, wrap_degrees
from lpn.core.texts import counted
from lpn.core.views import View
from lpn.explain import Evidence
from lpn.explain.counterfactual import Effect
from lpn.explain.sweeps import SweepResult, signed_value
from lpn.models.contract import Contract
from lpn.tasks.task import Task

_PICTURES = {"drone": "drone pictures", "satellite": "satellite pictures", "street": "street pictures"}
_SIDES = ("right", "upper right", "top", "upper left", "left", "lower left", "bottom", "lower right")
_COMPASS = ("east", "north-east", "north", "north-west", "west", "south-west", "south", "south-east")
# Cells lie on one side if their mean offset from the middle exceeds this share of their mean distance from it.
_ONE_SIDED = 0.25
# A guessed heading is right, or roughly right, within this many degrees; a sweep goes in steps of 15.
_RIGHT_HEADING, _ROUGH_HEADING = 15.0, 45.0


def describe_position(cells: Float64Array, view: View) -> str:
    """Describe the position of a picture's positive cells, (h, w): "upper right" or, on a satellite tile, "north-east".

    "all around" means no side. An unrolled tile, which is wide, does not have north at its top.
    """
    height, width = cells.shape
    side = _middle_of(np.maximum(cells, 0.0))
    if side is None:
        return "all around"
    sector = round(np.degrees(np.arctan2(side[1], side[0])) / 45) % 8
    return (_COMPASS if view == "satellite" and width < 2 * height else _SIDES)[sector]


def pictures_of(task: Task) -> str:
    """Return the noun for the gallery's pictures in plain words."""
    return "pieces of the map" if task.of_map else _PICTURES[task.views[1]]


def rounded_cosines(cosines: Sequence[float], taken: Sequence[float]) -> tuple[list[float], list[float]]:
    """Round the parts' weighted cosines, and the terms of CSLS, so that each list adds up to its rounded sum."""
    totals = rounded_to_sum([sum(cosines), sum(taken)])
    return rounded_to_sum(cosines, total=totals[0]), rounded_to_sum(taken, total=totals[1])


def describe_evidence(
    evidence: Evidence, names: Sequence[str], query_view: View, tile_view: View, noun: str = "part"
) -> str:
    """Say which part, called `noun`, and which places of photo and tile decide a pair's score; for one part, only the places."""
    weighted = evidence.weighted_cosines
    best, worst = int(np.argmax(weighted)), int(np.argmin(weighted))
    query_place = describe_position(evidence.query.cells[best], query_view)
    tile_place = describe_position(evidence.tile.cells[best], tile_view)
    if float(evidence.query.constants[best]) > evidence.cosines[best] / 2:
        places = "most of it by a constant that comes from no cell"
    elif query_place == tile_place == "all around":
        places = "from places all over both pictures"
    else:
        verb = "agree" if query_place == "all around" else "agrees"
        places = f"where {_place('photo', query_place)} {verb} with {_place('tile', tile_place)}"
    rounded, taken = rounded_cosines(weighted.tolist(), evidence.csls_shares)
    similarity, what = sum(rounded), "score" if evidence.csls is None else "cosine"
    constants = float(evidence.query.constants @ evidence.weights)
    if len(names) == 1:
        mainly = re.sub("^(from )?(where|places)", r"mainly from \2", places)
        text = f"The {what} is {signed(similarity)}"
        text += "." if constants > similarity / 2 > 0 else f", {mainly}."
    else:
        share = f"{signed(rounded[best])} of {signed(similarity)}"
        verb = "adds most to" if weighted[best] > 0 else "takes least from"
        text = f"{noun.capitalize()} {names[best]} {verb} the {what} ({share}), {places}."
    if constants > similarity / 2 > 0:
        text += (
            f" Of the whole {what}, {signed(constants)} comes from constants, which belong to no place in the pictures."
        )
    if weighted[worst] < 0 and len(names) > 1:
        text += f" {noun.capitalize()} {names[worst]} speaks against the pair ({signed(rounded[worst])})."
    if evidence.csls is not None:
        took = f"{-sum(taken):.3f} from it, because both pictures have near neighbours elsewhere."
        text += f" CSLS takes {took}"
    return text


def describe_lumps(lumps: Sequence[str], noun: str = "part") -> str:
    """State which parts of a picture have no cell; empty if all have one."""
    if not lumps:
        return ""
    several = len(lumps) > 1
    whose = f"{noun}{'s' if several else ''} {', '.join(lumps)}"
    return f"No cell belongs to {whose}; {'they are constants' if several else 'it is a constant'} of each picture."


def no_cells(contract: Contract) -> str:
    """Explain the lack of evidence for a model without cells."""
    form = "one vector" if contract.level == "one vector" else f"{contract.n_parts} parts"
    return (
        f"{contract.method} gives {form} for a picture and no cells ({contract.claim}), so its score cannot be split into "
        "places of the picture."
    )


def describe_reweighting(weights: Float32Array | None, effect: Effect | None, noun: str = "part") -> str:
    """State the smallest change of weights that puts the truth first, and its effect on all queries; `noun` names a part."""
    if weights is None:
        return f"No choice of {noun} weights would put the truth first."
    percents = " : ".join(f"{100 * weight:.0f}" for weight in weights)
    text = f"The smallest change of {noun} weights that puts the truth first is {percents} %"
    return f"{text}." if effect is None else f"{text}; {describe_effect(effect)}."


def describe_effect(effect: Effect) -> str:
    """Describe the effect of other part weights on all queries, as a clause."""
    verb = "helps" if effect.helps else "harms" if len(effect.lost) > len(effect.gained) else "neither helps nor harms"
    return (
        f"over {counted(effect.queries, 'query')} it {verb}: {len(effect.gained)} gained, {len(effect.lost)} lost, "
        f"R@1 {effect.before:.1f} to {effect.after:.1f} %"
    )


def describe_heading(profile: SweepResult, views: tuple[View, View], known: float | None = None) -> str:
    """Guess from the nearest tile alone the direction of the query's top, and judge the guess if the heading is known.

    The text is empty unless a drone's picture, which has one heading, is compared with north-up satellite tiles.

    Args:
        known: the true heading in degrees clockwise from north.
    """
    heading = profile.heading()
    if heading is None or views != ("drone", "satellite"):
        return ""
    best = profile.best_top_match
    text = (
        f"Over all turns, the smallest distance to any tile is at {signed_value('rotation', best.change):g}° "
        f"(d² {distance2(best.top.score):.3f}). So the picture's top should point {heading:.0f}° clockwise from north"
    )
    if known is None:
        return f"{text}, a guess that may be wrong."
    off = abs(wrap_degrees(heading - known))
    judgement = "right" if off <= _RIGHT_HEADING else "roughly right" if off <= _ROUGH_HEADING else "wrong"
    return f"{text}. That guess is {judgement}, {off:.0f}° off: the top really points {known % 360:.0f}° clockwise from north."


def distance2(score: float) -> float:
    """Return the squared distance at a score."""
    return 2.0 - 2.0 * score


def _place(picture: str, position: str) -> str:
    return f"places all over the {picture}" if position == "all around" else f"the {picture}'s {position}"


def _middle_of(weights: Float64Array) -> tuple[float, float] | None:
    """Return the mean offset of weights, (h, w), to the right and up, in shares of the sides; None for no side."""
    height, width = weights.shape
    up = 0.5 - (np.arange(height)[:, None] + 0.5) / height
    right = (np.arange(width)[None, :] + 0.5) / width - 0.5
    total = float((weights * np.hypot(up, right)).sum())
    east, north = float((weights * right).sum()), float((weights * up).sum())
    return None if total <= 0 or math.hypot(east, north) < _ONE_SIDED * total else (east, north)
