"""Compare vision transformers with the released code of their libraries, at full size and with seeded weights.

    python -m tools.released_vits                      # needs the package transformers beside this project's
    python -m tools.released_vits --hub DINOV2 DINOV3  # and with checkouts of both repositories of torch.hub

prints a row of a table for each network: the worst difference of its descriptors before normalisation, relative to the largest
value of each part, over the poolings mean, gem, cls, cls+mean, and rings:4, and over two sizes of pictures.
"""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
import tyro

import lpn
from lpn.core.arrays import AnyArray
from lpn.models.partition import Partition
from lpn.models.timm_networks import import_timm
from tools.fixtures import seeded
from tools.fixtures.published_models import relative_by_part

# Tokens of the cells (B, N, C), and the vector of the class token (B, C).
Answer = tuple[torch.Tensor, torch.Tensor]
_TRANSFORMERS: dict[str, tuple[str, dict[str, Any]]] = {
    "DINOv2 ViT-S/14": ("Dinov2", {"hidden_size": 384, "num_attention_heads": 6, "patch_size": 14, "image_size": 518}),
    "DINOv2 ViT-B/14, registers": ("Dinov2WithRegisters", {"patch_size": 14, "image_size": 518}),
    "DINOv3 ViT-S/16": ("DINOv3ViT", {"num_register_tokens": 4, "image_size": 224}),
    "DINOv3 ViT-S+/16": (
        "DINOv3ViT",
        {"num_register_tokens": 4, "image_size": 224, "use_gated_mlp": True, "hidden_act": "silu"},
    ),
    "ViT-B/16": ("ViT", {}),
    "CLIP ViT-B/16": ("CLIPVision", {"patch_size": 16}),
    "CLIP ViT-B/32": ("CLIPVision", {}),
    "SigLIP ViT-B/16": ("SiglipVision", {}),
}
# Cells of the pictures along both sides: a square of another size than the training's, and a rectangle.
_GRIDS = ((9, 9), (12, 6))


@dataclass
class PeerOptions:
    """The networks and settings to compare."""

    hub: tuple[Path, ...] = field(default=())
    """Checkouts of facebookresearch/dinov2 and facebookresearch/dinov3."""


def main() -> None:
    options = tyro.cli(PeerOptions)
    import_timm()
    worst = 0.0
    for library, networks in (("transformers", _of_transformers()), ("torch.hub", _of_hub(*options.hub))):
        for name, patch, answer, write in networks:
            errors = [_error(patch, grid, answer, write) for grid in _GRIDS]
            worst = max(worst, *errors)
            print(f"| {name} | {library} | {max(errors):.1e} |", flush=True)
    print(f"The worst of all is {worst:.1e}.")


def _error(
    patch: int, grid: tuple[int, int], answer: Callable[[torch.Tensor], Answer], write: Callable[[Path], Path]
) -> float:
    size = (grid[0] * patch, grid[1] * patch)
    pictures = seeded.pictures(3, 2, *size)
    with torch.inference_mode():
        cells, first = (values.numpy() for values in answer(torch.from_numpy(pictures)))
    errors = []
    with tempfile.TemporaryDirectory() as folder:
        file = write(Path(folder))
        (Path(folder) / "opts.yaml").write_text(f"h: {size[0]}\nw: {size[1]}\n")
        for pooling, expected in _expected(cells, first, grid).items():
            model = lpn.load(file, "cpu", pooling=pooling)
            errors.append(relative_by_part(model.part_embeddings(pictures, "drone"), expected))
    return max(errors)


def _expected(cells: AnyArray, first: AnyArray, grid: tuple[int, int]) -> dict[str, AnyArray]:
    weights = Partition("rings", 4).weights(*grid).reshape(4, -1)
    mean = cells.mean(1)
    return {
        "mean": mean[:, None],
        "gem": ((np.maximum(cells, 1e-6).astype(np.float64) ** 3).mean(1) ** (1 / 3))[:, None],
        "cls": first[:, None],
        "cls+mean": np.concatenate([first, mean], 1)[:, None],
        "rings:4": np.einsum("nx,bxc->bnc", weights, cells),
    }


def _seeded(network: Any) -> dict[str, torch.Tensor]:
    """Fill a network with weights that depend on their names, except for constants; return its entries."""
    own = network.state_dict()
    state = seeded.entries(
        {key: list(value.shape) for key, value in own.items() if not key.endswith(("periods", "bias_mask"))}
    )
    for key, value in own.items():
        if key.endswith("bias_mask"):
            third = len(value) // 3
            state[key] = torch.cat([torch.ones(third), torch.zeros(third), torch.ones(third)])
        elif key.endswith("periods"):
            state[key] = value
    network.load_state_dict(state)
    network.eval()
    return state


def _of_transformers() -> Iterator[tuple[str, int, Callable[[torch.Tensor], Answer], Callable[[Path], Path]]]:
    import transformers  # type: ignore[import-not-found]

    for name, (kind, values) in _TRANSFORMERS.items():
        configuration = getattr(transformers, f"{kind}Config")(**values)
        network = getattr(transformers, f"{kind}Model")(configuration)
        _seeded(network)
        front = 0 if "Siglip" in kind else 1 + getattr(configuration, "num_register_tokens", 0)

        def answer(pictures: torch.Tensor, network: Any = network, kind: str = kind, front: int = front) -> Answer:
            resampling = (
                {} if kind.startswith("DINO") or kind.startswith("Dino") else {"interpolate_pos_encoding": True}
            )
            output = network(pictures, **resampling)
            tokens = output.last_hidden_state
            return tokens[:, front:], output.pooler_output if kind.endswith("Vision") else tokens[:, 0]

        def write(folder: Path, network: Any = network) -> Path:
            network.save_pretrained(folder)
            return folder

        yield name, configuration.patch_size, answer, write


def _of_hub(
    second: Path | None = None, third: Path | None = None
) -> Iterator[tuple[str, int, Callable[[torch.Tensor], Answer], Callable[[Path], Path]]]:
    networks: dict[str, Callable[[], Any]] = {}
    if second is not None:
        sys.path.insert(0, str(second))
        from dinov2.models import vision_transformer as dinov2  # type: ignore[import-not-found]

        shared: dict[str, Any] = {"img_size": 518, "patch_size": 14, "init_values": 1.0, "block_chunks": 0}
        networks["DINOv2 ViT-S/14"] = partial(dinov2.vit_small, **shared)
        registers = {"num_register_tokens": 4, "interpolate_antialias": True, "interpolate_offset": 0.0}
        networks["DINOv2 ViT-S/14, registers"] = partial(dinov2.vit_small, **shared, **registers)
    if third is not None:
        sys.path.insert(0, str(third))
        from dinov3.models import vision_transformer as dinov3  # type: ignore[import-not-found]

        shared3: dict[str, Any] = {
            "patch_size": 16,
            "n_storage_tokens": 4,
            "layerscale_init": 1e-5,
            "mask_k_bias": True,
        }
        shared3 |= {"norm_layer": "layernormbf16", "pos_embed_rope_dtype": "fp32"}
        networks["DINOv3 ViT-S/16"] = partial(dinov3.vit_small, ffn_layer="mlp", **shared3)
        networks["DINOv3 ViT-S/16, SwiGLU"] = partial(dinov3.vit_small, ffn_layer="swiglu", **shared3)
    for name, make in networks.items():
        network = make()
        if "DINOv3" in name:
            network.init_weights()
        state = _seeded(network)

        def answer(pictures: torch.Tensor, network: Any = network) -> Answer:
            output = network.forward_features(pictures)
            return output["x_norm_patchtokens"], output["x_norm_clstoken"]

        def write(folder: Path, state: dict[str, torch.Tensor] = state) -> Path:
            torch.save(state, folder / "weights.pth")
            return folder / "weights.pth"

        yield name, int(name.partition("/")[2][:2]), answer, write


if __name__ == "__main__":
    main()
