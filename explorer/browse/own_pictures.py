"""A person's own pictures as queries: one or many at once, held in memory for one browser, never written to disk."""

from __future__ import annotations

import secrets
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import viser

from explorer import session_state, uploads
from explorer.browse.feeds import Feeds
from explorer.browse.messages import MOST, MOST_NAMED, BeginBatch, BrowseMessage, CloseOwn, PickOwn, SkipFile
from explorer.compute.own_photos import OwnPhotoComparisons
from explorer.server.picture_route import EncodedPicture
from explorer.session_state import SessionState, StateChange
from explorer.web.html import Html
from explorer.web.render import call, render, run
from lpn.core import images
from lpn.core.errors import InputError, LPNError
from lpn.core.files import printable
from lpn.drawing import overlays
from lpn.library.analyser import OwnPicture

# A picture is held as JPEG of this quality, unless its own file is small: 200 pictures take some 150 MB.
_QUALITY, _SMALL = 95, 1_000_000
_THUMBNAIL = 64
_NO_PIXELS = np.zeros((0, 0, 3), np.uint8)
# Bytes that the pictures of all browsers of the server take together.
_MOST_BYTES = 1_000_000_000

_REASONS = {
    "large": "has more than 30 MB; make it smaller",
    "kind": f"is not a {uploads.KINDS} file",
    "empty": "is empty",
    "unread": "cannot be read by the browser; check that it is still there and that you may read it",
    "many": f"is beyond the {MOST} pictures that are held; send it later",
}


@dataclass(frozen=True, eq=False)
class _Held:
    """A picture in memory: without its pixels, but with its file and its thumbnail."""

    picture: OwnPicture
    file: bytes
    thumbnail: bytes

    @property
    def size(self) -> int:
        """Bytes in memory."""
        return len(self.file) + len(self.thumbnail)


@dataclass(frozen=True, eq=False)
class HandedOver:
    """One browser's own pictures on their way to its next session.

    Attributes:
        opened: position of the one that was opened last.
        sent: by their keys, the workspace that each was sent at.
        comparisons: of the pictures with the maps of all places that the page has shown.
    """

    pictures: list[_Held]
    opened: int
    sent: dict[str, str]
    comparisons: OwnPhotoComparisons = field(default_factory=OwnPhotoComparisons)


class HeldBytes:
    """The bytes of the pictures of all browsers; thread-safe.

    Attributes:
        total: the bytes that are held now.
    """

    def __init__(self) -> None:
        self.total, self._lock = 0, threading.Lock()

    def add(self, held: _Held) -> None:
        """Count a picture.

        Raises:
            InputError: when it goes beyond the limit; it is not counted then.
        """
        with self._lock:
            if self.total + held.size > _MOST_BYTES:
                raise InputError(
                    f"{held.picture.name} takes {held.size / 1e6:.1f} MB, and the server holds {self.total / 1e6:,.0f} MB of its "
                    f"visitors' pictures; up to {_MOST_BYTES / 1e6:,.0f} MB are held, so close yours, or send it later."
                )
            self.total += held.size

    def remove(self, held: Sequence[_Held]) -> None:
        """Count pictures no longer."""
        with self._lock:
            self.total -= sum(one.size for one in held)


held_bytes = HeldBytes()


class OwnPictures:
    """One browser's own pictures; thread-safe.

    Args:
        change: updates the browser's state with a function.
        notify_error: shows an error with a title and a text.
    """

    def __init__(
        self,
        gui: viser.GuiApi,
        feeds: Feeds,
        change: Callable[[StateChange], None],
        notify_error: Callable[[str, str], None],
        place: str,
    ) -> None:
        self._feeds, self._change, self._notify_error, self._place = feeds, change, notify_error, place
        self._lock = threading.RLock()
        self._held: list[_Held] = []
        # The picture that was opened last, and its position among those held.
        self._opened: tuple[OwnPicture | None, int] = None, -1
        self._refused: list[str] = []
        # Files of the batch in progress that were read, and all of them; the first picture of it.
        self._read = self._files = self._first = 0
        self._asked = 0
        # By the keys of pictures that were held before, the workspace that each was sent at.
        self._sent: dict[str, str] = {}
        # How often the pictures were closed.
        self._closed = 0
        self._left = False
        self._feed: tuple[int, str, str] = -1, "", ""
        self._shell, self._data, self._go = Html(gui), Html(gui), Html(gui)

    def run_scripts_in(self, gui: viser.GuiApi) -> None:
        """Have the page run the scripts in the panel that is being filled: it runs none in a folded panel."""
        self._go = Html(gui)

    def receive(self, message: BrowseMessage) -> None:
        """Do what a message about the user's own pictures asks for."""
        match message:
            case BeginBatch():
                self._begin(message)
            case SkipFile(number, name):
                self._skip(number, name)
            case PickOwn(_, index):
                self._pick(index)
            case CloseOwn():
                self.close()

    def take(self, name: str, content: bytes) -> None:
        """Read an uploaded file; it becomes a query, or is named among those left out."""
        with self._lock:
            in_batch, closed = self._read < self._files, self._closed
        try:
            if len(self._held) >= MOST:
                raise InputError(f"{printable(name)[:80]} {_REASONS['many']}.")
            picture = replace(uploads.read(name, content), key=secrets.token_hex(4))
            held = _hold(picture, content)
            with self._lock:
                if closed != self._closed or self._left:  # it was closed with the others while it was read
                    return
                held_bytes.add(held)
                self._held.append(held)
                if not in_batch:
                    self._opened = picture, len(self._held) - 1
        except LPNError as error:
            if not in_batch:
                self._notify_error("Upload failed", str(error))
                return
            with self._lock:
                if closed != self._closed:
                    return
                self._refused.append(str(error))
        else:
            if not in_batch:
                self._change(lambda state: own_query(state, picture))
        if in_batch:
            self._next()
        self._draw()

    def index_of(self, picture: OwnPicture | None) -> int | None:
        """Return the position of a picture that is shown among those held; None if it is none of them."""
        opened, index = self._opened
        return index if picture is not None and picture is opened else None

    def position(self, picture: OwnPicture | None) -> tuple[int, int] | None:
        """Return the position of a picture that is shown, and how many are held; None if it is none of them."""
        with self._lock:
            index = self.index_of(picture)
            return None if index is None else (index, len(self._held))

    def step(self, state: SessionState, by: int) -> SessionState | None:
        """Return the state of another own picture; None unless one is shown and there are several."""
        with self._lock:
            index = self.index_of(state.upload)
            if index is None or len(self._held) < 2:
                return None
            return own_query(state, self._open((index + by) % len(self._held)))

    @property
    def held(self) -> int:
        """The number of pictures held."""
        return len(self._held)

    @property
    def brought(self) -> bool:
        """True if the picture that `reopen` shows was sent at another workspace."""
        with self._lock:
            shown = self._held[max(self._opened[1], 0)].picture.key if self._held else ""
            return self._sent.get(shown, self._place) != self._place

    def reopen(self, state: SessionState) -> SessionState | None:
        """Return the state of the picture that was opened last; None if none is held."""
        with self._lock:
            return own_query(state, self._open(max(self._opened[1], 0))) if self._held else None

    def find(self, key: str) -> OwnPicture | None:
        """Return the picture that addresses name by a key, decoded; None if it is not held."""
        with self._lock:
            index = next((index for index, held in enumerate(self._held) if held.picture.key == key), None)
            return None if index is None else self._open(index)

    def show(self, state: SessionState) -> None:
        """Mark the picture that the state shows."""
        index = self.index_of(state.upload)
        self._draw(-1 if index is None else index)

    def close(self) -> None:
        """Forget all own pictures; a query of the data set is shown again."""
        with self._lock:
            held_bytes.remove(self._held)
            self._held, self._refused, self._opened = [], [], (None, -1)
            self._read = self._files = 0
            self._closed += 1
        self._change(session_state.leave_upload)
        self._draw()

    def hand_over(self) -> HandedOver:
        """Return the pictures for `take_over`, and hold them no longer: the page is about to show another workspace."""
        with self._lock:
            sent = {held.picture.key: self._sent.get(held.picture.key, self._place) for held in self._held}
            over = HandedOver(self._held, self._opened[1], sent)
            self._held, self._opened, self._closed = [], (None, -1), self._closed + 1
        return over

    def take_over(self, over: HandedOver) -> None:
        """Hold the pictures that the same page had in another workspace, whose bytes are counted already."""
        with self._lock:
            self._held, self._opened = [*over.pictures, *self._held], (None, over.opened)
            self._sent = over.sent
        self._draw(-1)

    def leave(self) -> None:
        """Forget the pictures of a browser that left."""
        with self._lock:
            held_bytes.remove(self._held)
            self._held, self._left = [], True
        self._feeds.leave(self)

    def _begin(self, batch: BeginBatch) -> None:
        """Ask for the first file of a batch."""
        with self._lock:
            room = MOST - len(self._held)
            self._read, self._files, self._first = 0, min(batch.files, room), len(self._held)
            named = [f"{printable(name[:80])} {_REASONS.get(kind, _REASONS['kind'])}." for name, kind in batch.refused]
            if batch.files > room:
                named.append(f"{batch.files - room} pictures are left out: {MOST} are held; close them to send others.")
            if batch.unnamed:
                named.append(f"{batch.unnamed:,} further files are left out.")
            self._refused = named
            asked = self._files > 0
        if asked:
            self._ask()
        else:
            self._finish()
        self._draw()

    def _skip(self, number: int, name: str) -> None:
        """Go on without the file that was asked for, by its number."""
        with self._lock:
            if not number == self._read < self._files:
                return
            self._refused.append(f"{printable(name[:80])} {_REASONS['unread']}.")
        self._next()
        self._draw()

    def _next(self) -> None:
        with self._lock:
            self._read += 1
            more = self._read < self._files
        self._ask() if more else self._finish()

    def _ask(self) -> None:
        """Have the page send the file that comes next."""
        self._asked += 1  # the same call would not be sent again
        self._go.show(run(call("own.go", self._read, self._files, self._asked)))

    def _finish(self) -> None:
        with self._lock:
            # The pictures may have been closed since the last of them was read.
            added, refused = max(len(self._held) - self._first, 0), list(self._refused)
        self._say(added, len(refused))  # first, as it ends the bar, whatever becomes of the picture
        if added:
            self._pick(self._first)
        elif refused:
            self._notify_error(
                "No picture was taken", f"{len(refused)} files were left out; the list is below the button."
            )

    def _say(self, added: int, refused: int) -> None:
        """Tell how a batch ended; the first screen shows neither the list of pictures nor that of those left out."""
        read = "1 picture of your own is read" if added == 1 else f"{added} pictures of your own are read: N and P step"
        left_out = f" {refused} left out: Show everything lists them." if refused else ""
        self._asked += 1
        said = call("say", f"{read}.{left_out}", 8) if added and added + refused > 1 else ""
        self._go.show(run(f"{call('work', 0, 0)};{said};/*{self._asked}*/"))

    def _pick(self, index: int) -> None:
        """Show one of the pictures held, or say why it cannot be shown."""
        try:
            with self._lock:
                picture = self._open(index) if index < len(self._held) else None
        except LPNError as error:
            self._notify_error("Not opened", str(error))
            return
        if picture is not None:
            self._change(lambda state: own_query(state, picture))

    def _open(self, index: int) -> OwnPicture:
        """Decode a picture; only the last one stays decoded."""
        opened, at = self._opened
        if opened is not None and at == index:
            return opened
        held = self._held[index]
        picture = replace(held.picture, picture=images.decode_picture(held.file, held.picture.name))
        self._opened = picture, index
        return picture

    def _draw(self, chosen: int | None = None) -> None:
        with self._lock:
            held, refused = list(self._held), list(self._refused)
            chosen = self._opened[1] if chosen is None else chosen
            if self._feed[0] != len(held):
                rows = self._feeds.publish_list(
                    self,
                    "own",
                    len(held),
                    lambda start, end: [(i, held[i].picture.name, None) for i in range(start, end)],
                )
                self._feed = len(held), rows, self._feeds.publish(self, "own thumbnails", _thumbnails(held))
            _, rows, thumbnails = self._feed
        if not held and not refused:
            self._shell.show("")
            self._data.show("")
            return
        placed = sum(one.picture.place is not None for one in held)
        self._shell.show(render("browse/own", count=len(held), placed=placed, refused=refused, most=MOST_NAMED))
        data = {
            "kind": "queries",
            "task": "own",
            "message": "own-pick",
            "title": "own",
            "address": self._feeds.address,
            "feed": rows,
            "pictures": f"{self._feeds.address}{thumbnails}",
            "total": len(held),
            "chosen": chosen,
            "reveal": True,
            "refused": len(refused),  # the element is another one then
        }
        self._data.show(run(call("list", "lpn-own-queries", data)) if held else "")


def own_query(state: SessionState, picture: OwnPicture) -> SessionState:
    """Return the state that shows a picture of the user's own, upright and compared with its top match."""
    return replace(session_state.upright(state), upload=picture, selected=None)


def _hold(picture: OwnPicture, content: bytes) -> _Held:
    """Return a picture as it is held: as its own file if that is small and was not shrunk, else as JPEG of the size shown."""
    own = len(content) <= _SMALL and max(picture.picture.shape[:2]) < uploads.MAX_SIDE
    file = content if own else images.jpeg(picture.picture, _QUALITY)
    thumbnail = images.jpeg(overlays.square(picture.picture, _THUMBNAIL), 80)
    return _Held(replace(picture, picture=_NO_PIXELS), file, thumbnail)


def _thumbnails(held: Sequence[_Held]) -> Callable[[int], EncodedPicture | None]:
    return lambda index: EncodedPicture(held[index].thumbnail, "image/jpeg") if index < len(held) else None
