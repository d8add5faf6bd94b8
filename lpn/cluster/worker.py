"""A worker of distributed inference (`lpn.cluster.driver`): it describes one list of pictures at a time. Extra `cluster`."""

from __future__ import annotations

import io
import json
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from lpn.cluster.storage import Storage
from lpn.core import images
from lpn.core.arrays import Float32Array
from lpn.core.errors import PictureError
from lpn.core.views import View
from lpn.datasets.integrity import DAMAGED, stream_error
from lpn.descriptors.parallel_inference import describe_each
from lpn.models.contract import Role
from lpn.models.onnx_engine import Engine


@dataclass(frozen=True)
class WorkerTask:
    """The settings of all workers.

    Attributes:
        pictures: address of the pictures, see `lpn.cluster.storage.Storage`.
        model: name of the model's first file.
        view, role: of the branch.
        threads: of one worker.
    """

    pictures: str
    model: str
    view: View
    role: Role | None
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
        self.task, self.storage = task, Storage(task.pictures)
        with tempfile.TemporaryDirectory(prefix="lpn-") as folder:
            for name, data in ray.get(files).items():
                Path(folder, name).write_bytes(data)
            self.model = Engine(Path(folder, task.model), threads=1).in_role(task.view, task.role)

    def __call__(self, batch: Mapping[str, Any]) -> dict[str, list[Any]]:
        """Describe the pictures of Ray Data's batch of one row, and return one row; `broken` has reasons by position."""
        names = json.loads(str(batch["names"][0]))
        described, broken = self.describe(names)
        return {"start": [int(batch["start"][0])], "described": [described.tobytes()], "broken": [json.dumps(broken)]}

    def describe(self, names: Sequence[str]) -> tuple[Float32Array, dict[int, str]]:
        """Return descriptors (B, n, D) of pictures, and why some have none, such as "is damaged", by their positions."""
        described = np.zeros((len(names), self.model.n_parts, self.model.embedding), np.float32)
        broken: dict[int, str] = {}
        for some in describe_each(self.model, names, self._prepare, self.task.view, self.task.threads + 1):
            described[some.items] = some.descriptors
            broken |= {i: str(error) for i, error in some.broken}
        return described, broken

    def _prepare(self, name: str) -> Float32Array:
        try:
            data = self.storage.read(name)
        except OSError as error:
            raise PictureError(f"cannot be read ({(str(error).splitlines() or ['?'])[0]})") from error
        if (flaw := stream_error(io.BytesIO(data))) is not None:
            raise PictureError(flaw)
        try:
            return self.model.prepare(images.decode_picture(data, name), self.task.view)
        except PictureError as error:
            raise PictureError(DAMAGED) from error
