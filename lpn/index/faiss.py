"""faiss (the extra `search`), for 10^6 to 10^7 tiles on one machine: a faiss index of the older parts, beside them.

faiss proposes candidates by compact codes, and the float32 vectors on disk score them. Tiles that faiss does not propose are
missed. Newer parts are compared exhaustively, until they have more rows than the coded parts: then the codes are learnt anew.
Codes have a byte for each 32 numbers (pq, 64 bytes for 2048), or for each number if their count is no multiple of 32 (sq8).
At 10^6 tiles pq finds as many of the ten nearest tiles as sq8, and is far quicker.
"""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from typing import Any, cast

import msgspec
import numpy as np

from lpn.core.arrays import Float32Array, Float64Array, Int64Array
from lpn.core.errors import StoreError
from lpn.descriptors.store import CodesEntry, DescriptorKind, Manifest, Part, Store, readable, sum_of
from lpn.index.base import DegreeBox
from lpn.index.folder import FolderIndex, chosen_rows, scored

# If at most this many tiles are in a box, all are compared, which is as fast, and exact.
_FEW = 4096
# Maximum number of training vectors for each list, and minimum for the codes, if the index has as many.
_SAMPLE, _LEAST = 64, 16384
_ROUNDS = 10
_ROWS = 16384
_PER_CODE = 32


class FaissIndex(FolderIndex):
    """An approximate index of a folder, which may miss tiles.

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
        # The open faiss index, and its file's name.
        self._codes: tuple[str, Any] = "", None
        super().__init__(folder)

    @classmethod
    def create(cls, folder: str | Path, kind: DescriptorKind) -> FaissIndex:
        """See `FolderIndex.create`."""
        import_module("faiss")
        return super().create(folder, kind)

    def close(self) -> None:
        """See `Index.close`."""
        self._codes = "", None
        super().close()

    def _candidates(self, store: Store, wanted: Float64Array, k: int, box: DegreeBox | None) -> Int64Array:
        codes, depth = store.manifest.codes, max(k * self.depth, k)
        covered = 0 if codes is None else len(codes.parts)
        rows = [chosen_rows(store, number, box) for number in range(covered)]
        size = sum(
            len(part.vectors) if some is None else len(some) for part, some in zip(store.parts, rows, strict=False)
        )
        if codes is None or size <= max(_FEW, depth):
            return _best(store, 0, wanted, depth, box)
        index = self._opened(codes)
        selector = None
        if any(some is not None for some in rows):
            mask = np.zeros(store.starts[covered], np.uint8)
            for start, part, some in zip(store.starts.tolist(), store.parts, rows, strict=False):
                mask[start + (np.arange(len(part.vectors)) if some is None else some)] = 1
            selector = self._faiss.IDSelectorBitmap(np.packbits(mask, bitorder="little"))
        nprobe = min(self.nprobe, index.nlist)
        while True:
            params = self._faiss.SearchParametersIVF(sel=selector, nprobe=nprobe)
            found = index.search(wanted.astype(np.float32)[None], min(size, depth), params=params)[1][0]
            found = found[found >= 0]
            # With a box, the visited lists may hold fewer than k tiles.
            if len(found) >= min(k, size) or nprobe == index.nlist:
                return np.concatenate([found, _best(store, covered, wanted, depth, box)])
            nprobe = min(2 * nprobe, index.nlist)

    def _opened(self, codes: CodesEntry) -> Any:
        if self._codes[0] != codes.name:
            path = self.folder / codes.name
            with readable(path):
                path.open("rb").close()
                try:
                    index = self._faiss.read_index(str(path), self._faiss.IO_FLAG_MMAP)
                except RuntimeError as error:
                    raise ValueError("faiss cannot read it") from error
            index.parallel_mode = 1  # threads share the lists of one query
            self._codes = codes.name, index
        return self._codes[1]

    def _with_codes(self, manifest: Manifest) -> Manifest:
        """Learn the codes of all parts if more rows lack codes than have them."""
        covered = 0 if manifest.codes is None else len(manifest.codes.parts)
        old, new = (sum(part.rows for part in some) for some in (manifest.parts[:covered], manifest.parts[covered:]))
        if new <= max(self.plain, old):
            return manifest
        parts = tuple(part for part in manifest.parts if len(part.replaced) < part.rows)
        file = self.folder / f"{parts[-1].name}.faiss"
        self._learn([Part.open(self.folder / part.name, self.kind, part.rows).vectors for part in parts], file)
        codes = CodesEntry(file.name, tuple(part.name for part in parts), sum_of(file))
        return msgspec.structs.replace(manifest, parts=parts, codes=codes)

    def _learn(self, vectors: list[Float32Array], file: Path) -> None:
        """Train lists and codes on a sample of all vectors, and write the faiss index."""
        parts = [one.reshape(len(one), -1) for one in vectors]
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
            file.unlink(missing_ok=True)
            raise StoreError(f"{file} cannot be written; free space or choose another folder.") from error


def _best(store: Store, first: int, wanted: Float64Array, depth: int, box: DegreeBox | None) -> Int64Array:
    """Return the best rows of the parts from `first` on; scores that differ only in the last digits may change places."""
    places, scores = scored(store, range(first, len(store.parts)), wanted, box)
    return places if len(places) <= depth else places[np.argpartition(scores, len(places) - depth)[-depth:]]
