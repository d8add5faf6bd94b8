"""Poolings of a network's tokens into a descriptor, by their command-line names; no torch here.

With the tokens F(x) of the cells x of a map (C channels, N cells), and the vector f of the class token:

    mean        e = (1/N) sum_x F(x)
    gem, gem:P  e_c = ((1/N) sum_x max(F_c(x), EPSILON)^P)^(1/P), with P = 3 by default
    cls         e = f
    cls+mean    e = (f, (1/N) sum_x F(x)), one vector of 2C numbers
    rings:N     LPN's N square rings, each the mean of its cells; see `Partition`

GeM is homogeneous of degree 1, so by Euler's theorem e_c is the sum over the cells of F_c(x) de_c/dF_c(x). That is a mean of
F_c(x)^P m_c^(1/P - 1) over the cells, with the power mean m_c = (1/N) sum_x F_c(x)^P held at its value for the picture.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Any, Literal, cast

from lpn.core.errors import InputError
from lpn.core.files import printable
from lpn.core.images import Triple
from lpn.core.views import VIEWS
from lpn.models.contract import AccountLevel, Contract, part_names
from lpn.models.partition import Partition

PoolingName = Literal["mean", "gem", "cls", "cls+mean", "rings"]
FORMS = "mean, gem, gem:POWER, cls, cls+mean, or rings:N"
# Lower bound of a token's number in GeM, whose power needs positive numbers.
EPSILON = 1e-6
_MOST_RINGS, _POWERS = 64, (0.5, 100.0)
# Held values in the account of each pooling.
_HELD = {"gem": "the power means of GeM (Euler's split of its power)", "cls+mean": "the class token"}
_WRITTEN = re.compile(r"(mean|cls|cls\+mean)|(gem)(?::([0-9]+(?:\.[0-9]+)?))?|(rings):([0-9]{1,4})")


@dataclass(frozen=True)
class TokenPooling:
    """A pooling of tokens.

    Attributes:
        name: of the pooling.
        rings: the number of rings; 1 for other poolings.
        power: P of GeM.
    """

    name: PoolingName = "mean"
    rings: int = 1
    power: float = 3.0

    @classmethod
    def parse(cls, text: str) -> TokenPooling:
        """Parse a user's pooling, such as "rings:4"; InputError if it is none of `FORMS`."""
        match = _WRITTEN.fullmatch(text)
        if match is None:
            raise InputError(f"The pooling is {printable(text)[:40]!r}; expected {FORMS}, such as rings:4.")
        plain, gem, power, _, rings = match.groups()
        if plain:
            return cls(cast(PoolingName, plain))
        if gem:
            value = float(power or cls.power)
            if not _POWERS[0] <= value <= _POWERS[1]:
                raise InputError(f"GeM's power is {power}; expected a number from {_POWERS[0]:g} to {_POWERS[1]:g}.")
            return cls("gem", power=value)
        if not 1 <= int(rings) <= _MOST_RINGS:
            raise InputError(f"The pooling has {int(rings)} rings; expected 1 to {_MOST_RINGS}, such as rings:4.")
        return cls("rings", rings=int(rings))

    def __str__(self) -> str:
        if self.name == "rings":
            return f"rings:{self.rings}"
        return f"gem:{self.power:g}" if self.name == "gem" and self.power != TokenPooling.power else self.name

    @property
    def partition(self) -> Partition | None:
        """The partition of the map into parts; None without cells."""
        if self.name == "cls":
            return None
        return Partition("rings", self.rings) if self.rings > 1 else Partition("whole", 1)

    @property
    def needs_class_token(self) -> bool:
        """Return True if the descriptor contains the class token."""
        return self.name.startswith("cls")

    def contract(
        self, title: str, size: tuple[int, int], channels: int, normalisation: tuple[Triple, Triple], norm: str = ""
    ) -> Contract:
        """Return the contract of a network with this pooling; one branch describes all views.

        Args:
            title: of the network.
            size: (height, width) of pictures.
            channels: of the tokens.
            normalisation: mean and standard deviation.
            norm: the name of a LayerNorm's held values; empty without one.
        """
        held = norm or _HELD.get(self.name, "")
        level: AccountLevel = "exact, with held" if held else "exact"
        names = ("1 class token",) if self.partition is None else tuple(part_names(self.partition))
        return Contract(
            f"{title}, {self}",
            f"{title}, {self}, {size[0]} x {size[1]}",
            VIEWS,
            size,
            len(names),
            2 * channels if self.name == "cls+mean" else channels,
            "one vector" if self.partition is None else level,
            held,
            mean=normalisation[0],
            std=normalisation[1],
            mirror="none",
            partitions={} if self.partition is None else dict.fromkeys(VIEWS, self.partition),
            part_names=dict.fromkeys(VIEWS, names),
        )


def pooled(pooling: TokenPooling, shares: Any, features: Any, first: Any, join: Any) -> tuple[Any, Any, Any]:
    """Pool the tokens of cells, as arrays of NumPy or tensors of torch.

    Args:
        shares: the weight of each cell in each part, (n, h, w).
        features: (B, C, h, w).
        first: the class token (B, C); None without one.
        join: `numpy.concatenate` or `torch.cat`.

    Returns:
        The parts (B, n, D), and their account: a map (B, D, h, w), and constants (B, n, D) or None.
    """

    def means(values: Any) -> Any:
        return shares.reshape(len(shares), -1) @ values.reshape(*values.shape[:2], -1).swapaxes(1, 2)

    if pooling.name == "gem":
        powers = features.clip(EPSILON) ** pooling.power
        parts = means(powers)
        scale = parts ** (1 / pooling.power - 1)
        return parts * scale, powers * scale.swapaxes(1, 2)[..., None], None
    if pooling.name == "cls+mean":
        token = first[:, None]
        return join([token, means(features)], 2), join([features * 0, features], 1), join([token, token * 0], 2)
    return means(features), features, None
