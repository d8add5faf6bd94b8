"""The windows of a map that an index holds, so that they need not be described again.

The index may hold each window at several headings (`lpn index --map --turns 8`). A photo whose heading is unknown is then
described once: turned by t degrees against the map, it is compared with windows that are turned by t, too.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from lpn.core.arrays import Float32Array
from lpn.core.errors import InputError
from lpn.core.files import printable
from lpn.descriptors.parallel_inference import describe_each
from lpn.flight.maps import Map, NamedWindow, Window
from lpn.flight.maps.named_window import WindowCut
from lpn.index import Index, open_index
from lpn.models.base import Model, normalise

# Number of windows that are described again, and the least cosine of each with its descriptor in the index. Other ground stays
# below it. Quantized descriptors, positions rounded to a centimetre, and another execution provider stay above it.
_CHECKED = 4
_ALIKE = 0.95
# The least share of the map's windows by which an index counts as whole where the overlap of its windows is only measured.
_WHOLE = 0.9
# About the most windows of a size that are counted for an estimate.
_MOST_ESTIMATED = 10**7
# Windows by which the overlap is measured.
_SAMPLE = 100
# Windows up to which all are compared with each frame; 400 MB of 4 parts of 512 numbers are 50,000.
MOST = 50_000
# The number of windows nearest to one description of a frame that are compared, where an index has more: the most, and the
# fewest for a flight of many frames.
NEAREST, _FEWEST = 500, 20
# Drawn descriptors whose nearest windows tell the sizes that an index holds.
_PROBES, _PROBED = 8, 64


@dataclass(frozen=True, eq=False)
class IndexedWindows:
    """Windows of a map and their descriptors.

    Attributes:
        windows: of the map, north up.
        descriptors: at each of `WindowIndex.turns`, (T, W, n, D) float32.
        notes: sentences about how they were chosen.
    """

    windows: list[Window]
    descriptors: Float32Array
    notes: tuple[str, ...] = ()

    @property
    def overlap(self) -> float:
        """The median share of a window's side that its nearest neighbour of the same size covers, 0 .. 1; 0 without one."""
        places = np.array([(window.x, window.y) for window in self.windows])
        sizes = np.array([window.size for window in self.windows])
        steps = []
        for i in np.linspace(0, len(sizes) - 1, min(len(sizes), _SAMPLE)).astype(np.int64):
            apart = np.linalg.norm(places[sizes == sizes[i]] - places[i], axis=1)
            steps.append(apart[apart > 0].min(initial=sizes[i]) / sizes[i])
        return 1 - float(np.median(steps))


class WindowIndex:
    """An index of a map's windows, from which those are taken that a flight is compared with.

    Of up to 50,000 windows these are all. Of more they are those that are nearest to some frame, 500 for each of its
    descriptions, so that 10^7 windows take a search for each and no more memory than that.

    Args:
        where: the index's folder, or milvus://host:port/collection.

    Attributes:
        sizes: sides of its windows in metres, ascending; of an index that cannot return all, those that some searches return.
        turns: headings at which it holds each window in degrees, from 0 on.

    Raises:
        StoreError: if there is no index, or it holds descriptors of another model.
        InputError: if it is empty, or holds other tiles than windows of this map, evenly turned: some are described again, and
            must be alike.
    """

    def __init__(self, where: str, model: Model, basemap: Map) -> None:
        self._where, self._model, self._map = where, model, basemap
        with open_index(where, model.fingerprint) as index:
            self._count = index.count()
            if not self._count:
                raise InputError("The index holds no window; fill it with lpn index --map, or leave --index out.")
            self._expected = index.expected_windows
            self._all = self._count <= min(MOST, index.most or MOST)
            shape = (1 if self._all else _PROBES, model.n_parts, model.embedding)
            drawn = normalise(np.random.default_rng(0).standard_normal(shape).astype(np.float32))
            found = [index.search(one, None, self._count if self._all else self._most(index, _PROBED)) for one in drawn]
        # A search that misses windows compares nearest ones, too.
        self._every = found[0] if self._all and len(found[0]) == self._count else None
        named = [self._named(one.ids) for one in found]
        self.sizes = sorted({one.size for some in named for one in some})
        self.turns = sorted({one.heading for some in named for one in some})
        # Names round headings to 0.01 degrees.
        if not np.allclose(self.turns, np.arange(len(self.turns)) * 360 / len(self.turns), rtol=0, atol=0.006):
            turned = next(one for some in named for one in some if one.heading == self.turns[-1])
            raise InputError(
                f"The index holds {turned.name} and others, at the headings {', '.join(f'{turn:g}' for turn in self.turns)}; "
                "expected even turns from 0 on, as lpn index --map makes them."
            )
        self._check(named[0], found[0].vectors)

    def near(self, described: Float32Array) -> IndexedWindows:
        """Return the windows to compare with frames.

        Args:
            described: descriptions of frames, (Q, n, D); one of zeros counts for nothing.

        Raises:
            InputError: if there is no description of a frame, and not all windows are taken.
        """
        notes: tuple[str, ...] = ()
        if self._every is not None:
            read = dict(zip(self._every.ids, self._every.vectors, strict=True))
            places = self._places(self._every.ids)
        else:
            places, read = self._nearest(described)
            notes = (
                f"The index holds {self._count:,} windows; photos were compared with the {len(places) * len(self.turns):,} of "
                "them that are nearest to one.",
            )
        names = [[replace(one, heading=turn).name for one in places] for turn in self.turns]
        if missing := sum(name not in read for some in names for name in some):
            raise _unfinished(missing)
        vectors = np.stack([[read[name] for name in some] for some in names])
        found = IndexedWindows(self._on_map(places), vectors.astype(np.float32, copy=False), notes)
        return replace(found, notes=(*notes, *self._partial(found)))

    def _partial(self, found: IndexedWindows) -> list[str]:
        """Return a sentence if the index lacks windows of the map, as far as it is known which ones it should hold."""
        announced = {round(size, 2) for size in self._expected}  # as names round them
        sizes = [size for size in self.sizes if size not in announced]
        others = replace(found, windows=[one for one in found.windows if one.size in sizes])
        estimate = self._estimate(sizes, others.overlap) if others.windows else 0
        if self._every is not None:
            held, whole = self._compared({*self._every.ids})
            lacks, of = held < whole or len(others.windows) < _WHOLE * estimate, "some " * bool(others.windows)
            held, whole = held + len(others.windows), whole + estimate
        else:
            # Windows that were not returned may lie between those that were: the overlap is the least that it may be.
            held, of = self._count // len(self.turns), "at least some " * bool(others.windows)
            pairs = [(size, overlap) for size, overlaps in self._expected.items() for overlap in overlaps]
            whole = estimate + sum(self._map.count_pyramid([size], overlap) for size, overlap in pairs)
            if len(pairs) > len(self._expected) and not of:  # two overlaps share some windows
                of = "some "
            lacks = held < whole * (_WHOLE if of else 1)
        if not lacks:
            return []
        return [
            f"The index holds {held:,} of {of}{whole:,} windows of the map, and no photo is found where it holds none; "
            "if it should hold all, let lpn index --map go on to its end."
        ]

    def _estimate(self, sizes: Sequence[float], overlap: float) -> int:
        """Return the number of the map's windows of a measured overlap, which is lowered where they were too many to count.

        Windows of two overlaps lie closer together than either of them.
        """
        width, height = self._map.sides
        least_step = math.sqrt(width * height / _MOST_ESTIMATED)
        return self._map.count_pyramid(sizes, max(min(overlap, 1 - least_step / min(sizes)), 0.0))

    def _compared(self, names: set[str]) -> tuple[int, int]:
        """Return how many of the announced windows, of each size by its newest overlap, are among names, and of how many."""
        held = whole = 0
        for size, overlaps in self._expected.items():
            whole += (count := self._map.count_pyramid([size], overlaps[-1]))
            if count > len(names):  # windows lack anyway, and those of a county are not named for it
                held += sum(one.size == round(size, 2) and not one.heading for one in self._named(names))
                continue
            for windows in self._map.pyramid_blocks([size], overlaps[-1]):
                held += sum(one.name in names for one in NamedWindow.all_of(windows, self._map.frame))
        return held, whole

    def _nearest(self, described: Float32Array) -> tuple[list[NamedWindow], dict[str, Float32Array]]:
        """Return the windows nearest to descriptions, north up and each once, and the descriptors of all their turns by name."""
        asked = described[np.abs(described).sum(axis=(1, 2)) > 0]
        if not len(asked):
            raise InputError(
                "No photo of the flight can be read, so no window of the index can be near one; check the photos."
            )
        wanted = min(NEAREST, max(_FEWEST, MOST // len(asked)))
        with open_index(self._where, self._model.fingerprint) as index:
            hits = [index.search(one, None, self._most(index, wanted)) for one in asked]
            read = {name: vector for one in hits for name, vector in zip(one.ids, one.vectors, strict=True)}
            places = self._places(read)
            names = [replace(one, heading=turn).name for one in places for turn in self.turns]
            if missing := [name for name in names if name not in read]:
                if not (held := index.holds(missing)).all():
                    raise _unfinished(int((~held).sum()))
                read.update(zip(missing, index.read(missing)[0], strict=True))
        return places, read

    def _most(self, index: Index, wanted: int) -> int:
        return min(wanted, self._count, index.most or wanted)

    def _named(self, names: Iterable[str]) -> list[NamedWindow]:
        named = []
        for name in names:
            if (one := NamedWindow.parse(name)) is None:
                raise InputError(
                    f"The index holds {printable(name)[:80]}, which is no window of a map; make it by lpn index --map."
                )
            named.append(one)
        return named

    def _places(self, names: Iterable[str]) -> list[NamedWindow]:
        """Return the windows of names, north up and each once."""
        upright = (replace(one, heading=0.0) if one.heading else one for one in self._named(names))
        return list(dict.fromkeys(upright))

    def _on_map(self, named: Sequence[NamedWindow]) -> list[Window]:
        places = self._map.frame.xy([one.latitude for one in named], [one.longitude for one in named]).tolist()
        return [Window(x, y, one.size, one.heading) for (x, y), one in zip(places, named, strict=True)]

    def _check(self, named: Sequence[NamedWindow], vectors: Float32Array) -> None:
        """Raise InputError unless some windows that are described again are like those of the index."""
        side, least = max(self._model.input_size), 1.0
        some = sorted({round(i) for i in np.linspace(0, len(named) - 1, _CHECKED)})
        cuts = [WindowCut(self._map, window, side) for window in self._on_map([named[i] for i in some])]
        for batch in describe_each(self._model, cuts, lambda cut: self._model.prepare(cut(), "satellite"), "satellite"):
            for _, error in batch.broken:
                raise error
            cosines = (batch.descriptors * vectors[[some[i] for i in batch.items]]).sum(axis=(1, 2))
            least = min(least, float(cosines.min(initial=1.0)))
        if least < _ALIKE:
            raise InputError(
                f"Windows of {printable(self._map.name)} that were described again have a cosine of {least:.2f} with those of "
                f"the index, and {_ALIKE:.2f} is expected; it is of another map, or the map has changed: make the index again."
            )


def _unfinished(missing: int) -> InputError:
    return InputError(
        f"The index lacks {missing:,} windows at some of its headings; give the command of lpn index --map --turns again, which "
        "adds them."
    )
