"""The losses an LPN is trained with."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping

import torch
import torch.nn.functional as F
from torch import Tensor

from lpn.training.recipes import Recipe

# Lower bound of squared distances, because the gradient of the square root is unbounded near 0.
_MIN_SQUARED = 1e-12


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


def contrastive_loss(first: Tensor, second: Tensor, margin: float, hardest: bool = False) -> Tensor:
    """Contrastive loss (Hadsell et al. 2006): d^2 of positives plus max(0, margin - d)^2 of negatives, each averaged.

    The arguments are those of `triplet_loss`.
    """
    squared = _squared_distances(first, second)
    short = (margin - squared.clamp_min(_MIN_SQUARED).sqrt()).clamp_min(0).square()
    negatives = torch.stack([_negatives(s, hardest, torch.amax).mean() for s in (short, short.T)])
    return squared.diagonal().mean() + negatives.mean()


def triplet_loss(first: Tensor, second: Tensor, margin: float, hardest: bool = False) -> Tensor:
    """Triplet loss max(0, margin + d_positive - d_negative) over the batch, in both directions.

    Args:
        first, second: descriptors (B, F) of unit length; row i of both shows place i, and places differ within the batch.
        margin: in Euclidean distance d.
        hardest: count only the hardest negative of each picture. Otherwise all negatives count, and the mean is over
            those within the margin, because the many easy ones would outweigh them.
    """
    distance = _squared_distances(first, second).clamp_min(_MIN_SQUARED).sqrt()
    terms = []
    for d in (distance, distance.T):
        within = (margin + d.diagonal()[:, None] - _negatives(d, hardest, torch.amin)).clamp_min(0)
        terms.append(within.sum() / within.gt(0).sum().clamp_min(1))
    return torch.stack(terms).mean()


def soft_margin_loss(first: Tensor, second: Tensor, alpha: float, hardest: bool = False) -> Tensor:
    """Weighted soft-margin triplet loss (Hu et al. 2018): log(1 + exp(alpha (d_positive^2 - d_negative^2))).

    It is averaged over the batch in both directions. The arguments are those of `triplet_loss`. As released with SAFA, the
    average over all B (B - 1) negatives also counts each positive against itself, which adds log(2) / (B - 1) and no
    gradient; `hardest` does not.
    """
    squared = _squared_distances(first, second)
    b = len(squared)
    terms = []
    for d in (squared, squared.T):
        negatives = _negatives(d, hardest, torch.amin) if hardest else d
        losses = F.softplus(alpha * (d.diagonal()[:, None] - negatives))
        terms.append(losses.mean() if hardest else losses.sum() / (b * (b - 1)))
    return torch.stack(terms).mean()


def total_loss(
    outputs: Mapping[str, tuple[Tensor, Tensor]],
    labels: Mapping[str, Tensor],
    recipe: Recipe,
    overlaps: Tensor | None = None,
) -> Tensor:
    """Compute a recipe's loss for one step.

    Args:
        outputs: part embeddings and class scores of each picture set (satellite, drone, street, google).
        labels: class of each row of each set, (B,). The InfoNCE and the metric loss compare the rows of a set whose label is
            that of the satellite's; others show another place, for want of a picture.
        overlaps: see `infonce_loss`.
    """
    loss = torch.zeros((), device=next(iter(labels.values())).device)
    if recipe.instance:
        terms = torch.cat(
            [instance_loss(s.float(), labels[name], recipe.label_smoothing) for name, (_, s) in outputs.items()]
        )
        loss = loss + recipe.instance * (terms.sum() if recipe.reduction == "sum" else terms.mean())
    if (recipe.infonce or recipe.metric != "none") and "satellite" in outputs:
        embeddings = {name: parts.float() for name, (parts, _) in outputs.items()}
        tiles = embeddings.pop("satellite")
        pairs = []
        for name, parts in embeddings.items():
            same = labels["satellite"] == labels[name]
            if same.sum() < 2:
                # Nothing to compare; the sum keeps the graph that a training by several processes expects.
                pairs.append(0 * (tiles.sum() + parts.sum()))
                continue
            shared = None if overlaps is None else overlaps[same][:, same]
            pairs.append(_pair_loss(tiles[same], parts[same], recipe, shared))
        loss = loss + torch.stack(pairs).mean()
    return loss


def _pair_loss(tiles: Tensor, pictures: Tensor, recipe: Recipe, overlaps: Tensor | None) -> Tensor:
    """Sum the recipe's losses on the part embeddings (B, n, D) of two views."""
    loss = torch.zeros((), device=tiles.device)
    whole = descriptors(tiles), descriptors(pictures)
    if recipe.infonce:
        similar = infonce_loss(*whole, recipe.temperature, recipe.label_smoothing, overlaps)
        loss = loss + recipe.infonce * similar
    if recipe.metric != "none" and not recipe.metric_per_part:
        loss = loss + _metric_loss(*whole, recipe)
    elif recipe.metric != "none":
        pairs = zip(torch.split(tiles, 1, 1), torch.split(pictures, 1, 1), strict=True)
        terms = [_metric_loss(descriptors(first), descriptors(second), recipe) for first, second in pairs]
        loss = loss + torch.stack(terms).mean()
    return loss


def _metric_loss(first: Tensor, second: Tensor, recipe: Recipe) -> Tensor:
    hardest = recipe.mining == "hardest"
    if recipe.metric == "contrastive":
        return contrastive_loss(first, second, recipe.margin, hardest)
    if recipe.metric == "triplet":
        return triplet_loss(first, second, recipe.margin, hardest)
    return soft_margin_loss(first, second, recipe.alpha, hardest)


def _squared_distances(first: Tensor, second: Tensor) -> Tensor:
    """Squared distances of unit vectors (B, F) and (B, F): (B, B), from 0 to 4."""
    return 2 - 2 * first @ second.T


def _negatives(table: Tensor, hardest: bool, reduce: Callable[..., Tensor]) -> Tensor:
    """Drop the diagonal of (B, B), giving (B, B - 1), or reduce each row to its hardest negative, (B, 1)."""
    b = len(table)
    off_diagonal = table.flatten()[1:].view(b - 1, b + 1)[:, :-1].reshape(b, b - 1)
    return reduce(off_diagonal, dim=1, keepdim=True) if hardest else off_diagonal
