"""faiss (the extra `search`), for 10^6 to 10^7 tiles on one machine: a faiss index of the older parts, beside them.

    0000012.faiss     the rows of the oldest parts, in their order; index.json names it and them

faiss proposes candidates by compact codes, and the float32 vectors on disk score them. Tiles that faiss does not propose are
missed. Newer parts are compared exhaustively, until they have more rows than the coded parts: then the codes are learnt anew.
Codes have a byte for each 32 numbers (pq, 64 bytes for 2048), or for each number if their count is no multiple of 32 (sq8).
At 10^6 tiles pq finds as many of the true ten as sq8, and is far quicker.
"""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from typing import Any, cast

import numpy as np
import numpy.typing as npt
from msgspec.structs import replace

from lpn.core.arrays import Float32Array, Int64Array
from lpn.core.errors import StoreError
from lpn.index.base import DegreeBox, DescriptorKind, SearchResult, check_box, check_count
from lpn.index.folder import EngineFile, FolderIndex, IndexManifest, IndexSnapshot, create
from lpn.index.parts import Part, readable, sum_of

# If at most this many tiles are in a box, all are compared, which is as fast and exact.
_FEW = 4096
# Maximum number of training vectors for each list.
_SAMPLE = 64
# Minimum number of training vectors for the codes, if the index has as many.
_LEAST = 16384
_ROUNDS = 10
_ROWS = 16384
_PER_CODE = 32


class FaissIndex(FolderIndex):
    """An approximate index, which may miss tiles.

    Args:
        folder: folder of the index.

    Attributes:
        nprobe: inverted lists to visit; more miss fewer tiles and take longer.
        depth: candidates to score, as a multiple of k.

    Raises:
        StoreError: when the folder is not such an index, or is damaged.
        ModuleNotFoundError: when faiss is not installed.
    """

    engine = "faiss"
    nprobe, depth = 64, 16
    # Up to this many rows are compared exhaustively, without codes.
    plain = 16384

    def __init__(self, folder: str | Path) -> None:
        self._faiss = cast(Any, import_module("faiss"))
        super().__init__(folder)
        # The open faiss index, with its file's name and the identities of its parts.
        self._codes: tuple[object, Any] = None, None

    @classmethod
    def create(cls, folder: str | Path, kind: DescriptorKind) -> FaissIndex:
        """Make an empty index, or open an existing one of the same kind.

        Raises:
            StoreError: when the folder holds something else, or cannot be written.
        """
        import_module("faiss")
        create(Path(folder), IndexManifest(engine=cls.engine, **vars(kind)))
        return cls(folder)

    def search(
        self, query: npt.ArrayLike, weights: npt.ArrayLike | None, k: int, box: DegreeBox | None = None
    ) -> SearchResult:
        """See `Index.search`; ties among the candidates keep the order of insertion."""
        wanted = self.kind.rescaled(query, weights)
        k, box = check_count(k), check_box(box)
        while True:
            state = self._current()
            try:
                proposed = self._proposed(state, wanted.astype(np.float32), k, box)
            except StoreError:
                if self._stamp() == state.stamp:
                    raise
                continue  # another process has learnt new codes, and removed the file
            return self._result(state, proposed, wanted, k)

    def close(self) -> None:
        """See `Index.close`."""
        self._codes = None, None
        super().close()

    def _proposed(self, state: IndexSnapshot, wanted: Float32Array, k: int, box: DegreeBox | None) -> Int64Array:
        """Return the positions of the candidates among all rows."""
        file, depth = state.manifest.codes, max(k * self.depth, k)
        covered = 0 if file is None else len(file.parts)
        rows = [state.chosen(number, box) for number in range(covered)]
        size = sum(part.rows if some is None else len(some) for part, some in zip(state.parts, rows, strict=False))
        if size <= max(_FEW, depth):
            return self._best_of(state, 0, wanted, depth, box)
        assert file is not None
        index = self._opened_codes(state, file)
        selector = None
        if any(some is not None for some in rows):
            mask = np.zeros(state.starts[covered], np.uint8)
            for start, part, some in zip(state.starts.tolist(), state.parts, rows, strict=False):
                mask[start : start + part.rows] = 1 if some is None else np.isin(np.arange(part.rows), some)
            selector = self._faiss.IDSelectorBitmap(np.packbits(mask, bitorder="little"))
        nprobe = min(self.nprobe, index.nlist)
        while True:
            found = index.search(
                wanted[None], min(size, depth), params=self._faiss.SearchParametersIVF(sel=selector, nprobe=nprobe)
            )[1][0]
            found = found[found >= 0]
            # With a box, the visited lists may hold fewer than k tiles.
            if len(found) >= min(k, size) or nprobe == index.nlist:
                return np.concatenate([found, self._best_of(state, covered, wanted, depth, box)])
            nprobe = min(2 * nprobe, index.nlist)

    def _best_of(
        self, state: IndexSnapshot, first: int, wanted: Float32Array, depth: int, box: DegreeBox | None
    ) -> Int64Array:
        """Return the best rows of the parts from `first` on; single precision reorders only ties in its last digits."""
        places, scores = state.scores(range(first, len(state.parts)), wanted, box)
        return places if len(places) <= depth else places[np.argpartition(scores, len(places) - depth)[-depth:]]

    def _opened_codes(self, state: IndexSnapshot, file: EngineFile) -> Any:
        which = file.name, *(part.identity for part in state.parts[: len(file.parts)])
        opened, index = self._codes
        if opened == which:
            return index
        path = self.folder / file.name
        with readable(path):
            path.open("rb").close()
            try:
                index = self._faiss.read_index(str(path), self._faiss.IO_FLAG_MMAP)
            except RuntimeError as error:
                raise ValueError("faiss cannot read it") from error
        index.parallel_mode = 1  # threads share the lists of one query
        self._codes = which, index
        return index

    def _with_engine_file(self, manifest: IndexManifest) -> IndexManifest:
        """Learn the codes of all parts if more rows lack codes than have them."""
        covered = 0 if manifest.codes is None else len(manifest.codes.parts)
        old, new = (sum(part.rows for part in some) for some in (manifest.parts[:covered], manifest.parts[covered:]))
        if new <= max(self.plain, old):
            return manifest
        parts = tuple(part for part in manifest.parts if part.replaced < part.rows)
        name = f"{manifest.next:07d}.faiss"
        file = self.folder / name
        self._learn([Part(self.folder / part.name, self.kind, part.rows).vectors for part in parts], file)
        codes = EngineFile(name, tuple(part.name for part in parts), sum_of(file))
        return replace(manifest, parts=parts, codes=codes, next=manifest.next + 1)

    def _learn(self, parts: list[Float32Array], file: Path) -> None:
        """Train lists and codes on a sample of all vectors, and write the faiss index."""
        starts = np.cumsum([0, *map(len, parts)])
        rows = int(starts[-1])
        # About sqrt(N) lists. "np" skips the sorting of codes for polysemous filtering, which is unused and slow.
        codes = "SQ8" if self.kind.numbers % _PER_CODE else f"PQ{self.kind.numbers // _PER_CODE}np"
        name = f"IVF{max(1, round(rows**0.5))},{codes}"
        index = self._faiss.index_factory(self.kind.numbers, name, self._faiss.METRIC_INNER_PRODUCT)
        for learner in [index.cp] if codes == "SQ8" else [index.cp, index.pq.cp]:
            learner.niter, learner.max_points_per_centroid, learner.min_points_per_centroid = _ROUNDS, _SAMPLE, 1
        sample = np.sort(np.random.default_rng(0).permutation(rows)[: max(_SAMPLE * index.nlist, _LEAST)])
        bounds = np.searchsorted(sample, starts)
        chosen = [part[sample[a:b] - at] for part, at, a, b in zip(parts, starts, bounds, bounds[1:], strict=False)]
        index.train(np.concatenate(chosen))
        for part in parts:
            for start in range(0, len(part), _ROWS):
                index.add(np.ascontiguousarray(part[start : start + _ROWS]))
        try:
            self._faiss.write_index(index, str(file))
        except RuntimeError as error:
            raise StoreError(f"{file} cannot be written; free space or choose another folder.") from error
