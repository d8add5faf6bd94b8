"""The notification of the last error in one browser."""

from __future__ import annotations

import threading

import viser

from lpn.core.files import TYPED, printable


class ErrorNotice:
    """Shows one error at a time, until a person closes it or it is forgotten; thread-safe."""

    def __init__(self, client: viser.ClientHandle) -> None:
        self._client, self._lock = client, threading.Lock()
        self._notification: viser.NotificationHandle | None = None

    def show(self, title: str, text: str) -> None:
        """Show an error in place of the one before."""
        with self._lock:
            self._take_away()
            texts = printable(title, TYPED), printable(text, TYPED)
            self._notification = self._client.add_notification(*texts, color="red", auto_close_seconds=None)

    def forget(self) -> None:
        """Take the last error away: it speaks of something that is over."""
        with self._lock:
            self._take_away()

    def _take_away(self) -> None:
        notification, self._notification = self._notification, None
        if notification is not None:
            notification.remove()
