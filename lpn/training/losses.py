"""The losses of an LPN, and those of other packages: entry points of the group `lpn.losses`."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib.metadata import entry_points

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from lpn.core.errors import InputError, LPNError
from lpn.core.files import printable
from lpn.training.recipe import Recipe

GROUP = "lpn.losses"
# The names of our own terms, and of their sum.
_TERMS = ("loss", "instance", "contrastive", "triplet", "soft_margin", "infonce")
# A loss of another package: a scalar tensor of a step, with a gradient.
PackageLoss = Callable[["TrainingStep", Recipe], Tensor]


def instance_loss(scores: Tensor, places: Tensor, smoothing: float = 0.0) -> Tensor:
    """Cross-entropy over places of each part, averaged over pictures: (n,) (equations 5 and 6 of the paper).

    Args:
        scores: class scores (B, n, classes).
        places: class of each picture, (B,).
    """
    n = scores.shape[1]
    targets = places[:, None].expand(-1, n)
    return F.cross_entropy(scores.transpose(1, 2), targets, label_smoothing=smoothing, reduction="none").mean(dim=0)


def descriptors(parts: Tensor) -> Tensor:
    """Return descriptors for retrieval, (B, n D): each part of (B, n, D) is divided by its norm and by sqrt(n)."""
    return F.normalize(parts, dim=2).flatten(1) / math.sqrt(parts.shape[1])


def infonce_loss(
    first: Tensor, second: Tensor, temperature: float, smoothing: float = 0.0, overlaps: Tensor | None = None
) -> Tensor:
    """Return the symmetric InfoNCE between two views of equal places.

    Args:
        first, second: descriptors (B, F); row i of both shows place i, and places differ within the batch.
        temperature: divides the mean cosine over parts.
        smoothing: label smoothing from 0 to 1, shared by the counted pairs.
        overlaps: pairs of places that share ground, (B, B) bool, which count neither as positives nor as negatives.
    """
    similarity = first @ second.T / temperature
    counted = torch.ones_like(similarity, dtype=torch.bool)
    if overlaps is not None:
        counted = ~overlaps | torch.eye(len(overlaps), dtype=torch.bool, device=overlaps.device)
    return (_smoothed(similarity, counted, smoothing) + _smoothed(similarity.T, counted.T, smoothing)) / 2


def _smoothed(logits: Tensor, counted: Tensor, smoothing: float) -> Tensor:
    """Return the cross-entropy of logits (B, B) to the diagonal over the counted columns, which share the smoothing."""
    logs = logits.masked_fill(~counted, -torch.inf).log_softmax(dim=1)
    evenly = logs.masked_fill(~counted, 0.0).sum(dim=1) / counted.sum(dim=1)
    return -((1 - smoothing) * logs.diagonal() + smoothing * evenly).mean()


def soft_margin_loss(first: Tensor, second: Tensor, alpha: float) -> Tensor:
    """SAFA's weighted soft-margin triplet loss (Hu et al. 2018): log(1 + exp(alpha (d_positive^2 - d_negative^2))).

    It is averaged over the batch in both directions. As released, the average over all B (B - 1) negatives also counts each
    positive against itself, which adds log(2) / (B - 1) and no gradient.

    Args:
        first, second: descriptors (B, F) of unit length; row i of both shows place i, and places differ within the batch.
    """
    squared = 2 - 2 * first @ second.T
    b = len(squared)
    terms = [F.softplus(alpha * (d.diagonal()[:, None] - d)).sum() / (b * (b - 1)) for d in (squared, squared.T)]
    return torch.stack(terms).mean()


@dataclass(frozen=True)
class TrainingStep:
    """The outputs of a network for one batch, for a loss.

    Attributes:
        parts: the embeddings of the parts in each picture set (satellite, drone, street, google), (B, n, D).
        scores: the class scores of each part, (B, n, classes).
        labels: the class of each row of each set, (B,). A row whose label differs from the satellite's shows another place, for
            lack of a picture.
        overlaps: for windows of a map, the pairs of rows that share ground, (B, B) bool; else None.
        number: of the step, from 0, over all epochs.
    """

    parts: Mapping[str, Tensor]
    scores: Mapping[str, Tensor]
    labels: Mapping[str, Tensor]
    overlaps: Tensor | None = None
    number: int = 0


def loss_terms(step: TrainingStep, recipe: Recipe, own: PackageLoss | None = None) -> dict[str, Tensor]:
    """Compute the terms of a recipe's loss, each with its weight, by their names; the loss is their sum.

    Args:
        own: the loss of another package that the recipe names, opened.

    Raises:
        InputError: if a package's loss fails, or is not one number.
    """
    terms: dict[str, Tensor] = {}
    if recipe.instance:
        by_part = torch.cat(
            [instance_loss(s.float(), step.labels[name], recipe.label_smoothing) for name, s in step.scores.items()]
        )
        terms["instance"] = recipe.instance * (by_part.sum() if recipe.reduction == "sum" else by_part.mean())
    if recipe.compares_drones:
        terms[recipe.metric] = _released_loss(step, recipe)
    elif recipe.metric != "none":
        terms[recipe.metric] = _over_pairs(step, lambda tiles, others, _: _soft_margin(tiles, others, recipe))
    if recipe.infonce:

        def infonce(tiles: Tensor, others: Tensor, overlaps: Tensor | None) -> Tensor:
            views = descriptors(tiles), descriptors(others)
            return recipe.infonce * infonce_loss(*views, recipe.temperature, recipe.label_smoothing, overlaps)

        terms["infonce"] = _over_pairs(step, infonce)
    if own is not None:
        terms[recipe.loss] = recipe.loss_weight * _of_package(own, step, recipe)
    return terms


def open_loss(name: str) -> PackageLoss:
    """Return a package's loss by its entry point of the group `lpn.losses`.

    Raises:
        InputError: if no package registers it, or it cannot be loaded.
    """
    found = {point.name: point for point in entry_points(group=GROUP) if point.name not in _TERMS}
    if name not in found:
        raise InputError(
            f"There is no loss {printable(name)}; an installed package has to register it by an entry point of {GROUP}, which "
            f"has {', '.join(sorted(found)) or 'none'}; {', '.join(_TERMS)} are names of ours."
        )
    try:
        loss: PackageLoss = found[name].load()
    except Exception as error:  # another package's code may raise anything
        raise InputError(f"The loss {name} ({found[name].value}) cannot be loaded: {_reason(error)}.") from error
    return loss


def _of_package(own: PackageLoss, step: TrainingStep, recipe: Recipe) -> Tensor:
    name = recipe.loss
    try:
        loss = own(step, recipe)
    except LPNError:
        raise
    except Exception as error:  # another package's code may raise anything
        raise InputError(f"The loss {name} failed: {_reason(error)}.") from error
    if not isinstance(loss, Tensor) or loss.numel() != 1:
        shown = f"a tensor of {tuple(loss.shape)}" if isinstance(loss, Tensor) else f"a {type(loss).__name__}"
        raise InputError(f"The loss {name} returned {shown}; expected a tensor with one number.")
    return loss.reshape(())


def _reason(error: Exception) -> str:
    return f"{type(error).__name__}: {printable(str(error).strip().partition(chr(10))[0])}"


def _over_pairs(step: TrainingStep, loss: Callable[[Tensor, Tensor, Tensor | None], Tensor]) -> Tensor:
    """Average a loss on part embeddings (b, n, D) over the pairs of the satellite view with each other view.

    Only rows that show the satellite's place are compared.
    """
    embeddings = {name: parts.float() for name, parts in step.parts.items()}
    tiles, labels = embeddings.pop("satellite"), step.labels
    pairs = []
    for name, parts in embeddings.items():
        same = labels["satellite"] == labels[name]
        if same.sum() < 2:
            # Nothing to compare; the sum has a gradient of zero.
            pairs.append(0 * (tiles.sum() + parts.sum()))
            continue
        shared = None if step.overlaps is None else step.overlaps[same][:, same]
        pairs.append(loss(tiles[same], parts[same], shared))
    return torch.stack(pairs).mean()


def _soft_margin(tiles: Tensor, pictures: Tensor, recipe: Recipe) -> Tensor:
    together = 1 if recipe.metric_per_part else tiles.shape[1]
    pairs = zip(torch.split(tiles, together, 1), torch.split(pictures, together, 1), strict=True)
    return torch.stack([soft_margin_loss(descriptors(a), descriptors(b), recipe.alpha) for a, b in pairs]).mean()


def hardest_scores(tiles: Tensor, drones: Tensor, places: Tensor, pool: Tensor) -> tuple[Tensor, Tensor]:
    """Return each satellite's cosine with its place's hardest drone picture, and with the hardest of other places in a pool.

    Args:
        tiles: descriptors of satellites, (B, F), of unit length.
        drones: descriptors of the k drone pictures of each of their places, (B, k, F).
        places: the place of each satellite, (B,).
        pool: indices of drone pictures, from 0 to B k - 1.

    Returns:
        Two tensors (B,): the smallest cosine with its own place, and the largest with another place, 0 without any.
    """
    flat = drones.flatten(0, 1)[pool]
    others = places.repeat_interleave(drones.shape[1])[pool][None, :] != places[:, None]
    with torch.no_grad():
        own = torch.einsum("bf,bkf->bk", tiles, drones).argmin(dim=1)
        other = (tiles @ flat.T).masked_fill(~others, -torch.inf).argmax(dim=1)
    positive = (tiles * drones[torch.arange(len(tiles)), own]).sum(dim=1)
    negative = (tiles * flat[other]).sum(dim=1)
    return positive, torch.where(others.any(dim=1), negative, 0.0)


def released_metric_loss(positive: Tensor, negative: Tensor, recipe: Recipe) -> Tensor:
    """Sum a released metric loss over a batch of cosines (B,) with true and with false matches.

    Contrastive: (1 - s_p)^2 + (1 + s_n)^2. Triplet: max(0, s_n + margin - s_p). Soft margin: log(1 + exp(alpha (s_n - s_p))),
    with alpha 1 as released (layumi/University1652-triplet-loss train-contrastive.py:251, train.py:250,
    train-soft-margin.py:251, which lacks the sum).
    """
    if recipe.metric == "contrastive":
        return (1 - positive).square().sum() + (1 + negative).square().sum()
    if recipe.metric == "triplet":
        return (negative + recipe.margin - positive).clamp_min(0).sum()
    return F.softplus(recipe.alpha * (negative - positive)).sum()


def _released_loss(step: TrainingStep, recipe: Recipe) -> Tensor:
    """Return the recipe's released metric loss; a satellite without a drone picture of its place is not counted."""
    labels = step.labels
    tiles, drones = (descriptors(step.parts[name].float()) for name in ("satellite", "drone"))
    drones = drones.reshape(len(tiles), recipe.positives, -1)
    same = labels["satellite"] == labels["drone"][:: recipe.positives]
    order = np.random.default_rng([recipe.seed, step.number]).permutation(int(same.sum()) * recipe.positives)
    if not len(order):
        return (tiles.sum() + drones.sum()).mul(0)
    pool = torch.from_numpy(order[: recipe.pool]).to(tiles.device)
    scores = hardest_scores(tiles[same], drones[same], labels["satellite"][same], pool)
    return released_metric_loss(*scores, recipe)
