"""The losses an LPN is trained with."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from lpn.training.recipes import Recipe


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
    first: Tensor,
    second: Tensor,
    temperature: float,
    smoothing: float = 0.0,
    overlaps: Tensor | None = None,
) -> Tensor:
    """Symmetric InfoNCE between two views of the same places.

    Args:
        first, second: descriptors (B, F); row i of both shows place i, and places differ within the batch.
        temperature: divides the mean cosine over parts.
        smoothing: label smoothing from 0 to 1, shared by the pairs that are not left out.
        overlaps: pairs of places that share ground, (B, B) bool, which are neither positives nor negatives.
    """
    similarity = first @ second.T / temperature
    counted = torch.ones_like(similarity, dtype=torch.bool)
    if overlaps is not None:
        counted = ~overlaps | torch.eye(len(overlaps), dtype=torch.bool, device=overlaps.device)
    return (_smoothed(similarity, counted, smoothing) + _smoothed(similarity.T, counted.T, smoothing)) / 2


def _smoothed(logits: Tensor, counted: Tensor, smoothing: float) -> Tensor:
    """Cross-entropy of (B, B) towards its diagonal, over the columns that count; these alone share the smoothing."""
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


def total_loss(
    outputs: Mapping[str, tuple[Tensor, Tensor]],
    labels: Mapping[str, Tensor],
    recipe: Recipe,
    overlaps: Tensor | None = None,
    step: int = 0,
) -> Tensor:
    """Compute a recipe's loss for one step.

    Args:
        outputs: part embeddings and class scores of each picture set (satellite, drone, street, google).
        labels: class of each row of each set, (B,). The InfoNCE and the metric loss compare the rows of a set whose label is
            that of the satellite's; others show another place, for want of a picture.
        overlaps: see `infonce_loss`.
        step: number of the step, from which the pool of the released metric losses is drawn.
    """
    loss = torch.zeros((), device=next(iter(labels.values())).device)
    if recipe.instance:
        terms = torch.cat(
            [instance_loss(s.float(), labels[name], recipe.label_smoothing) for name, (_, s) in outputs.items()]
        )
        loss = loss + recipe.instance * (terms.sum() if recipe.reduction == "sum" else terms.mean())
    if recipe.compares_drones:
        return loss + _released_loss(outputs, labels, recipe, step)
    if (recipe.infonce or recipe.metric != "none") and "satellite" in outputs:
        embeddings = {name: parts.float() for name, (parts, _) in outputs.items()}
        tiles = embeddings.pop("satellite")
        pairs = []
        for name, parts in embeddings.items():
            same = labels["satellite"] == labels[name]
            if same.sum() < 2:
                # Nothing to compare; the sum has a gradient of zero.
                pairs.append(0 * (tiles.sum() + parts.sum()))
                continue
            shared = None if overlaps is None else overlaps[same][:, same]
            pairs.append(_pair_loss(tiles[same], parts[same], recipe, shared))
        loss = loss + torch.stack(pairs).mean()
    return loss


def hardest_scores(tiles: Tensor, drones: Tensor, places: Tensor, pool: Tensor) -> tuple[Tensor, Tensor]:
    """Cosine of each satellite with the hardest of its own drone pictures, and with the hardest of other places in a pool.

    Args:
        tiles: descriptors of satellites, (B, F), of unit length.
        drones: descriptors of the k drone pictures of each of their places, (B, k, F).
        places: the place of each satellite, (B,).
        pool: indices of drone pictures, from 0 to B k - 1.

    Returns:
        Two tensors (B,): the smallest cosine with an own picture, and the largest with another place's, 0 without any.
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


def _released_loss(
    outputs: Mapping[str, tuple[Tensor, Tensor]], labels: Mapping[str, Tensor], recipe: Recipe, step: int
) -> Tensor:
    """Return the recipe's released metric loss; a satellite whose place has no drone picture is not counted."""
    tiles, drones = (descriptors(outputs[name][0].float()) for name in ("satellite", "drone"))
    drones = drones.reshape(len(tiles), recipe.positives, -1)
    same = labels["satellite"] == labels["drone"][:: recipe.positives]
    order = np.random.default_rng([recipe.seed, step]).permutation(int(same.sum()) * recipe.positives)
    if not len(order):
        return (tiles.sum() + drones.sum()).mul(0)
    pool = torch.from_numpy(order[: recipe.pool]).to(tiles.device)
    scores = hardest_scores(tiles[same], drones[same], labels["satellite"][same], pool)
    return released_metric_loss(*scores, recipe)


def _pair_loss(tiles: Tensor, pictures: Tensor, recipe: Recipe, overlaps: Tensor | None) -> Tensor:
    """Sum the recipe's losses on the part embeddings (B, n, D) of two views."""
    loss = torch.zeros((), device=tiles.device)
    whole = descriptors(tiles), descriptors(pictures)
    if recipe.infonce:
        similar = infonce_loss(*whole, recipe.temperature, recipe.label_smoothing, overlaps)
        loss = loss + recipe.infonce * similar
    if recipe.metric != "none" and not recipe.metric_per_part:
        loss = loss + soft_margin_loss(*whole, recipe.alpha)
    elif recipe.metric != "none":
        pairs = zip(torch.split(tiles, 1, 1), torch.split(pictures, 1, 1), strict=True)
        terms = [soft_margin_loss(descriptors(first), descriptors(second), recipe.alpha) for first, second in pairs]
        loss = loss + torch.stack(terms).mean()
    return loss
