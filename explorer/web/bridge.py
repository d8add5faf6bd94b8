"""Call the page's script from Python, and receive the messages that the page sends back; none of them is trusted."""

from __future__ import annotations

import asyncio
import json
import logging
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import viser

from explorer.server.message_filter import MAX_TEXT
from explorer.server.viser_compat import thread_pool, uuid_of
from explorer.web.html import Html
from explorer.web.messages import Receivers
from explorer.web.render import call, render, run, run_once, shown_json

log = logging.getLogger(__name__)

# Messages of one browser that wait for their handlers; further ones are dropped. A page sends 17 a second.
MAX_WAITING = 200

_SCRIPT = ";".join(
    (Path(__file__).parent / "js" / name).read_text("utf-8")
    for name in (
        "viser_compat.js",
        "page.js",
        "viewport.js",
        "focus.js",
        "enlarged.js",
        "glossary.js",
        "straighten.js",
        "stage.js",
        "lists.js",
        "notes.js",
        "own.js",
        "pointer.js",
        "pins.js",
        "first_screen.js",
        "tips.js",
        "picture_loader.js",
        "tiles.js",
        "thumbnails.js",
        "pens.js",
        "map_marks.js",
        "pan_zoom.js",
        "stage_map.js",
        "stage_photo.js",
        "lab_map.js",
        "homography.js",
        "flight.js",
        "flight_map.js",
        "flight_photo.js",
        "flight_play.js",
        "timeline.js",
        "stories.js",
        "url_state.js",
    )
)


def clear_stage(gui: viser.GuiApi) -> None:
    """Have a page whose stage is being emptied keep nothing over it but the outlines of its pictures.

    It needs no session, and runs while the next one is built, which may take seconds on a busy machine.
    """
    gui.add_html(run_once(call("clearStage")))


class PageBridge:
    """Installs the script in one page, and hands the page's messages to their receivers.

    Args:
        receivers: a function for each room's class of messages, see `Receivers`.
        properties: initial properties of the script's object `lpn`.
        styles: a style element for the head of the page, so that it applies whichever panels are folded.
    """

    def __init__(
        self,
        gui: viser.GuiApi,
        receivers: Mapping[type[Any], Callable[[Any], None]],
        properties: Mapping[str, object],
        styles: str,
    ) -> None:
        self._receivers = Receivers(receivers)
        self._text = gui.add_text("page", "")
        self._text.on_update(self._updated)
        self._pool = thread_pool(gui)
        self._turn = asyncio.Lock()
        self._tasks: set[asyncio.Task[None]] = set()
        self._dropped = 0
        uuid = uuid_of(self._text)
        initial = json.dumps(shown_json({**properties, "bridge": uuid}))
        script = f"{_SCRIPT};Object.assign(lpn,{initial});{call('head', styles)};lpn.greet();lpn.work(0,0)"
        gui.add_html(render("hide_bridge", uuid=uuid) + run(script))
        self._address, self._ground, self._call, self._tab, self._stage, self._photo, self._theme, self._work = (
            Html(gui) for _ in range(8)
        )

    def set_address(self, query: str, keys: Sequence[str]) -> None:
        """Replace the values of `keys` in the page's address by a query string without "?"."""
        self._address.show(run(call("address", query, keys)))

    def tell_theme(self, dark: bool) -> None:
        """Tell the page which theme it has been given, which uncovers a page that opens."""
        self._theme.show(run(call("themed", "dark" if dark else "light")))

    def set_ground(self, ground: Mapping[str, object] | None) -> None:
        """Tell the page where the ground of the stage's map lies, see `GalleryMap.ground`; None without a map."""
        self._ground.show(run(call("stageMap", ground)))

    def set_photo(self, photo: Mapping[str, object] | None) -> None:
        """Lay a photo over the view through its camera, see `Stage.look_through`; None takes it away."""
        self._photo.show(run(call("stagePhoto", photo)))

    def set_stage(self, html: str) -> None:
        """Show the controls over the stage's pictures; none for an empty text."""
        self._stage.show(run(call("stage", html)))

    def call(self, function: str, *arguments: object) -> None:
        """Call a function of the page's script. The page may run only the last of several quick calls."""
        self._call.show(run_once(call(function, *arguments)))

    def work(self, done: int, total: int) -> None:
        """Show at the page's upper edge how far work is that goes on whatever the page shows; nothing at a total of 0."""
        self._work.show(run(call("work", done, total)))

    def open_tab(self, name: str) -> None:
        """Have the page open a tab of a window by its name; other calls do not replace this one."""
        self._tab.show(run_once(call("tab", name)))

    async def _updated(self, _: object) -> None:
        # viser runs a coroutine before it takes the next message. A function, in a thread of a pool, might find that one here.
        if len(self._tasks) >= MAX_WAITING:
            self._dropped += 1
            level = logging.DEBUG if self._dropped > 1 else logging.WARNING  # a flood would fill the log
            log.log(level, "Dropped message %d of a page of which %d wait", self._dropped, MAX_WAITING)
            return
        task = asyncio.create_task(self._hand_on(self._text.value))
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    async def _hand_on(self, message: Any) -> None:
        async with self._turn:
            try:
                await asyncio.get_running_loop().run_in_executor(self._pool, self.receive, message)
            except Exception:
                log.exception("A message of a page was not handled")

    def receive(self, message: Any) -> None:
        """Hand a message to its receiver; drop anything else."""
        if isinstance(message, str) and len(message) <= MAX_TEXT:
            self._receivers.take(message)
