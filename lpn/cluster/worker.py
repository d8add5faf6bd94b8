"""A worker of distributed inference (`lpn.cluster.driver`) writes one part at a time. It needs the extra `cluster`."""

from __future__ import annotations

import io
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np

from lpn.cluster.parts import FailedPicture, PartItem, Plan, unpacked, write_part
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
class WorkerTask:
    """The settings of all workers.

    Attributes:
        images, out: addresses of the pictures and of the parts, see `lpn.cluster.storage.Storage`.
        plan: of the parts.
        model: name of the model's first file.
        threads: cores of one worker.
    """

    images: str
    out: str
    plan: Plan
    model: str
    threads: int


class DescribeWorker:
    """Describes pictures with one loaded model.

    Args:
        task: the settings of all workers.
        files: Ray's reference to the contents of the model's files by name, so that other machines need no copy.
    """

    def __init__(self, task: WorkerTask, files: Any) -> None:
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
        """Describe the pictures of Ray Data's batch of one row; the result is one row, with an error as a sentence."""
        try:
            described, broken = self.describe(unpacked(str(batch["items"][0])))
        except LPNError as error:
            return {"described": [0], "broken": [0], "error": [str(error)]}
        return {"described": [described], "broken": [broken], "error": [""]}

    def describe(self, items: list[PartItem]) -> tuple[int, int]:
        """Write a part of some pictures; return the numbers of described and of broken ones."""
        plan = self.task.plan
        rows: dict[int, Float32Array] = {}
        broken: dict[int, FailedPicture] = {}
        view = cast(View, plan.view)
        for some in describe_each(self.model, items, self._prepare, view, self.task.threads + 1):
            rows |= dict(zip(some.items, some.descriptors, strict=True))
            for i, error in some.broken:
                broken[i] = FailedPicture(items[i], str(error), not isinstance(error, _UnreadError))
        order = sorted(rows)
        numbers = np.array([rows[i] for i in order], np.float32).reshape(-1, plan.n_parts, plan.embedding)
        write_part(self.out, plan, [items[i] for i in order], numbers, [broken[i] for i in sorted(broken)])
        return len(rows), len(broken)

    def _prepare(self, item: PartItem) -> Float32Array:
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
