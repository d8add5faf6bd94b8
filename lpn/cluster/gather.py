"""Reading complete folders of shards: tile by tile, or gathered into a store. Needs the extra `cluster`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from lpn.cluster.shards import (
    BROKEN,
    DAMAGED,
    ITEM,
    PLAN,
    FailedPicture,
    Plan,
    ShardContents,
    ShardItem,
    ShardMetadata,
    contents,
    each,
    items_of,
    notes_of,
    read_notes,
    read_shard,
    shard_name,
)
from lpn.cluster.storage import Storage
from lpn.core.arrays import Float32Array, Float64Array
from lpn.core.errors import StoreError
from lpn.descriptors import Manifest, Store
from lpn.descriptors.partial_store import PartialStore
from lpn.descriptors.writer import write_store


class ShardTiles(NamedTuple):
    """The tiles of one partition.

    Attributes:
        names: below the described folder, with forward slashes.
        positions: latitude and longitude in degrees, (B, 2) float64, NaN for a tile without a position.
    """

    names: list[str]
    positions: Float64Array


@dataclass(frozen=True)
class Shards:
    """A complete folder of shards; each picture is in exactly one partition.

    Readers refuse a shard that a later run has rewritten, so that everything read is of one state of the pictures.

    Attributes:
        storage: the folder or prefix.
        plan: the contents of plan.json.
        broken: the pictures that could not be described, also listed in `broken.csv`.
        digests: digest of the pictures of each partition.
    """

    storage: Storage
    plan: Plan
    broken: list[FailedPicture]
    digests: list[str]

    def tiles(self, partition: int) -> ShardTiles:
        """Read a partition's names and positions without its descriptors.

        Raises:
            StoreError: when the shard is damaged, was rewritten, or holds pictures of another partition.
        """
        table = self._table(partition, ["file", "latitude", "longitude"])
        try:
            names: list[str] = table.column("file").to_pylist()
            degrees = [table.column(name).to_numpy().astype(np.float64) for name in ("latitude", "longitude")]
            elsewhere = any(self.plan.partition(name) != partition for name in names)
        except DAMAGED as error:
            raise self._damaged(partition) from error
        if elsewhere:
            raise StoreError(
                f"{shard_name(partition)} in {self.storage.where} holds pictures that belong in other shards; delete it and run "
                "lpn describe --engine ray again, which computes it."
            )
        return ShardTiles(names, np.stack(degrees, axis=1))

    def items(self, partition: int) -> list[ShardItem]:
        """Read a partition's pictures in the order of its descriptors, without these; StoreError as for `read`."""
        try:
            return items_of(self._table(partition, list(ITEM)))
        except DAMAGED as error:
            raise self._damaged(partition) from error

    def descriptors(self, partition: int, names: Sequence[str]) -> Float32Array:
        """Read a partition's descriptors, (B, n, D) float32.

        Args:
            names: of its pictures, from `tiles`.

        Raises:
            StoreError: as for `read`.
        """
        contents = self.read(partition)
        if [item.row.file for item in contents.items] != list(names):
            raise self.written_anew(partition)
        return contents.descriptors.astype(np.float32)

    def read(self, partition: int) -> ShardContents:
        """Read a whole shard; StoreError when it is damaged, or was rewritten since the folder was opened."""
        contents = read_shard(self.storage, self.plan, partition)
        self._check(partition, None if contents is None else contents.notes)
        assert contents is not None
        return contents

    def written_anew(self, partition: int) -> StoreError:
        """Make the error about a shard that was rewritten."""
        return StoreError(_anew(self.storage, shard_name(partition)))

    def _table(self, partition: int, columns: list[str]) -> pa.Table:
        try:
            with self.storage.open(shard_name(partition)) as file:
                table = pq.read_table(file, columns=columns, page_checksum_verification=True)
            notes = notes_of(table.schema, self.plan, partition)
        except DAMAGED as error:
            raise self._damaged(partition) from error
        self._check(partition, notes)
        return table

    def _check(self, partition: int, notes: ShardMetadata | None) -> None:
        if notes is None:
            raise self._damaged(partition)
        if notes.digest != self.digests[partition]:
            raise self.written_anew(partition)

    def _damaged(self, partition: int) -> StoreError:
        return StoreError(
            f"{shard_name(partition)} in {self.storage.where} is damaged; run lpn describe --engine ray again, which computes it."
        )


def open_shards(where: str | Path) -> Shards:
    """Open a complete folder of shards.

    Raises:
        StoreError: when there is none, a shard is missing or not of the last finished run, or a run is unfinished or began
            meanwhile.
    """
    storage = Storage(where)
    plan = _plan(storage)
    notes = read_notes(storage, plan, range(plan.partitions))
    there = [one for one in notes if one is not None]
    if len(there) < plan.partitions:
        raise StoreError(
            f"{plan.partitions - len(there)} of {plan.partitions} shards in {where} are missing or damaged; run lpn describe "
            "--engine ray again, which computes only those."
        )
    # A run may have begun since the plan was read, and even finished.
    again = _plan(storage)
    if not plan.finished or not again.finished:
        raise StoreError(
            f"The shards in {where} may be of different states of the pictures, as their run has not ended; wait for it, or "
            "run lpn describe --engine ray again, which computes only what is missing."
        )
    if again.to_json() != plan.to_json():
        raise StoreError(_anew(storage, "A shard"))
    if plan.contents not in (None, contents(there)) or any(one.partitions != plan.partitions for one in there):
        raise StoreError(
            f"The shards in {where} are not all those of the run that ended last, as of two runs at once; run lpn describe "
            "--engine ray again, which computes only what is missing."
        )
    return Shards(storage, plan, [broken for one in there for broken in one.broken], [one.digest for one in there])


def to_store(shards: Shards, out: str | Path) -> Store:
    """Gather shards into a store of descriptors on this machine, in order of the pictures' names and without positions.

    The store equals that of `lpn.descriptors.describe` for the same pictures, so that can continue it.

    Raises:
        StoreError: when a shard is damaged or was rewritten, or `out` cannot be written or holds something else.
    """
    plan = shards.plan
    partitions = range(plan.partitions)
    rows = [item.row for items in each(shards.items, partitions) for item in items]
    if not rows:
        raise StoreError(f"The shards in {shards.storage.where} hold no picture, all being broken; see {BROKEN} there.")
    rows.sort(key=lambda row: row.file.split("/"))
    position = {row: i for i, row in enumerate(rows)}
    size = plan.n_parts, plan.embedding
    manifest = Manifest(plan.fingerprint, plan.view, 0.0, *size, tuple(rows), plan.precision, role=plan.role)

    def fill(unfinished: PartialStore) -> None:
        for partition in partitions:
            read = shards.read(partition)
            if not all(item.row in position for item in read.items):
                raise shards.written_anew(partition)
            if read.items:
                places = [position[item.row] for item in read.items]
                unfinished.put(places, read.descriptors.astype(np.float32))

    return write_store(Path(out), manifest, fill)


def _plan(storage: Storage) -> Plan:
    plan = Plan.read(storage)
    if plan is None:
        raise StoreError(
            f"{storage.where} has no {PLAN}, so it is no folder of shards; write them with lpn describe --engine ray."
        )
    return plan


def _anew(storage: Storage, what: str) -> str:
    return f"{what} in {storage.where} was written anew while it was read; run this again when lpn describe has ended."
