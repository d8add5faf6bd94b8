"""The command describe."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from lpn.core.errors import InputError
from lpn.core.texts import counted
from lpn.core.views import View
from lpn.sources import Advanced, ModelOptions


@dataclass(kw_only=True)
class DescribeCommand(ModelOptions):
    """Describe pictures into a store of descriptors; resumable.

    Several machines share the work by --part 3/8, or by --engine ray.
    """

    model: Path = field()  # no default, unlike in `ModelOptions`
    """Trained LPN: .onnx, .safetensors, or .pth; with --engine ray an .onnx, which is sent to the workers."""
    images: str
    """Folder of pictures, searched with all folders below it; with --engine ray also an address such as s3://bucket/tiles."""
    view: View
    """The view the pictures show."""
    out: str
    """Folder of the store; with --engine ray also an address. Every machine must see it."""
    role: Advanced[Literal["query", "gallery"] | None] = None
    """Role of the pictures, for a model with one branch for queries and one for the gallery; by default the satellite is the
    gallery. An index holds a gallery."""
    precision: Literal["float32", "float16", "int8"] = "float32"
    """Numbers on disk; float16 halves the store, int8 quarters it."""
    part: Advanced[str | None] = None
    """Share of the pictures that this machine describes, such as 3/8; when all are described, the same command without --part
    makes the store of them."""
    engine: Literal["local", "ray"] = "local"
    """local describes on this machine, and refuses broken pictures before anything is computed. ray describes with many workers,
    lists broken pictures in broken.csv, and ends with status 1 if there are any."""
    address: Advanced[str | None] = None
    """With --engine ray: address of the cluster, auto on one of its machines; by default workers run on this machine."""
    workers: Advanced[int | None] = None
    """With --engine ray: number of workers; by default as many as the cores allow."""
    threads: Advanced[int | None] = None
    """With --engine ray: cores of one worker, 1 by default; each worker holds the model once, so more cores save memory."""

    def run(self) -> int:
        return self._by_many() if self.engine == "ray" else self._by_one()

    def resume_hint(self) -> str:
        """Return how to resume after a stop."""
        return f"The descriptors in {self.out} are kept; the same command goes on."

    def _by_one(self) -> int:
        from lpn import descriptors

        for option in ("address", "workers", "threads"):
            if getattr(self, option) is not None:
                raise InputError(f"--{option} is for many workers; give it with --engine ray.")
        if "://" in self.images + self.out:
            raise InputError("Only --engine ray reads and writes addresses; give folders, or --engine ray.")
        share = _share(self.part)
        model, root = self.load().in_role(self.view, self.role), Path(self.images)
        files = descriptors.pictures_below(root)
        if share is not None:
            done = descriptors.describe_share(model, files, self.view, self.out, root, share, self.precision)
            print(
                f"{self.out} has part {self.part}, {done:,} of {len(files):,} pictures; when it has all parts, give the same "
                "command without --part."
            )
            return 0
        store = descriptors.describe(model, files, self.view, self.out, root=root, precision=self.precision)
        shape = " x ".join(map(str, store.descriptors.shape))
        print(f"{self.out} holds {shape} numbers: pictures x parts x dimensions. Computed on {model.device}.")
        return 0

    def _by_many(self) -> int:
        from lpn.descriptors.many_machines import BROKEN, describe_by_many

        if self.provider not in ("auto", "cpu"):
            raise InputError("Ray's workers compute on the CPU; leave --provider or --engine ray out.")
        for option in ("kind", "pooling", "part"):
            if getattr(self, option) is not None:
                raise InputError(f"--{option} is for one machine; leave it or --engine ray out.")
        summary = describe_by_many(
            self.model,
            self.images,
            self.view,
            self.out,
            self.precision,
            self.address,
            self.workers,
            1 if self.threads is None else self.threads,
            self.role,
        )
        broken = len(summary.broken)
        held = counted(summary.pictures - broken, "descriptor")
        print(f"{self.out} holds {held}, {summary.computed:,} of them computed now.")
        if broken:
            print(f"{counted(broken, 'picture')} could not be described; {BROKEN} there gives names and reasons.")
        return 1 if broken else 0


def _share(text: str | None) -> tuple[int, int] | None:
    """Return the numbers of a share such as 3/8; InputError if it is none."""
    if text is None:
        return None
    match = re.fullmatch(r"(\d{1,6})/(\d{1,6})", text, re.ASCII)
    i, n = (int(match[1]), int(match[2])) if match else (0, 0)
    if not 1 <= i <= n:
        raise InputError(f"--part is {text}; expected a share such as 3/8, the third of eight.")
    return i, n
