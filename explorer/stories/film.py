"""A story as a short silent film: each step as the app's page shows it, in a browser without a window."""

from __future__ import annotations

import io
import shutil
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import parse_qs, urlsplit

import cv2
import msgspec
import numpy as np

from explorer.stories.story import Story
from lpn.core.arrays import UInt8Array
from lpn.core.errors import InputError, LPNError
from lpn.core.files import check_outputs, printable, write_atomic
from lpn.core.progress import CountProgress

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page, Playwright

# Frames a second, and those in which one step turns into the next.
RATE, FADE = 15, 6
# A person reads so many letters a second, and looks at the picture for so many seconds besides.
_LETTERS, _LOOK = 18.0, 1.5
SHORTEST, LONGEST = 3.0, 12.0
# Seconds that a step may take until its page is at rest, and between two looks at it.
_PATIENCE, _PAUSE = 180.0, 0.5
_QUALITY = 82
# The newest answer of the page is that of the step, and nothing in sight is still computed.
_READY = """query => {
  const status = document.getElementById("lpn-status");
  const seen = (one) => one.getClientRects().length > 0;
  return status && status.dataset.seq !== "0" && (!query || status.dataset.name === query)
    && !document.querySelector("#lpn-told.waiting") && ![...document.querySelectorAll(".busy")].some(seen);
}"""


@dataclass(frozen=True)
class Take:
    """A step of a film.

    Attributes:
        picture: (H, W, 3) uint8 RGB.
        seconds: for which it stands still.
    """

    picture: UInt8Array
    seconds: float


def address(url: str, shows: str, dark: bool, plain: bool) -> str:
    """Return the address of the app's page for a step, in the words that the step names, else in plain ones or the field's."""
    given = {"theme": "dark" if dark else "light", "screen": "all", "words": "plain" if plain else "expert"}
    named = parse_qs(shows)
    pairs = [shows, *(f"{key}={value}" for key, value in given.items() if key not in named)]
    return f"{url}{'&' if '?' in url else '?'}{'&'.join(filter(None, pairs))}"


def reading_time(caption: str) -> float:
    """Return the seconds in which a caption is read and its picture looked at, from `SHORTEST` to `LONGEST`."""
    return float(np.clip(len(caption) / _LETTERS + _LOOK, SHORTEST, LONGEST))


def check_film(out: Path, story: Story, size: tuple[int, int]) -> None:
    """Check before the app is started that a film of a story can be made and written.

    Raises:
        InputError: if the file's name ends in neither .mp4 nor .webp, the story has no step, or the size is not possible.
        OutputError: if the file cannot be written.
    """
    if not story.steps:
        raise InputError(f"The story {printable(story.name)!r} has no step; there is nothing to record.")
    if any(side % 2 or not 320 <= side <= 3840 for side in size):
        raise InputError(f"The size is {size[0]} x {size[1]}; expected even numbers of pixels from 320 to 3840.")
    check_outputs((out, ".mp4", ".webp"))


def record(
    url: str,
    story: Story,
    size: tuple[int, int],
    dark: bool,
    seconds: float | None,
    on_progress: CountProgress,
    plain: bool = True,
) -> list[Take]:
    """Show each step of a story in the app's page, and take its picture once the page is at rest.

    Args:
        url: address of the running app.
        size: width and height of the page in pixels.
        seconds: for which each step stands; by default the reading time of its caption.
        plain: the page speaks plain words, unless a step names its words.

    Raises:
        InputError: if no browser is installed.
        LPNError: if a step does not come to rest.
        ModuleNotFoundError: without playwright.
    """
    from playwright.sync_api import sync_playwright

    takes = []
    with sync_playwright() as playwright:
        browser = _launch(playwright)
        context = browser.new_context(
            viewport={"width": size[0], "height": size[1]}, color_scheme="dark" if dark else "light"
        )
        page = context.new_page()
        shows = ""
        for index, step in enumerate(story.steps):
            shows = step.shows or shows  # a step that shows nothing leaves the page as it is
            picture = _picture(page, address(url, shows, dark, plain), story, index)
            takes.append(Take(picture, reading_time(step.caption) if seconds is None else seconds))
            on_progress(index + 1, len(story.steps))
        browser.close()
    return takes


def write(takes: Sequence[Take], out: Path, fade: int = FADE, quality: int = _QUALITY) -> None:
    """Write a film, whose steps turn into one another, as H.264 (.mp4) or as an animated picture (.webp).

    Args:
        fade: frames in which one step turns into the next; 1 cuts.
        quality: of an animated picture, 1 to 100.

    Raises:
        OutputError: if it cannot be written; nothing is left behind.
        ModuleNotFoundError: for an .mp4 without PyAV.
    """
    frames = _frames(takes, fade)
    write_atomic(out, _webp(frames, quality) if out.suffix.lower() == ".webp" else _mp4(frames))


def installed_browser() -> str | None:
    """Return the path of the system's Chromium or Chrome; None without one, where playwright takes its own."""
    names = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
    return next(filter(None, map(shutil.which, names)), None)


def _launch(playwright: Playwright) -> Browser:
    from playwright.sync_api import Error

    try:
        return playwright.chromium.launch(executable_path=installed_browser())
    except Error as error:
        raise InputError(
            "A film is taken in Chromium, which cannot be started here; install it, or give the command: playwright install "
            "chromium."
        ) from error


def _picture(page: Page, shown: str, story: Story, index: int) -> UInt8Array:
    """Return the picture of a step at rest, (H, W, 3) uint8 RGB, given the address that shows it."""
    from playwright.sync_api import TimeoutError as NotReady

    query = parse_qs(urlsplit(shown).query).get("query", [None])[0]
    try:
        page.goto(shown, timeout=_PATIENCE * 1000)
        page.wait_for_function(_READY, arg=query, timeout=_PATIENCE * 1000)
        # viser's notices are about this browser, and no part of the story.
        notices = page.evaluate("lpn.viser.SELECTORS.notification")
        page.add_style_tag(
            content=f"{notices} {{ display: none !important }} #lpn-told button {{ display: none !important }}"
        )
        page.evaluate("([story, index]) => lpn.tell(story, index)", [msgspec.to_builtins(story), index])
        until, before = time.monotonic() + _PATIENCE, b""
        while time.monotonic() < until:
            page.wait_for_function(_READY, arg=query, timeout=_PATIENCE * 1000)
            page.wait_for_timeout(_PAUSE * 1000)
            shot = page.screenshot()
            if shot == before:
                return _decoded(shot)
            before = shot
    except NotReady as error:
        raise _restless(story, index) from error
    raise _restless(story, index)


def _decoded(shot: bytes) -> UInt8Array:
    """Return the RGB pixels of a picture's PNG, (H, W, 3) uint8."""
    from PIL import Image

    return np.asarray(Image.open(io.BytesIO(shot)).convert("RGB"))


def _restless(story: Story, index: int) -> LPNError:
    return LPNError(
        f"Step {index + 1} of {printable(story.name)!r} did not come to rest within {_PATIENCE:g} s; open the story in the "
        "explorer, and see what the step waits for."
    )


def _frames(takes: Sequence[Take], fade: int) -> Iterator[tuple[UInt8Array, int]]:
    """Yield each frame, and for how many of `RATE` a second it stands."""
    for number, take in enumerate(takes):
        yield take.picture, max(round(take.seconds * RATE), 1)
        if number + 1 < len(takes):
            after = takes[number + 1].picture
            for step in range(1, fade):
                yield cv2.addWeighted(take.picture, 1 - step / fade, after, step / fade, 0).astype(np.uint8), 1


def _webp(frames: Iterator[tuple[UInt8Array, int]], quality: int) -> bytes:
    from PIL import Image

    shown = list(frames)
    pictures = [Image.fromarray(picture) for picture, _ in shown]
    file = io.BytesIO()
    durations = [round(1000 * count / RATE) for _, count in shown]
    options = {"quality": quality, "method": 4, "loop": 0, "duration": durations, "minimize_size": True}
    pictures[0].save(file, "WEBP", save_all=True, append_images=pictures[1:], **options)
    return file.getvalue()


def _mp4(frames: Iterator[tuple[UInt8Array, int]]) -> bytes:
    import av

    file = io.BytesIO()
    with av.open(file, "w", format="mp4") as film:
        stream = film.add_stream("libx264", rate=RATE, options={"crf": "20", "preset": "medium"})
        stream.pix_fmt = "yuv420p"
        for number, (picture, count) in enumerate(frames):
            if not number:
                stream.height, stream.width = picture.shape[:2]
            frame = av.VideoFrame.from_ndarray(picture, format="rgb24")
            for _ in range(count):
                frame.pts = None
                film.mux(stream.encode(frame))
        film.mux(stream.encode())
    return file.getvalue()
