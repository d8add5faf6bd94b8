"""Film a story of the demo as an animated picture: `python -m tools.film STORY OUT.webp [--size W H] [--seconds S]`."""

from __future__ import annotations

import argparse
import io
import sys
import time
from collections.abc import Sequence
from functools import partial
from pathlib import Path

import msgspec
from PIL import Image
from playwright.sync_api import Page, sync_playwright

from explorer.app import serve_in_background
from explorer.cli import Explore
from explorer.stories.library import stories_of
from explorer.stories.story import Story
from lpn.core.errors import InputError, LPNError
from lpn.core.files import check_outputs, printable, write_atomic
from tools.fixtures.chromium import launch

_QUALITY = 82
# Seconds that a step may take until its page is at rest, and between two looks at it.
_PATIENCE, _PAUSE = 180.0, 0.5
# The page has an answer, and nothing in sight is still computed.
_READY = """() => {
  const status = document.getElementById("lpn-status");
  const seen = (one) => one.getClientRects().length > 0;
  return status && status.dataset.seq !== "0"
    && !document.querySelector("#lpn-told.waiting") && ![...document.querySelectorAll(".busy")].some(seen);
}"""


def record(url: str, story: Story, size: tuple[int, int]) -> list[Image.Image]:
    """Show each step of a story in the app's page, and take its picture with the caption once the page is at rest.

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
        shows = ""
        for index, step in enumerate(story.steps):
            shows = step.shows or shows  # a step that shows nothing leaves the page as it is
            page.goto(f"{url}{'&' if '?' in url else '?'}theme=dark&screen=all&words=plain&{shows}")
            pictures.append(_picture(page, story, index))
        browser.close()
    return pictures


def _picture(page: Page, story: Story, index: int) -> Image.Image:
    """Return the picture of a step at rest, whose page is open."""
    wait = partial(page.wait_for_function, _READY, timeout=_PATIENCE * 1000)
    wait()
    # viser's notices are about this browser, and no part of the story.
    notices = page.evaluate("lpn.viser.SELECTORS.notification")
    page.add_style_tag(content=f"{notices}, #lpn-told button {{ display: none !important }}")
    page.evaluate("([story, index]) => lpn.tell(story, index)", [msgspec.to_builtins(story), index])
    until, before = time.monotonic() + _PATIENCE, b""
    while time.monotonic() < until:
        wait()
        page.wait_for_timeout(_PAUSE * 1000)
        shot = page.screenshot()
        if shot == before:
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
    parser.add_argument("story", help="its name, as lpn explore --stories lists it")
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
        pictures = record(f"{page.url}/classic/", stories[given.story], tuple(given.size))
    write(pictures, given.seconds, given.out)
    return 0


if __name__ == "__main__":
    try:
        sys.exit(main())
    except LPNError as error:
        sys.exit(f"tools.film: {error}")
