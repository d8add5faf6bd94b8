"""The upload of pictures of the user's own."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any

import viser

from explorer.server.viser_compat import forget_upload, uuid_of
from explorer.web.render import render


class UploadControl:
    """One browser's upload button, hidden: the page's script presses it. It reads one picture at a time.

    Args:
        take: takes the name and the content of each file.
        notify_error: shows an error with a title and a text.
        forget_error: takes the last error away.
    """

    def __init__(
        self,
        gui: viser.GuiApi,
        take: Callable[[str, bytes], None],
        notify_error: Callable[[str, str], None],
        forget_error: Callable[[], None],
    ) -> None:
        self._take, self._notify_error, self._taking = take, notify_error, threading.Lock()
        self._forget_error = forget_error
        # Two may be read: the next picture of a batch may arrive before the thread of the last one has ended.
        self._reading = threading.BoundedSemaphore(2)
        self._button = gui.add_upload_button("Use my own picture", mime_type="image/jpeg,image/png,image/webp")
        self._button.on_upload(self._on_upload)
        gui.add_html(
            render("panels/hidden_buttons", ids=[uuid_of(self._button)])
        )  # viser shows it even if `visible` is false

    def _on_upload(self, _: Any) -> None:
        self._forget_error()
        if not self._reading.acquire(blocking=False):
            self._notify_error("Upload failed", "The previous picture is still being read; try again.")
            return
        # Reading would block one of viser's few callback threads, which serve all browsers.
        thread = threading.Thread(target=self._read, name="explorer-upload", daemon=True)
        try:
            thread.start()
        except BaseException:
            self._reading.release()
            raise

    def _read(self) -> None:
        try:
            with self._taking:
                file = self._button.value
                if not file.name:  # of two simultaneous uploads, only the later one is read
                    return
                forget_upload(self._button)
                name, content = file.name, file.content
            self._take(name, content)
        finally:
            self._reading.release()
