"""Pictures of one view, searched with pictures of another."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
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
from lpn.library.analyser import describe_tile
from lpn.library.answer import SHOWN, Answer
from lpn.models.base import Model
from lpn.retrieval import DescribedPicture, Ranking, calibration, scoring
from lpn.retrieval.calibration import Calibration
from lpn.retrieval.csls import CslsTerms
from lpn.retrieval.csls import hubness as hubness_of
from lpn.tasks.task import Task


@dataclass(frozen=True, eq=False, repr=False)
class Gallery:
    """Pictures of one view with their descriptors; its length is their number.

    Attributes:
        model: describes the queries, calibrated like the gallery.
        view: of the pictures.
        pictures: in the order of their paths.
        descriptors: of the pictures, (G, n, D).
        calibration: of the model; None without one.
        neighbours: K of CSLS; 0 ranks without it.
        hubness: the pictures' terms of CSLS, see `CslsTerms`, (G, n); None without it.
    """

    model: Model
    view: View
    pictures: tuple[Picture, ...]
    descriptors: Float32Array
    calibration: Calibration | None = None
    neighbours: int = 0
    hubness: Float32Array | None = None

    @classmethod
    def of_folder(
        cls,
        folder: str | Path,
        model: Model | str | Path,
        view: View = "satellite",
        queries: str | Path | None = None,
        query_view: View = "drone",
        calibrate: bool | None = None,
        csls: int = 0,
    ) -> Self:
        """Describe all pictures below a folder; the user's cache stores their descriptors.

        Args:
            folder: searched to any depth; a picture's name is its path below it.
            model: a model, or an argument of `lpn.load`, such as the name of a shipped one.
            view: of the pictures, "satellite", "street", or "drone".
            queries: a folder of typical query pictures, for `calibrate` and `csls`; no labels are needed.
            query_view: the view of the queries.
            calibrate, csls: see `lpn.open_task`; a folder has no shipped calibration.

        Raises:
            DataError: if there is no such folder, or it holds no picture.
            PictureError: if pictures are broken.
            InputError: if the model lacks a view, or the queries are missing, not needed, or too few.
            StoreError: if the cache cannot be written.
            LPNError: if the model cannot be opened, see `lpn.load`.
        """
        opened = model if isinstance(model, Model) else lpn.load(model)
        pictures = _listed(folder)
        if (queries is not None) != bool(calibrate or csls):
            raise InputError(
                "calibrate and csls need a folder of typical query pictures, and nothing else uses it; give it as queries, "
                "together with one of both, or leave all three out."
            )
        if queries is None:
            bound = opened.in_role(view, "gallery" if opened.contract.roles == "role" else None)
            return cls(opened, view, tuple(pictures), descriptors.cached_descriptors(bound, pictures, view))
        bound, asked, made = opened.for_task(query_view, view), _listed(queries), None
        if calibrate:
            made = calibration.calibrate(bound, {query_view: [asked], view: [pictures]})
        read = descriptors.cached_descriptors if made is None else made.read
        tiles = read(bound, pictures, view)
        hubness = bound.n_parts * hubness_of(read(bound, asked, query_view), tiles, csls) if csls else None
        if made is not None:
            opened, pictures = made.applied(opened), made.pictures(view, pictures)
        return cls(opened, view, tuple(pictures), tiles, made, csls, hubness)

    def __len__(self) -> int:
        return len(self.pictures)

    def __repr__(self) -> str:
        return f"<Gallery of {len(self):,} {self.view} pictures, {self.model.describe()}>"

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
            InputError: if the picture has another shape, the model lacks the view, the gallery is calibrated for another
                view, the number of weights is wrong, or the change leaves nothing of the picture.
        """
        if not isinstance(picture, np.ndarray) or picture.dtype != np.uint8 or picture.shape[2:] != (3,):
            kind = f"{picture.dtype} {picture.shape}" if isinstance(picture, np.ndarray) else type(picture).__name__
            raise InputError(f"The picture is {kind}; expected uint8 (H, W, 3), so read its file by lpn.load_picture.")
        self.model.check_view(view)
        model = self.model.for_task(view, self.view)
        part_weights = scoring.part_weights(model.n_parts, weights)
        change, zoom = change if isinstance(change, Change) else Change(rotate=change), 1.0
        if self.calibration is not None:
            zoom = self.calibration.own_zoom(model, picture, view)
        query = retrieval.describe_picture(model, picture, view, replace(change, zoom=zoom))
        cosines, terms = scoring.part_cosines(query.descriptor, self.descriptors), None
        if self.hubness is not None:
            terms = CslsTerms.of_query(cosines, self.hubness, self.neighbours)
        ranking = retrieval.rank(cosines, part_weights, csls=terms)
        return answer_of(model, (view, self.view), query, self.pictures, self.descriptors, ranking)


def answer_of(
    model: Model,
    views: tuple[View, View],
    query: DescribedPicture,
    pictures: Sequence[Picture],
    descriptors_of: Float32Array,
    ranking: Ranking,
    name: str = "query",
) -> Answer:
    """Return the answer to a described picture of unknown place.

    Args:
        model: describes query and pictures; the result of `Model.for_task` for the views.
        views: of the query and of the pictures.
        descriptors_of: of the pictures, (G, n, D).
        ranking: of the pictures.
    """
    task = Task(
        name=f"{views[0]}-to-{views[1]}",
        model=model,
        model_name=model.contract.method,
        data_name="pictures",
        root=Path(),
        contract=model.contract,
        map_sizes={view: model.map_size(view) for view in views},
        queries=(),
        gallery=pictures,
        query_labels=np.zeros(0, np.int64),
        gallery_labels=np.arange(len(pictures)),
        query_descriptors=descriptors_of[:0],
        gallery_descriptors=descriptors_of,
    )
    return Answer(
        task=task,
        name=name,
        query=query,
        ranking=ranking,
        matches=ranking.top(SHOWN),
        chosen=ranking.match(0),
        describe_tile=lambda task, index: describe_tile(task, index, model),
        source=query.picture,
    )


def _listed(folder: str | Path) -> list[Picture]:
    """Return the pictures below a folder, each with a different label."""
    files = descriptors.pictures_below(folder)
    return [Picture(file, label, file.relative_to(folder).as_posix()) for label, file in enumerate(files)]
