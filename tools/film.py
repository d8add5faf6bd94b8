"""Film a story of the demo as an animated picture: `python -m tools.film STORY OUT.webp [--size W H] [--seconds S]`."""

from __future__ import annotations

import argparse
import io
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from urllib.parse import quote

from PIL import Image
from playwright.sync_api import Page, sync_playwright

from explorer.app import serve_in_background
from explorer.cli import Explore
from explorer.screen.panels.stories.story import Story, stories_of
from lpn.core.errors import InputError, LPNError
from lpn.core.files import check_outputs, printable, write_atomic
from tools.fixtures.chromium import launch

_QUALITY = 82
# Seconds that a step may take until its page is at rest, and between two looks at it.
_PATIENCE, _PAUSE = 180.0, 0.5
# The page has the answer of what was asked for.
_READY = "Boolean(document.body.dataset.sequence) && !/wait|turning|down/.test(document.body.className)"


def record(url: str, story: Story, size: tuple[int, int]) -> list[Image.Image]:
    """Tell a story in the app's page, and take the picture of each step once the page is at rest.

    Args:
        url: address of the running app.
        size: width and height of the page in pixels.

    Raises:
        LPNError: if a step does not come to rest.
    """
    pictures = []
    with sync_playwright() as playwright:
        browser = launch(playwright)
        page = browser.new_page(viewport={"width": size[0], "height": size[1]}, color_scheme="dark")
        page.goto(f"{url}/?theme=dark&panel=stories&story={quote(story.name)}")
        page.locator("#panel .main").click(timeout=_PATIENCE * 1000)
        page.add_style_tag(content="#told nav { display: none !important }")
        for index in range(len(story.steps)):
            pictures.append(_picture(page, story, index))
            page.keyboard.press("ArrowRight")
        browser.close()
    return pictures


def _picture(page: Page, story: Story, index: int) -> Image.Image:
    """Return the picture of a step that is told, at rest."""
    until, before = time.monotonic() + _PATIENCE, b""
    while time.monotonic() < until:
        page.wait_for_timeout(_PAUSE * 1000)
        shot = page.screenshot()
        if shot == before and page.evaluate(_READY):
            return Image.open(io.BytesIO(shot)).convert("RGB")
        before = shot
    raise LPNError(f"Step {index + 1} of {printable(story.name)!r} did not come to rest within {_PATIENCE:g} s.")


def write(pictures: Sequence[Image.Image], seconds: float, out: Path) -> None:
    """Write a film, each of whose steps stands for some seconds, as an animated WebP that repeats.

    Raises:
        OutputError: if it cannot be written; nothing is left behind.
    """
    file = io.BytesIO()
    options = {"quality": _QUALITY, "method": 4, "loop": 0, "duration": round(1000 * seconds), "minimize_size": True}
    pictures[0].save(file, "WEBP", save_all=True, append_images=pictures[1:], **options)
    write_atomic(out, file.getvalue())


def main() -> int:
    """Film a story of the demo."""
    parser = argparse.ArgumentParser(description=__doc__, prog="python -m tools.film")
    parser.add_argument("story", help="its name, as the panel Stories lists it")
    parser.add_argument("out", type=Path, help=".webp file to write")
    parser.add_argument("--size", type=int, nargs=2, default=(1280, 800), help="width and height in pixels")
    parser.add_argument("--seconds", type=float, default=4.0, help="for which each step stands")
    given = parser.parse_args()
    check_outputs((given.out, ".webp"))
    workspace = Explore().opens_data()()
    stories = stories_of(workspace).by_name
    if given.story not in stories:
        raise InputError(f"There is no story {printable(given.story)!r}; there are {', '.join(stories)}.")
    with serve_in_background(lambda: workspace) as page:
        pictures = record(page.url, stories[given.story], tuple(given.size))
    write(pictures, given.seconds, given.out)
    return 0


if __name__ == "__main__":
    try:
        sys.exit(main())
    except LPNError as error:
        sys.exit(f"tools.film: {error}")
