"""Complete folders of shards, as `lpn.shards` writes them: read tile by tile, or gathered into a store. Needs the extra `ray`."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import pyarrow.parquet as pq

from lpn.errors import StoreError
from lpn.features import Manifest, Row, Store
from lpn.features.describing import write_store
from lpn.features.unfinished import Unfinished
from lpn.model import FloatArray
from lpn.shards import AT_ONCE, BROKEN, DAMAGED, PLAN, Broken, Contents, Plan, read_notes, read_shard, shard_name
from lpn.storage import Storage


class Tiles(NamedTuple):
    """The pictures of one partition.

    Attributes:
        names: below the described folder, with forward slashes.
        positions: latitude and longitude in degrees, (B, 2) float64, NaN where a picture has none.
    """

    names: list[str]
    positions: npt.NDArray[np.float64]


@dataclass(frozen=True)
class Shards:
    """A complete folder of shards; each picture is in one partition, and there once.

    Attributes:
        storage: where they are.
        plan: what they hold.
        broken: the pictures that could not be described, which `broken.csv` names.
    """

    storage: Storage
    plan: Plan
    broken: list[Broken]

    def tiles(self) -> list[Tiles]:
        """The names and positions of each partition, without reading descriptors; StoreError when a shard is damaged."""
        with ThreadPoolExecutor(AT_ONCE) as pool:
            return list(pool.map(self._tiles, range(self.plan.partitions)))

    def descriptors(self, partition: int, names: Sequence[str]) -> FloatArray:
        """A partition's descriptors, (B, n, D) float32.

        Args:
            names: of its pictures, as `tiles` gave them.

        Raises:
            StoreError: when the shard is damaged, or holds other pictures by now.
        """
        contents = self.read(partition)
        if [item.row.file for item in contents.items] != list(names):
            raise StoreError(
                f"{shard_name(partition)} in {self.storage.where} was written anew while it was read; run this again when lpn "
                "describe has ended."
            )
        return contents.descriptors.astype(np.float32)

    def read(self, partition: int) -> Contents:
        """A whole shard; StoreError when it is damaged."""
        contents = read_shard(self.storage, self.plan, partition)
        if contents is None:
            raise self._damaged(partition)
        return contents

    def _tiles(self, partition: int) -> Tiles:
        columns = ["file", "latitude", "longitude"]
        try:
            with self.storage.open(shard_name(partition)) as file:
                table = pq.read_table(file, columns=columns, page_checksum_verification=True)
            names, *degrees = (table.column(name) for name in columns)
            positions = np.stack([column.to_numpy().astype(np.float64) for column in degrees], axis=1)
            return Tiles(names.to_pylist(), positions)
        except DAMAGED as error:
            raise self._damaged(partition) from error

    def _damaged(self, partition: int) -> StoreError:
        return StoreError(
            f"{shard_name(partition)} in {self.storage.where} is damaged; run lpn describe --engine ray again, which computes it."
        )


def open_shards(where: str | Path) -> Shards:
    """A complete folder of shards.

    Raises:
        StoreError: when there is none, a shard is missing, or the run that wrote it has not ended.
    """
    storage = Storage(where)
    plan = Plan.read(storage)
    if plan is None:
        raise StoreError(
            f"{where} has no {PLAN}, so it is no folder of shards; write them with lpn describe --engine ray."
        )
    notes = read_notes(storage, plan, range(plan.partitions))
    there = [one for one in notes if one is not None]
    if len(there) < plan.partitions:
        raise StoreError(
            f"{plan.partitions - len(there)} of {plan.partitions} shards in {where} are missing or damaged; run lpn describe "
            "--engine ray again, which computes only those."
        )
    if not plan.finished:
        raise StoreError(
            f"The shards in {where} may be of pictures old and new, as the run that wrote them has not ended; wait for it, or "
            "run lpn describe --engine ray again, which computes only what is missing."
        )
    return Shards(storage, plan, [broken for one in there for broken in one.broken])


def to_store(shards: Shards, out: str | Path) -> Store:
    """Shards as a store of descriptors on this machine, in order of the pictures' names; a store has no positions.

    The store is what `lpn.features.describe` makes of the same pictures, so it can be gone on with there.

    Raises:
        StoreError: when a shard is damaged, or `out` cannot be written or holds something else.
    """
    plan = shards.plan
    rows: list[Row] = []
    for partition in range(plan.partitions):
        rows += [item.row for item in shards.read(partition).items]
    if not rows:
        raise StoreError(f"The shards in {shards.storage.where} hold no picture, all being broken; see {BROKEN} there.")
    rows.sort(key=lambda row: row.file.split("/"))
    position = {row.file: i for i, row in enumerate(rows)}
    manifest = Manifest(plan.fingerprint, plan.view, 0.0, plan.n_parts, plan.embedding, tuple(rows), plan.precision)

    def fill(unfinished: Unfinished) -> None:
        for partition in range(plan.partitions):
            contents = shards.read(partition)
            if contents.items:
                places = [position[item.row.file] for item in contents.items]
                unfinished.put(places, contents.descriptors.astype(np.float32))

    return write_store(Path(out), manifest, fill)
