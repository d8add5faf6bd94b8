"""Pictures of one view that are searched with pictures of another."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Self

import numpy as np
import numpy.typing as npt

import lpn
from lpn import descriptors, retrieval
from lpn.core.arrays import Float32Array, UInt8Array
from lpn.core.errors import InputError
from lpn.core.views import View
from lpn.datasets import Picture
from lpn.descriptors.transforms import UNCHANGED, Change
from lpn.library.answer import Answer
from lpn.models.base import Model
from lpn.retrieval import scoring


@dataclass(frozen=True, eq=False)
class Gallery:
    """Pictures of one view with their descriptors; its length is their number.

    Attributes:
        model: it describes the queries.
        view: of the pictures.
        pictures: in the order of their paths.
        descriptors: of the pictures, (G, n, D).
    """

    model: Model
    view: View
    pictures: tuple[Picture, ...]
    descriptors: Float32Array

    @classmethod
    def of_folder(cls, folder: str | Path, model: Model | str | Path, view: View = "satellite") -> Self:
        """Describe all pictures below a folder; their descriptors are kept in the user's cache.

        Args:
            folder: it is searched to any depth; a picture's name is its path below it.
            model: a model, or what `lpn.load` opens, such as the name of one that ships.
            view: of the pictures, "satellite", "street", or "drone".

        Raises:
            DataError: if there is no such folder, or it holds no picture.
            PictureError: if pictures are broken.
            InputError: if the model lacks the view.
            StoreError: if the cache cannot be written.
            LPNError: if the model cannot be opened, see `lpn.load`.
        """
        opened = model if isinstance(model, Model) else lpn.load(model)
        bound = opened.in_role(view, "gallery" if opened.contract.roles == "role" else None)
        files = descriptors.pictures_below(folder)
        pictures = [Picture(file, label, file.relative_to(folder).as_posix()) for label, file in enumerate(files)]
        return cls(opened, view, tuple(pictures), descriptors.cached_descriptors(bound, pictures, view))

    def __len__(self) -> int:
        return len(self.pictures)

    def search(
        self,
        picture: UInt8Array,
        view: View = "drone",
        weights: npt.ArrayLike | None = None,
        change: Change | float = UNCHANGED,
    ) -> Answer:
        """Rank the gallery by its distance to a picture.

        Args:
            picture: upright RGB, (H, W, 3) uint8, as `lpn.load_picture` reads it.
            view: of the picture.
            weights: of the parts, n numbers of 0 or more; equal by default.
            change: applied to the picture first; a number turns it by that many degrees counter-clockwise.

        Raises:
            InputError: if the picture has another shape, the model lacks the view, there are not n weights, or the change
                leaves nothing of the picture.
        """
        if not isinstance(picture, np.ndarray) or picture.dtype != np.uint8 or picture.shape[2:] != (3,):
            kind = f"{picture.dtype} {picture.shape}" if isinstance(picture, np.ndarray) else type(picture).__name__
            raise InputError(f"The picture is {kind}; expected uint8 (H, W, 3), so read its file by lpn.load_picture.")
        self.model.check_view(view)
        model = self.model.for_task(view, self.view)
        part_weights = scoring.part_weights(model.n_parts, weights)
        query = retrieval.describe_picture(model, picture, view, change)
        cosines = scoring.part_cosines(query.descriptor, self.descriptors)
        return Answer(model, (view, self.view), query, self.pictures, retrieval.rank(cosines, part_weights))
