"""faiss (the extra `search`), for 10^6 to 10^7 tiles on one machine: a faiss index beside the vectors of each larger segment.

    faiss.index     in a segment's folder, with its rows in the segment's order

faiss proposes candidates by compact codes, and the float32 vectors on disk score them. Tiles that faiss does not propose are
missed. `nprobe` and `depth` trade misses for time, and can be changed at any search.

    flat        float32 vectors: the only misses are ties at the `depth`-th candidate within faiss's rounding
    sq8         inverted lists with a byte for each number
    pq          inverted lists with a byte for each 32 numbers: 64 bytes for 2048
"""

from __future__ import annotations

from collections.abc import Sequence
from importlib import import_module
from pathlib import Path
from typing import Any, Literal, cast, get_args

import numpy as np
import numpy.typing as npt

from lpn.core.arrays import Float32Array, Int64Array
from lpn.core.errors import InputError, StoreError
from lpn.core.files import unreadable_error
from lpn.index.base import DegreeBox, DescriptorKind, SearchResult, check_box, check_count
from lpn.index.folder import FolderIndex, IndexManifest, IndexSnapshot, create
from lpn.index.segments import Segment

Codes = Literal["flat", "sq8", "pq"]

FILE = "faiss.index"
# If at most this many tiles of a segment are in a box, all are compared, which is as fast and exact.
_FEW = 4096
# Maximum number of training vectors for each list.
_SAMPLE = 64
# Minimum number of training vectors for the codes, if the segment has as many.
_LEAST = 16384
_ROUNDS = 10
_ROWS = 16384
_PER_CODE = 32


class FaissIndex(FolderIndex):
    """An approximate index, which may miss tiles.

    Args:
        folder: folder of the index.
        nprobe: inverted lists to visit; more miss fewer tiles and take longer.
        depth: candidates to score, as a multiple of k.

    Raises:
        StoreError: when the folder is not such an index, or is damaged.
        ModuleNotFoundError: when faiss is not installed.
    """

    engine = "faiss"
    max_segment_bytes = 8 << 30
    engine_file = FILE
    # The newest segments have no faiss index and are compared exhaustively, up to this many tiles in all: training takes as long
    # for few tiles as for many, too long for every small add.
    plain = 16384

    def __init__(self, folder: str | Path, nprobe: int = 64, depth: int = 16) -> None:
        self._faiss = cast(Any, import_module("faiss"))
        self.nprobe, self.depth = check_count(nprobe, "number of lists looked through"), check_count(depth, "depth")
        super().__init__(folder)
        self.codes = cast(Codes, self._state.manifest.settings["codes"])
        self._lists = self.codes != "flat"
        self._opened: dict[tuple[Path, tuple[int, int]], Any] = {}

    @classmethod
    def create(
        cls, folder: str | Path, kind: DescriptorKind, codes: Codes | None = None, nprobe: int = 64, depth: int = 16
    ) -> FaissIndex:
        """Make an empty index, or open an existing one of the same kind.

        Args:
            codes: by default pq, which at 10^6 tiles finds as many of the true ten as sq8 and is far quicker; sq8 if the length
                of a descriptor is not a multiple of 32.

        Raises:
            StoreError: when the folder holds something else, or cannot be written.
        """
        import_module("faiss")
        codes = codes or ("sq8" if kind.numbers % _PER_CODE else "pq")
        if codes not in get_args(Codes):
            raise InputError(f"The codes are {codes!r}; expected one of {', '.join(get_args(Codes))}.")
        if codes == "pq" and kind.numbers % _PER_CODE:
            raise InputError(
                f"A descriptor has {kind.numbers} numbers, which are no multiple of {_PER_CODE}; choose the codes sq8."
            )
        create(Path(folder), IndexManifest(engine=cls.engine, **vars(kind), settings={"codes": codes}))
        return cls(folder, nprobe, depth)

    def search(
        self, query: npt.ArrayLike, weights: npt.ArrayLike | None, k: int, box: DegreeBox | None = None
    ) -> SearchResult:
        """See `Index.search`; ties among the candidates keep the order of insertion."""
        wanted = self.kind.rescaled(query, weights)
        k, box = check_count(k), check_box(box)
        while True:
            state = self._current()
            try:
                places = self._places(state, wanted.astype(np.float32), k, box)
            except _ReplacedError:
                continue
            return self._result(state.segments, places, wanted, k)

    def close(self) -> None:
        """See `Index.close`."""
        self._opened.clear()
        super().close()

    def _places(self, state: IndexSnapshot, wanted: Float32Array, k: int, box: DegreeBox | None) -> Int64Array:
        """Return the places of the candidates among the rows of all segments."""
        proposed: list[Int64Array] = [np.zeros(0, np.int64)]
        start = 0
        for segment in state.segments:
            proposed.append(self._proposed(state, segment, wanted, segment.chosen(box), k) + start)
            start += segment.rows
        return np.concatenate(proposed)

    def _proposed(
        self,
        state: IndexSnapshot,
        segment: Segment,
        wanted: Float32Array,
        rows: Int64Array | None,
        k: int,
    ) -> Int64Array:
        """Return the candidate rows of one segment."""
        size = segment.rows if rows is None else len(rows)
        depth = min(size, max(k * self.depth, k))
        if segment.rows <= self.plain or size <= max(_FEW, depth):
            # Single precision reorders only ties in its last digits.
            scores = (segment.in_order if rows is None else segment.vectors[rows]) @ wanted
            first = np.argpartition(scores, size - depth)[size - depth :] if depth < size else np.arange(size)
            return first if rows is None else rows[first]
        index = self._index(state, segment)
        lists = index.nlist if self._lists else 1
        nprobe = min(self.nprobe, lists)
        while True:
            proposed = index.search(wanted[None], depth, params=self._parameters(segment, rows, nprobe))[1][0]
            proposed = proposed[proposed >= 0]
            # With a box, the visited lists may hold fewer than k tiles.
            if len(proposed) >= min(k, size) or nprobe == lists:
                return cast(Int64Array, proposed)
            nprobe = min(2 * nprobe, lists)

    def _parameters(self, segment: Segment, rows: Int64Array | None, nprobe: int) -> Any:
        selector = None
        if rows is not None:
            mask = np.zeros(segment.rows, np.uint8)
            mask[rows] = 1
            selector = self._faiss.IDSelectorBitmap(np.packbits(mask, bitorder="little"))
        if self._lists:
            return self._faiss.SearchParametersIVF(sel=selector, nprobe=nprobe)
        return self._faiss.SearchParameters(sel=selector)

    def _index(self, state: IndexSnapshot, segment: Segment) -> Any:
        """Open the faiss index of a segment of a snapshot, which other threads may have replaced since."""
        this = segment.folder, segment.identity
        opened = self._opened
        if this in opened:
            return opened[this]
        there = {(one.folder, one.identity) for one in state.segments}
        opened = self._opened = {which: one for which, one in opened.items() if which in there}
        file = segment.folder / FILE
        try:
            index = self._faiss.read_index(str(file), self._faiss.IO_FLAG_MMAP if self._lists else 0)
            if self._lists:
                index.parallel_mode = 1  # threads share the lists of one query
        except RuntimeError as error:
            if self._stamp() != state.stamp:
                raise _ReplacedError from error
            try:
                file.open("rb").close()
            except FileNotFoundError:
                pass
            except OSError as why:
                raise unreadable_error(file, why) from error
            raise StoreError(
                f"{FILE} in {segment.folder} is missing or damaged; delete the index and make it again."
            ) from error
        self._opened = opened | {this: index}
        return index

    def _plan_merge(self, sizes: Sequence[int], rows: int) -> tuple[int, int]:
        plain = len(sizes)
        while plain and sizes[plain - 1] <= self.plain:
            plain -= 1
        last = sum(sizes[plain:])
        if last + rows <= self.plain:
            unmerged, rows = super()._plan_merge(sizes[plain:], rows)
            return plain + unmerged, rows
        return super()._plan_merge(sizes[:plain], last + rows)

    def _finish(self, folder: Path, rows: int) -> None:
        """Train lists and codes on a sample of a segment's vectors, and write the faiss index."""
        if rows <= self.plain:
            return
        vectors = np.load(folder / "vectors.npy", mmap_mode="r")
        name = _factory(self.codes, rows, self.kind)
        index = self._faiss.index_factory(self.kind.numbers, name, self._faiss.METRIC_INNER_PRODUCT)
        if self._lists:
            learners = [index.cp] if self.codes == "sq8" else [index.cp, index.pq.cp]
            for learner in learners:
                learner.niter, learner.max_points_per_centroid, learner.min_points_per_centroid = _ROUNDS, _SAMPLE, 1
            sample = np.random.default_rng(0).permutation(rows)[: max(_SAMPLE * index.nlist, _LEAST)]
            index.train(np.ascontiguousarray(vectors[np.sort(sample)]))
        for start in range(0, rows, _ROWS):
            index.add(np.ascontiguousarray(vectors[start : start + _ROWS]))
        try:
            self._faiss.write_index(index, str(folder / FILE))
        except RuntimeError as error:
            raise StoreError(f"{folder / FILE} cannot be written; free space or choose another folder.") from error


class _ReplacedError(Exception):
    """Another process has merged a segment into a new one since the manifest was read."""


def _factory(codes: Codes, rows: int, kind: DescriptorKind) -> str:
    """Return the faiss factory string: about sqrt(N) inverted lists, or none."""
    if codes == "flat":
        return "Flat"
    lists = max(1, round(rows**0.5))
    # "np" skips the sorting of codes for polysemous filtering, which is unused and slow.
    return f"IVF{lists},SQ8" if codes == "sq8" else f"IVF{lists},PQ{kind.numbers // _PER_CODE}np"
