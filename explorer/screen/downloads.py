"""Slow files: a tab makes one of each kind at a time, and notes show the progress; the browser saves the file."""

from __future__ import annotations

from collections.abc import Callable

from explorer.compute.background_jobs import BackgroundJob, ReportProgress, WorkCancelledError
from explorer.feeds import Feeds
from explorer.screen.loop import ScreenMessage
from lpn.core.errors import LPNError

# Makes a file while it reports its progress, and returns the file's name and contents.
MakeFile = Callable[[ReportProgress], tuple[str, bytes]]


class Downloads:
    """The files of one tab.

    Args:
        send: hands a message to the page.
    """

    def __init__(self, send: Callable[[ScreenMessage], None]) -> None:
        self._send = send
        # The files in progress, and the last job of each kind, by title.
        self._making: set[str] = set()
        self._jobs: dict[str, BackgroundJob[None]] = {}

    def make(self, title: str, make: MakeFile, feeds: Feeds, owner: object) -> None:
        """Begin a file, or cancel the file of its kind that is in progress.

        Args:
            title: the file's kind in the notes, such as "Report".
            feeds: serves the file.
            owner: the owner of the feed.
        """
        if title in self._making:
            self._jobs[title].leave(self)
            return
        self._making.add(title)
        self._jobs[title] = BackgroundJob(lambda report: self._make(title, make, report, feeds, owner), self)

    def close(self) -> None:
        """Cancel all files in progress."""
        for job in self._jobs.values():
            job.leave(self)

    def _make(self, title: str, make: MakeFile, report: ReportProgress, feeds: Feeds, owner: object) -> None:
        def note(done: int, total: int) -> None:
            report(done, total)
            count = f"{done:,} of {total:,}" if total else "begun"
            self._send({"note": f"{title}: {count}. Choose it again to cancel."})

        try:
            note(0, 0)
            name, content = make(note)
        except Exception as error:
            text = f"{title}: it failed; the server's log has the details."
            if isinstance(error, (LPNError, WorkCancelledError)):
                text = str(error) or f"{title}: cancelled."
            self._making.discard(title)  # before the note: its reader may begin another file
            self._send({"note": text})
            raise
        address = feeds.address + feeds.publish_bytes(owner, "file", lambda: content) + "0"
        self._making.discard(title)
        self._send({"download": {"address": address, "name": name}})
        self._send({"note": f"The browser saves {name}."})
