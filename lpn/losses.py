"""The losses an LPN is trained with."""

from __future__ import annotations

import math
from collections.abc import Mapping

import torch
import torch.nn.functional as F
from torch import Tensor

from lpn.recipes import Recipe
from lpn.spec import View


def instance_loss(scores: Tensor, places: Tensor, smoothing: float = 0.0) -> Tensor:
    """Cross-entropy over places of each part, averaged over pictures: (n,) (equation 4 of the paper).

    Args:
        scores: class scores (B, n, classes).
        places: class of each picture, (B,).
    """
    n = scores.shape[1]
    targets = places[:, None].expand(-1, n)
    return F.cross_entropy(scores.transpose(1, 2), targets, label_smoothing=smoothing, reduction="none").mean(dim=0)


def contrastive_loss(first: Tensor, second: Tensor, temperature: float, smoothing: float = 0.0) -> Tensor:
    """Symmetric InfoNCE between two views of the same places, on descriptors as retrieval uses them.

    Args:
        first, second: part embeddings (B, n, D); row i of both shows place i, and places differ within the batch.
        temperature: divides the mean cosine over parts.
    """
    n = first.shape[1]
    one, two = (F.normalize(parts, dim=2).flatten(1) / math.sqrt(n) for parts in (first, second))
    similarity = one @ two.T / temperature
    target = torch.arange(len(similarity), device=similarity.device)
    rows, columns = (F.cross_entropy(s, target, label_smoothing=smoothing) for s in (similarity, similarity.T))
    return (rows + columns) / 2


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
    anchor: View = "satellite"
    if recipe.contrastive and anchor in outputs:
        others = [name for name in outputs if name != anchor]
        pairs = [(outputs[anchor][0].float(), outputs[name][0].float()) for name in others]
        pulls = [contrastive_loss(a, b, recipe.temperature, recipe.label_smoothing) for a, b in pairs]
        loss = loss + recipe.contrastive * torch.stack(pulls).mean()
    return loss
