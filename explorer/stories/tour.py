"""The tour: a story for any model and data set, whose steps point at parts of the page and leave it as it is."""

from __future__ import annotations

from typing import Any, get_args

from explorer.stories.story import Focus, Step, Story
from explorer.workspace import Workspace

NAME = "Tour"
# The places on the page in words.
PLACES: dict[Focus, str] = {
    "query": "the query",
    "tile": "the compared tile",
    "parts": "the bars of the parts",
    "ranking": "the ranking",
    "verdict": "the verdict",
    "controls": "the links at the top",
    "window": "the open window",
}
assert set(PLACES) | {""} == set(get_args(Focus))


def story(workspace: Workspace) -> Story:
    """Return the tour in five steps; it does not mention what the model and the data set lack."""
    task = next(iter(workspace.tasks.values()))
    live, cells, mapped = workspace.model is not None, workspace.contract.has_cells, task.geometry is not None
    rings = workspace.contract.part_noun == "ring"
    whole = "rings" if rings else "parts"
    evidence = (
        " Why this answer?, below it, shows place by place what speaks for it, which adds up. Its tab Heatmaps shows where the "
        "model reacts."
    )
    decided = "which part decided" if workspace.has_parts else "by how much"
    does = [*([f"takes the {whole} apart"] if workspace.has_parts else []), *(["shows the map"] if mapped else [])]
    row = f"The row above the pictures {' and '.join(does)}. " if does else ""
    keys = [f"{key} {do}" for key, do in zip("XM" if workspace.has_parts else "M", does, strict=False)]
    # Each place has a title, what everybody sees, what stands beside it on a large screen alone, and keys.
    cards: dict[Focus, tuple[str, str, str, str]] = {
        "query": (
            "A picture goes in",
            f"Where was this {task.query_view} picture taken? The program compares it with {task.tiles:,} others of known "
            "place.",
            f"The panel Query has all {task.query_view} pictures{', and takes one of your own' if live else ''}.",
            f"N takes the next one{'; J and L turn it' if live else ''}",
        ),
        "parts": (
            "As a whole",
            "The model describes each picture by one vector, and the bar is the difference of two of them. Where a second bar "
            "stands beside it, that one says for which of two pictures the comparison speaks.",
            "",
            "",
        )
        if not workspace.has_parts
        else (
            "Part by part",
            f"Both pictures are divided into {'square rings around the centre' if rings else 'parts'}, and each part is "
            "compared with its counterpart. Its share of the whole difference is large where the two agree little.",
            "Where a second bar stands beside it, that one says for which of two pictures the part speaks.",
            "",
        ),
        "ranking": (
            "The ranking",
            "The most similar pictures, best first, with ✓ at the right place. Press one to compare it.",
            "In the panel Parts you say how much each part counts, and the order follows."
            if workspace.has_parts
            else "",
            "",
        ),
        "verdict": (
            "Why this answer?",
            f"This says if the answer is right, and {decided}.{evidence if live and cells else ''}",
            "",
            "Y opens it" if live and cells else "",
        ),
        "controls": (
            "Look around",
            "Link copies an address that brings back what you see. The Glossary says what a word means. Start, above the "
            "pictures, leads back to one picture and its answer.",
            f"{row}The list with the magnifier, above these links, has every command.",
            ", ".join([*keys, "Ctrl K lists every command"]),
        ),
    }
    return Story(NAME, tuple(_step(place, *texts) for place, texts in cards.items()))


def _step(place: Focus, title: str, text: str, large: str, keys: str) -> Step:
    """Return a step; the page leaves out on a phone what `large` and `keys` say."""
    further = [f"Panels: {large}"] * bool(large) + [f"Keys: {keys}."] * bool(keys)
    return Step("", "\n".join([title, text, *further]), points_at=place)


def places() -> dict[Focus, dict[str, Any]]:
    """Return where the page finds each place: the first visible element of its `selectors`."""
    windows = ("#lpn-why", "#lpn-lab-table", "#lpn-lab-breakdown", "#lpn-lab-map", "#lpn-flight")
    return {
        "query": _place("#lpn-stage-query"),
        "tile": _place("#lpn-stage-tile"),
        "parts": _place("#lpn-bars", "#lpn-parts"),
        "ranking": _place("#lpn-matches", "#lpn-stage-cards"),
        "verdict": _place("#lpn-verdict"),
        "controls": _place("#lpn-header .tools"),
        "window": _place(*windows),
    }


def _place(*selectors: str) -> dict[str, Any]:
    return {"selectors": selectors}
