"""Sentences that say what the numbers of an explanation mean."""

from __future__ import annotations

import re
from collections.abc import Sequence

import numpy as np

from lpn.core.arrays import Float64Array, FloatingArray
from lpn.core.numbers import rounded_to_sum, signed, wrap_degrees
from lpn.core.texts import listed, ordinal
from lpn.core.views import View
from lpn.drawing.words import capitalised, plain, say, unit
from lpn.explain import Evidence
from lpn.explain.counterfactual import Effect, Reweighting
from lpn.explain.lead_places import LeadPlace, middle_of
from lpn.explain.sweeps import SweepResult, signed_value
from lpn.models.contract import Contract
from lpn.tasks.task import Task

_PICTURES = {"drone": "drone pictures", "satellite": "satellite pictures", "street": "street pictures"}
_SIDES = ("right", "upper right", "top", "upper left", "left", "lower left", "bottom", "lower right")
_COMPASS = ("east", "north-east", "north", "north-west", "west", "south-west", "south", "south-east")
# Parts decide together if their differences are at least this share of the largest.
_ALIKE = 0.9
# A guessed heading is right, or roughly so, within so many degrees; a sweep goes in steps of 15.
_RIGHT_HEADING, _ROUGH_HEADING = 15.0, 45.0


def describe_position(cells: Float64Array, view: View) -> str:
    """Say where in a picture the positive cells, of (h, w), lie: "upper right" or, on a satellite tile, "north-east".

    "all around" means that they lie on no side. An unrolled tile, which is wide, does not have north at its top.
    """
    height, width = cells.shape
    side = middle_of(np.maximum(cells, 0.0))
    if side is None:
        return "all around"
    sector = round(np.degrees(np.arctan2(side[1], side[0])) / 45) % 8
    return (_COMPASS if view == "satellite" and width < 2 * height else _SIDES)[sector]


def compass(azimuth: float) -> str:
    """Return the name of a direction in degrees clockwise from north, as one of eight: "south-west"."""
    return _COMPASS[round((90 - azimuth) / 45) % 8]


def pictures_of(task: Task) -> str:
    """Return what the gallery's pictures are in plain words."""
    return "pieces of the map" if task.of_map else _PICTURES[task.views[1]]


def rounded_cosines(cosines: Sequence[float], taken: Sequence[float]) -> tuple[list[float], list[float]]:
    """Return the parts' weighted cosines, and what CSLS takes from them, rounded so that each and both add up as shown."""
    totals = rounded_to_sum([sum(cosines), sum(taken)])
    return rounded_to_sum(cosines, total=totals[0]), rounded_to_sum(taken, total=totals[1])


def describe_evidence(
    evidence: Evidence, names: Sequence[str], query_view: View, tile_view: View, noun: str = "part"
) -> str:
    """Say which part, called `noun`, and which places of photo and tile a pair's score comes from; of one part, the places."""
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
    similarity, what = sum(rounded), say("score" if evidence.csls is None else "part cosine")
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
            f" Of the whole {what}, {signed(constants)} is constants: what the network takes both pictures for, rather than "
            "what they show."
        )
    if weighted[worst] < 0 and len(names) > 1:
        text += f" {noun.capitalize()} {names[worst]} speaks against the pair ({signed(rounded[worst])})."
    if evidence.csls is not None:
        took = f"{-sum(taken):.3f} from it, because both pictures have near neighbours elsewhere."
        text += f" Holding favourites back takes {took}" if plain() else f" CSLS takes {took}"
    return text


def describe_lead_place(
    place: LeadPlace, part_names: Sequence[str], query_view: View, names: tuple[str, str], whose: str
) -> str:
    """Say in one sentence which parts do most for a tile, on which side of the query, and what both tiles show there.

    Args:
        names: of the tile that the parts speak for, and of the other one.
        whose: the query in words, such as "your picture".
    """
    several = len(place.parts) > 1
    which = f"{say('part', len(place.parts))} {_listed_parts(place.parts, part_names)}"
    verb, percent = "speak" if several else "speaks", f"{100 * place.share:.0f}"
    if len(part_names) == 1:
        text = f"The model's one vector of the whole picture speaks for {names[0]}"
    elif percent == "100":
        text = f"Only {which} {verb} for {names[0]}"
    else:
        most = "most, alike," if several else "most"
        text = f"{capitalised(which)} {verb} {most} for {names[0]} ({percent} % of what speaks for it)"
    position = describe_position(place.cells, query_view)
    central = all("centre" in part_names[part] for part in place.parts)
    if central:  # the middle of the picture is no side of it
        whose = f"this {say('part')}"
    if position == "all around":
        position = "all around the middle" if place.cells.any() and not central else ""
    elif query_view == "satellite":
        position = f"above all in the {position} of {whose}"
    else:
        word = "at" if position in ("top", "bottom") else "on" if position in ("left", "right") else "in"
        position = f"above all {word} the {position} of {whose}"
    text += f", {position}" if position else ""
    shown, other = place.uses
    if not shown:
        return f"{text}."
    if set(shown) == set(other):
        return f"{text}, where both show {listed(shown)}."
    there = f"{text}: there {names[0]} shows {listed(shown)}"
    return f"{there}, and {names[1]} {listed(other)}." if other else f"{there}."


def _listed_parts(parts: Sequence[int], part_names: Sequence[str]) -> str:
    """List parts by name; of rings in plain words, as one who never saw them needs it, with where they lie."""
    if not plain() or say("part") == "part" or len(part_names) == 1:
        return listed([_in_brackets(part_names[part]) for part in parts])
    where = [
        "the square in the middle"
        if part == 0
        else "the outermost"
        if part == len(part_names) - 1
        else f"the {ordinal(part + 1)} square ring from the middle"
        for part in parts
    ]
    return f"{listed([str(part + 1) for part in parts])}, {listed(where)},"


def _in_brackets(name: str) -> str:
    """Return "1 (centre)" for a part's name of a number and a word."""
    number, _, word = name.partition(" ")
    return f"{number} ({word})" if number.isdigit() and word else name


def describe_lumps(lumps: Sequence[str]) -> str:
    """Name the parts of a picture that no cell belongs to; empty if there are none."""
    if not lumps:
        return ""
    several = len(lumps) > 1
    whose = f"{say('part', len(lumps))} {', '.join(lumps)}"
    return f"No cell belongs to {whose}; {'they are constants' if several else 'it is a constant'} of each picture."


def no_cells(contract: Contract) -> str:
    """Say why a model without cells has no evidence."""
    form = "one vector" if contract.level == "one vector" else f"{contract.n_parts} parts"
    return (
        f"{contract.method} gives {form} for a picture and no cells ({contract.claim}), so its score cannot be split into "
        "places of the picture."
    )


def describe_margin(total: float, name: str) -> str:
    """Say by how much a tile leads or trails another one.

    Args:
        total: the margin in squared distance as it is shown, see `shown_difference`.
    """
    by = f"leads by {total:.3f}{unit()}" if total >= 0 else f"is {-total:.3f}{unit()} behind"
    return f"{capitalised(name)} {by}."


def describe_reweighting(change: Reweighting | None, effect: Effect | None, noun: str = "part") -> str:
    """State the smallest change of weights that puts the truth first, and its effect on all queries; `noun` is a part."""
    if change is None:
        return f"No choice of {noun} weights would put the truth first."
    percents = " : ".join(f"{100 * weight:.0f}" for weight in change.weights)
    text = f"The smallest change of {noun} weights that puts the truth first is {percents} %"
    return f"{text}." if effect is None else f"{text}; {describe_effect(effect)}."


def describe_effect(effect: Effect) -> str:
    """Say what other part weights do to all queries, as a clause."""
    verb = "helps" if effect.helps else "harms" if len(effect.lost) > len(effect.gained) else "neither helps nor harms"
    return (
        f"over all {effect.queries:,} {say('query', 2)} it {verb}: {len(effect.gained)} gained, {len(effect.lost)} lost, "
        f"{say('R@1')} {effect.before:.1f} to {effect.after:.1f} %"
    )


def describe_heading(profile: SweepResult, views: tuple[View, View], known: float | None = None) -> str:
    """Guess from the nearest tile alone where the top of the query points, and judge the guess if the heading is known.

    The text is empty unless a drone's picture, which has one heading, is compared with north-up satellite tiles.

    Args:
        known: the true heading in degrees clockwise from north.
    """
    heading = profile.heading()
    if heading is None or views != ("drone", "satellite"):
        return ""
    best = profile.best_top_match
    text = (
        f"Without knowing the truth, any tile is nearest at {signed_value('rotation', best.change):g}° "
        f"({say('d²')} {distance2(best.top_score):.3f}): by that, the picture's top points {heading:.0f}° clockwise from north"
    )
    if known is None:
        return f"{text}, a guess that may be wrong."
    off = abs(wrap_degrees(heading - known))
    judgement = "right" if off <= _RIGHT_HEADING else "roughly right" if off <= _ROUGH_HEADING else "wrong"
    return f"{text}. That guess is {judgement}, {off:.0f}° off: the top really points {known % 360:.0f}° clockwise from north."


def distance2(score: float) -> float:
    """Return the squared distance at a score."""
    return 2.0 - 2.0 * score


def leading_parts(differences: FloatingArray) -> list[int]:
    """Return the part with the largest difference, (n,), and those within 10 % of it, the largest first."""
    order: list[int] = np.argsort(-differences, kind="stable").tolist()
    least = _ALIKE * float(differences[order[0]])
    return [part for part in order if part == order[0] or differences[part] >= least > 0]


def _place(picture: str, position: str) -> str:
    return f"places all over the {picture}" if position == "all around" else f"the {picture}'s {position}"
