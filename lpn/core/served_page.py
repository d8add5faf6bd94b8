"""A page that this process serves, for notebooks and scripts."""

from __future__ import annotations

import atexit
import threading
from collections.abc import Callable
from typing import Self

from markupsafe import Markup

# Height of the page in a notebook's cell, in CSS pixels.
HEIGHT = 760
_LINK = Markup('<a href="{0}" target="_blank" rel="noopener">{0}</a>')
_FRAME = Markup('<iframe src="{}" title="LPN Explorer" style="width: 100%; height: {}px; border: 0"></iframe>')


class ServedPage:
    """A page that this process serves until it is closed, or the process ends.

    A notebook shows the page as the value of a cell. As a context manager, it closes the page at the end of the block.

    Args:
        url: the address for a browser.
        close: ends the server.
        framed: whether other pages of this machine, such as a notebook, may show it; otherwise a cell has a link.
    """

    def __init__(self, url: str, close: Callable[[], None], framed: bool = True) -> None:
        self.url, self._end, self._framed = url, close, framed
        self._closed = threading.Event()
        atexit.register(self.close)

    @property
    def closed(self) -> bool:
        """True once the page is closed."""
        return self._closed.is_set()

    def close(self) -> None:
        """End the server; a second call does nothing."""
        if not self.closed:
            self._closed.set()
            atexit.unregister(self.close)
            self._end()

    def wait(self) -> None:
        """Print the address, and wait until the page is closed, or Ctrl-C closes it; for scripts."""
        print(f"LPN Explorer is ready: {self.url}  (stop with Ctrl-C)", flush=True)
        try:
            while not self._closed.wait(3600):
                pass
        except KeyboardInterrupt:
            self.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __repr__(self) -> str:
        return f"<LPN Explorer {'closed' if self.closed else f'at {self.url}'}>"

    def _repr_html_(self) -> str:
        if self.closed:
            return "<p>This LPN Explorer is closed.</p>"
        link = _LINK.format(self.url)
        if not self._framed:
            return str(Markup("<p>LPN Explorer: {}</p>").format(link))
        frame = _FRAME.format(self.url, HEIGHT)
        return str(Markup("{}<p>LPN Explorer in a tab of its own: {}</p>").format(frame, link))

    def _repr_mimebundle_(self, **_: object) -> dict[str, str]:
        return {"text/html": self._repr_html_(), "text/plain": repr(self)}
