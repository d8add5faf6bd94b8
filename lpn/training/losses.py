"""The losses an LPN is trained with."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping

import torch
import torch.nn.functional as F
from torch import Tensor

from lpn.training.recipes import Recipe


def instance_loss(scores: Tensor, places: Tensor, smoothing: float = 0.0) -> Tensor:
    """Cross-entropy over places of each part, averaged over pictures: (n,) (equation 4 of the paper).

    Args:
        scores: class scores (B, n, classes).
        places: class of each picture, (B,).
    """
    n = scores.shape[1]
    targets = places[:, None].expand(-1, n)
    return F.cross_entropy(scores.transpose(1, 2), targets, label_smoothing=smoothing, reduction="none").mean(dim=0)


def descriptors(parts: Tensor) -> Tensor:
    """What retrieval compares: part embeddings (B, n, D), each divided by its norm and by sqrt(n), as (B, n D)."""
    return F.normalize(parts, dim=2).flatten(1) / math.sqrt(parts.shape[1])


def infonce_loss(first: Tensor, second: Tensor, temperature: float, smoothing: float = 0.0) -> Tensor:
    """Symmetric InfoNCE between two views of the same places.

    Args:
        first, second: descriptors (B, F); row i of both shows place i, and places differ within the batch.
        temperature: divides the mean cosine over parts.
    """
    similarity = first @ second.T / temperature
    target = torch.arange(len(similarity), device=similarity.device)
    rows, columns = (F.cross_entropy(s, target, label_smoothing=smoothing) for s in (similarity, similarity.T))
    return (rows + columns) / 2


def contrastive_loss(first: Tensor, second: Tensor, margin: float, hardest: bool = False) -> Tensor:
    """Hadsell et al. 2006: d^2 of true pairs plus max(0, margin - d)^2 of false ones, each averaged; as for `triplet_loss`."""
    squared = _squared(first, second)
    short = (margin - squared.clamp_min(_TINY).sqrt()).clamp_min(0).square()
    wrong = torch.stack([_wrong(s, hardest, torch.amax).mean() for s in (short, short.T)])
    return squared.diagonal().mean() + wrong.mean()


def triplet_loss(first: Tensor, second: Tensor, margin: float, hardest: bool = False) -> Tensor:
    """max(0, margin + d_true - d_false) over the batch, from the first view to the second and back.

    Args:
        first, second: descriptors (B, F) of unit length; row i of both shows place i, and places differ within the batch.
        margin: in Euclidean distance d.
        hardest: each picture's nearest wrong one counts alone. Otherwise all wrong ones do, and the mean is over those
            within the margin, as the many far ones would outweigh them.
    """
    distance = _squared(first, second).clamp_min(_TINY).sqrt()
    terms = []
    for d in (distance, distance.T):
        within = (margin + d.diagonal()[:, None] - _wrong(d, hardest, torch.amin)).clamp_min(0)
        terms.append(within.sum() / within.gt(0).sum().clamp_min(1))
    return torch.stack(terms).mean()


def soft_margin_loss(first: Tensor, second: Tensor, alpha: float, hardest: bool = False) -> Tensor:
    """Weighted soft-margin triplet loss (Hu et al. 2018), log(1 + exp(alpha (d_true^2 - d_false^2))) averaged over the batch,
    both ways; arguments as for `triplet_loss`."""
    squared = _squared(first, second)
    terms = [
        F.softplus(alpha * (d.diagonal()[:, None] - _wrong(d, hardest, torch.amin))).mean()
        for d in (squared, squared.T)
    ]
    return torch.stack(terms).mean()


def total_loss(outputs: Mapping[str, tuple[Tensor, Tensor]], places: Tensor, recipe: Recipe) -> Tensor:
    """A recipe's loss for one step.

    Args:
        outputs: for each picture set (satellite, drone, street, google), part embeddings and class scores.
        places: class of each row, the same in every set, (B,).
    """
    loss = torch.zeros((), device=places.device)
    if recipe.instance:
        terms = torch.cat(
            [instance_loss(scores.float(), places, recipe.label_smoothing) for _, scores in outputs.values()]
        )
        loss = loss + recipe.instance * (terms.sum() if recipe.reduction == "sum" else terms.mean())
    if (recipe.infonce or recipe.metric != "none") and "satellite" in outputs:
        described = {name: descriptors(parts.float()) for name, (parts, _) in outputs.items()}
        tiles = described.pop("satellite")
        loss = loss + torch.stack([_between(tiles, others, recipe) for others in described.values()]).mean()
    return loss


def _between(tiles: Tensor, others: Tensor, recipe: Recipe) -> Tensor:
    """The recipe's losses on descriptors of two views."""
    loss = torch.zeros((), device=tiles.device)
    if recipe.infonce:
        loss = loss + recipe.infonce * infonce_loss(tiles, others, recipe.temperature, recipe.label_smoothing)
    hardest = recipe.mining == "hardest"
    if recipe.metric == "contrastive":
        loss = loss + contrastive_loss(tiles, others, recipe.margin, hardest)
    elif recipe.metric == "triplet":
        loss = loss + triplet_loss(tiles, others, recipe.margin, hardest)
    elif recipe.metric == "soft_margin":
        loss = loss + soft_margin_loss(tiles, others, recipe.alpha, hardest)
    return loss


_TINY = 1e-12
"""Below this, the slope of a square root is out of bounds."""


def _squared(first: Tensor, second: Tensor) -> Tensor:
    """Squared distances of unit vectors (B, F) and (B, F): (B, B), 0 .. 4."""
    return 2 - 2 * first @ second.T


def _wrong(table: Tensor, hardest: bool, worst: Callable[..., Tensor]) -> Tensor:
    """Without its diagonal, (B, B) as (B, B - 1); or of each row the worst alone, (B, 1)."""
    b = len(table)
    off = table.flatten()[1:].view(b - 1, b + 1)[:, :-1].reshape(b, b - 1)
    return worst(off, dim=1, keepdim=True) if hardest else off
