"""A worker of distributed inference (`lpn.cluster.driver`) describes one partition at a time. It needs the extra `cluster`."""

from __future__ import annotations

import io
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np

from lpn.cluster.shards import FailedPicture, Plan, ShardItem, read_shard, unpacked, write_shard
from lpn.cluster.storage import Storage
from lpn.core import images
from lpn.core.arrays import Float32Array
from lpn.core.errors import LPNError, PictureError
from lpn.core.views import View
from lpn.datasets.integrity import DAMAGED, stream_error
from lpn.descriptors.parallel_inference import describe_each
from lpn.descriptors.transforms import UNCHANGED
from lpn.descriptors.writer import prepare_row
from lpn.models.onnx_engine import Engine


@dataclass(frozen=True)
class PartitionTask:
    """The settings of all workers.

    Attributes:
        images, out: addresses of the pictures and of the shards, see `lpn.cluster.storage.Storage`.
        plan: of the shards.
        model: name of the model's first file.
        threads: of one worker.
    """

    images: str
    out: str
    plan: Plan
    model: str
    threads: int


class DescribeWorker:
    """Describes partitions one at a time with one loaded model.

    Args:
        task: the settings of all workers.
        files: Ray's reference to the contents of the model's files by name, so that other machines need no copy.
    """

    def __init__(self, task: PartitionTask, files: Any) -> None:
        import cv2
        import ray

        cv2.setNumThreads(1)
        self.task, self.images, self.out = task, Storage(task.images), Storage(task.out)
        with tempfile.TemporaryDirectory(prefix="lpn-") as folder:
            for name, data in ray.get(files).items():
                Path(folder, name).write_bytes(data)
            model = Engine(Path(folder, task.model), threads=1)
            self.model = model.in_role(cast(View, task.plan.view), task.plan.role)

    def __call__(self, batch: Mapping[str, Any]) -> dict[str, list[Any]]:
        """Process Ray Data's batch of one partition; the result is one row, in which an error is a sentence."""
        partition = int(batch["partition"][0])
        try:
            items = unpacked(str(batch["items"][0]))
            computed, described, broken = self.describe(partition, items, int(batch["source"][0]))
        except LPNError as error:
            return {"partition": [partition], "computed": [0], "described": [0], "broken": [0], "error": [str(error)]}
        counts = {"computed": [computed], "described": [described], "broken": [broken]}
        return {"partition": [partition], **counts, "error": [""]}

    def describe(self, partition: int, items: list[ShardItem], source: int) -> tuple[int, int, int]:
        """Write a partition's shard.

        Args:
            items: the pictures of the partition.
            source: the partition whose shard has their descriptors so far.

        Returns:
            The numbers of pictures that were computed, are described, and are broken.
        """
        plan = self.task.plan
        before = read_shard(self.out, plan, source)
        rows = {item.row: row for item, row in zip(before.items, before.descriptors, strict=True)} if before else {}
        known = {one.item.row: one for one in before.notes.broken if one.settled} if before else {}
        missing = [item for item in items if item.row not in rows and item.row not in known]
        broken = [known[item.row]._replace(item=item) for item in items if item.row in known]
        streams = describe_each(self.model, missing, self._prepare, cast(View, plan.view), self.task.threads + 1)
        computed = 0
        for some in streams:
            computed += len(some.items)
            for i, row in zip(some.items, some.descriptors, strict=True):
                rows[missing[i].row] = row
            for i, error in some.broken:
                broken.append(FailedPicture(missing[i], str(error), not isinstance(error, _UnreadError)))
        described = [item for item in items if item.row in rows]
        numbers = np.zeros((len(described), plan.n_parts, plan.embedding), np.float32)
        for i, item in enumerate(described):
            numbers[i] = rows[item.row]
        write_shard(self.out, plan, partition, described, numbers, broken)
        return computed, len(described), len(broken)

    def _prepare(self, item: ShardItem) -> Float32Array:
        try:
            data = self.images.read(item.row.file)
        except OSError as error:
            raise _UnreadError(f"cannot be read ({(str(error).splitlines() or ['?'])[0]})") from error
        if (flaw := stream_error(io.BytesIO(data))) is not None:
            raise PictureError(flaw)
        try:
            picture = images.decode_picture(data, item.row.file)
        except PictureError as error:
            raise PictureError(DAMAGED) from error
        try:
            return prepare_row(self.model, picture, item.row, UNCHANGED, cast(View, self.task.plan.view))
        except PictureError as error:
            raise PictureError(f"cannot be cropped ({error})") from error


class _UnreadError(PictureError):
    """The picture's file could not be read; a retry may succeed."""
