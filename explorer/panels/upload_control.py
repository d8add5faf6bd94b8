"""The button for a picture of the user's own."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import viser

from explorer import session_state, uploads
from explorer.server.viser_compat import forget_upload
from explorer.session_state import StateChange
from lpn.core.errors import LPNError


class UploadControl:
    """One browser's upload button; it reads one picture at a time.

    Args:
        change: updates the browser's state with a function.
        notify_error: shows an error with a title and a text.
    """

    def __init__(
        self, gui: viser.GuiApi, change: Callable[[StateChange], None], notify_error: Callable[[str, str], None]
    ) -> None:
        self._change, self._notify_error, self._reading = change, notify_error, threading.Lock()
        self._button = gui.add_upload_button(
            "Use my own picture", mime_type="image/jpeg,image/png,image/webp", icon=viser.Icon.UPLOAD
        )
        self._button.on_upload(self._on_upload)

    def _on_upload(self, _: Any) -> None:
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
            file = self._button.value
            if not file.name:  # of two simultaneous uploads, only the later one is read
                return
            forget_upload(self._button)
            upload = uploads.read(file.name, file.content)
        except LPNError as error:
            self._notify_error("Upload failed", str(error))
            return
        finally:
            self._reading.release()
        self._change(lambda state: replace(session_state.upright(state), upload=upload, selected=None))
