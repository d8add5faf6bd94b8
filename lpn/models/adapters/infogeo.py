"""InfoGeo: MixVPR's mixing of places over a DINOv2's patch tokens, beside which a learned token of the view stands."""

from __future__ import annotations

import math
from typing import NamedTuple, cast

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from lpn.core.errors import ModelFileError
from lpn.core.views import VIEWS
from lpn.models.adapters.entries import Entries
from lpn.models.adapters.network import Account, PartBranch, on_grid, whole_mean
from lpn.models.adapters.published import PublishedParts, fixed_size, published
from lpn.models.adapters.token_parts import CellsAndClass
from lpn.models.adapters.vit import dinov2, network_of_entries

_EPSILON = 1e-5
_HELD = "the LayerNorms' means and variances and the open ReLUs of the mixing"


class _Mixed(NamedTuple):
    """The result of a mixing layer, and what its equation for these pictures needs.

    Attributes:
        values: (B, C, N).
        scale, offset: of the LayerNorm, (B, C, N) each: the norm of x is scale * x + offset.
        open: 1 for each hidden number that the ReLU lets through, (B, C, hidden).
    """

    values: Tensor
    scale: Tensor
    offset: Tensor
    open: Tensor


class _Mixer(nn.Module):
    """A layer that mixes the N places of each channel: x + W2 ReLU(W1 LayerNorm(x) + b1) + b2."""

    def __init__(self, entries: Entries, places: int) -> None:
        super().__init__()
        self.gain, self.bias = (nn.Buffer(entries.tensor(f"0.{name}", (places,))) for name in ("weight", "bias"))
        self.first, self.first_bias = (nn.Buffer(one) for one in entries.linear("1", places))
        self.second, self.second_bias = (nn.Buffer(one) for one in entries.linear("3", len(self.first_bias)))

    def forward(self, values: Tensor) -> _Mixed:
        variance, mean = torch.var_mean(values, dim=2, correction=0, keepdim=True)
        scale = self.gain / torch.sqrt(variance + _EPSILON)
        normed = F.layer_norm(values, self.gain.shape, self.gain, self.bias, _EPSILON)
        hidden = F.linear(normed, self.first, self.first_bias)
        mixed = values + F.linear(F.relu(hidden), self.second, self.second_bias)
        return _Mixed(mixed, scale, self.bias - scale * mean, (hidden > 0).to(values.dtype))

    def before(self, weights: Tensor, mixed: _Mixed) -> tuple[Tensor, Tensor]:
        """Return the weights of the layer's input, (B, C, R, N), and constants (B, C, R), by those of its output."""
        through = torch.matmul(weights, self.second) * mixed.open.unsqueeze(2)
        inner = torch.matmul(through, self.first)
        constants = torch.matmul(through, self.first_bias) + torch.matmul(weights, self.second_bias)
        constants = constants + (inner * mixed.offset.unsqueeze(2)).sum(3)
        return weights + inner * mixed.scale.unsqueeze(2), constants


class InfoGeo(PartBranch):
    """InfoGeo's vector: a few weighted sums of the mixed places of each channel, under a linear layer over channels.

    With what is held, the mixing is linear in the patch tokens, so each of them has a share in the vector.

    Args:
        trunk: gives the map (B, C, h, w).
        entries: those under `slot_mixvpr.`.
    """

    def __init__(self, trunk: CellsAndClass, entries: Entries, channels: int) -> None:
        super().__init__(trunk.grid)
        places = trunk.grid[0] * trunk.grid[1]
        self.trunk = trunk
        count = entries.count("mix.{}.mix.1.weight")
        self.mixers = nn.ModuleList(_Mixer(entries.under(f"mix.{number}.mix."), places) for number in range(count))
        self.channels, self.channels_bias = (nn.Buffer(one) for one in entries.linear("channel_proj", channels))
        self.rows, self.rows_bias = (nn.Buffer(one) for one in entries.linear("row_proj", places))

    def forward(self, images: Tensor) -> Tensor:
        """Return the vector of pictures: (B, 3, H, W) -> (B, 1, D)."""
        return self._vector(self._layers(self._tokens(images)))

    def account(self, images: Tensor) -> Account:
        """Return the vector and its account, with the mixing's norms and ReLUs held."""
        tokens = self._tokens(images)
        layers = self._layers(tokens)
        weights = self.rows.expand(*tokens.shape[:2], -1, -1)
        constants = tokens.new_zeros(*tokens.shape[:2], len(self.rows))
        for mixer, mixed in zip(reversed(cast("list[_Mixer]", list(self.mixers))), reversed(layers), strict=True):
            weights, further = mixer.before(weights, mixed)
            constants = constants + further
        shares = torch.matmul(self.channels, (weights * tokens.unsqueeze(2)).flatten(2))
        features = on_grid(shares.reshape(tokens.shape[0], -1, tokens.shape[2]), self.grid) * tokens.shape[2]
        rest = torch.matmul(self.channels, constants) + self.channels_bias[:, None] * self.rows.sum(1) + self.rows_bias
        return Account(self._vector(layers), features, whole_mean(features), rest.flatten(1).unsqueeze(1))

    def _tokens(self, images: Tensor) -> Tensor:
        return cast(Tensor, self.trunk(images, False)[0]).flatten(2)

    def _layers(self, tokens: Tensor) -> list[_Mixed]:
        layers: list[_Mixed] = []
        for mixer in self.mixers:
            layers.append(mixer(layers[-1].values if layers else tokens))
        return layers

    def _vector(self, layers: list[_Mixed]) -> Tensor:
        projected = F.linear(layers[-1].values.transpose(1, 2), self.channels, self.channels_bias).transpose(1, 2)
        return F.linear(projected, self.rows, self.rows_bias).flatten(1).unsqueeze(1)


def build_infogeo(entries: Entries) -> PublishedParts:
    """Build InfoGeo on its DINOv2; it describes all views alike.

    Raises:
        ModelFileError: if entries are missing or have wrong shapes, or the network or its pictures are others.
        InputError: if timm is needed and cannot be imported.
    """
    own, head = entries.under("model.backbone.dino_model."), entries.under("slot_mixvpr.")
    places = head.shape("row_proj.weight", 2)[1]
    side = math.isqrt(places)
    patch = own.shape("patch_embed.proj.weight", 4)[2]
    if side * side != places:
        raise ModelFileError(f"In {entries.name}, slot_mixvpr mixes {places} places; expected those of a square map.")
    size = fixed_size(entries, (side * patch, side * patch))
    network = network_of_entries(_with_view_token(own), None, size)
    # The released network has no last norm.
    network.trunk.network.norm = nn.Identity()
    branch = InfoGeo(network.trunk, head, network.channels)
    return published(
        dict.fromkeys(VIEWS, branch),
        "InfoGeo",
        network.title,
        size,
        level="exact, with held",
        held=_HELD,
        embedding=branch.channels.shape[0] * branch.rows.shape[0],
        resize="linear",
        mirror="none",
    )


def _with_view_token(entries: Entries) -> Entries:
    """Return a DINOv2's entries in which the token of the view is a register token, and with a last norm."""
    width = entries.shape("patch_embed.proj.weight", 4)[0]
    state = dict(dinov2(entries).state)
    tokens = [state.pop(key) for key in ("view_token", "pos_view_embed") if key in state]
    if len(tokens) == 1:
        raise ModelFileError(
            f"{entries.name} has one of {entries.prefix}view_token and {entries.prefix}pos_view_embed; expected both or none, so "
            "give a whole checkpoint."
        )
    if tokens:
        state["reg_token"] = torch.stack([token.float().reshape(1, -1, width) for token in tokens]).sum(0)
    state |= {"norm.weight": torch.ones(width), "norm.bias": torch.zeros(width)}
    entries.read.update(id(entries.state[key]) for key in ("view_token", "pos_view_embed") if key in entries.state)
    return Entries(entries.name, state, entries.options, entries.prefix, entries.read)
