"""Training of an LPN (section III-C of the paper) by a recipe, resumable to the same losses."""

from __future__ import annotations

import copy
import csv
import io
import json
import math
import pickle
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn
from torch import Tensor

from lpn import checkpoints, images
from lpn.augment import augment, place_draw
from lpn.backbones import CHANNELS
from lpn.datasets import Dataset
from lpn.errors import InputError, ModelFileError
from lpn.evaluate import evaluate
from lpn.files import check_writable, write_whole
from lpn.losses import total_loss
from lpn.network import LPN
from lpn.places import Places
from lpn.recipes import Recipe
from lpn.spec import ModelSpec, View

Row = dict[str, float]


class Trainer:
    """One training run in a folder: `last.safetensors`, `state.pt` to resume from, and `log.csv`.

    Args:
        dataset: in University-1652's layout.
        out: the run's folder.
        recipe: every number of the training.
        init: weights for the backbone, loaded as far as they go.
        resume: go on from the last whole epoch in `out`, to the same losses as an uninterrupted run.
        evaluate_every: test every so many epochs; 0 for the end only.

    Raises:
        DataError: when the data set cannot be trained on.
        InputError: when `out` holds another run, or there is nothing to resume.
        ModelFileError: when `init` cannot be used.
        OutputError: when nothing can be written to `out`.
    """

    def __init__(
        self,
        dataset: Dataset,
        out: Path,
        recipe: Recipe,
        init: Path | None = None,
        resume: bool = False,
        evaluate_every: int = 0,
        console: Console | None = None,
    ) -> None:
        self.console = console or Console()
        self.dataset, self.out, self.recipe, self.evaluate_every = dataset, out, recipe, evaluate_every
        self.places = Places(dataset, self.console, recipe.google)
        self.device = checkpoints.best_device()
        self.bfloat16 = recipe.precision == "bfloat16" or (recipe.precision == "auto" and _has_bfloat16(self.device))
        if len(self.places) < recipe.batch:
            raise InputError(
                f"There are {len(self.places)} places and a batch of {recipe.batch}; set --batch to at most that."
            )
        there = [name for name in ("state.pt", "last.safetensors", "log.csv") if (out / name).exists()]
        if not resume and there:
            raise InputError(
                f"{out} holds {there[0]} of a training run already; add --resume to go on with it, or choose another --out."
            )
        if evaluate_every < 0:
            raise InputError(f"The figures are asked for every {evaluate_every} epochs; expected 0 or more.")
        check_writable(out / "last.safetensors")
        torch.manual_seed(recipe.seed)
        self.network = LPN(_spec(recipe, self.places))
        if init is not None and not resume:
            self._load_init(init)
        self.network.to(self.device, memory_format=torch.channels_last)  # type: ignore[call-overload]
        self.average = copy.deepcopy(self.network) if recipe.ema else None
        self.optimizer = _optimizer(self.network, recipe)
        self.rates = [float(group["lr"]) for group in self.optimizer.param_groups]
        self.history: list[Row] = []
        self._places_digest = self.places.digest(dataset.root)
        if resume:
            self._resume()

    @property
    def steps(self) -> int:
        """Steps per epoch."""
        return len(self.places) // self.recipe.batch

    def run(self) -> Path:
        """Train to the last epoch, evaluate, and return the path of the model.

        Raises:
            InputError: when the loss is no longer a number.
        """
        columns = (
            TextColumn("{task.description}"),
            BarColumn(),
            TextColumn("{task.fields[said]}"),
            TimeRemainingColumn(),
        )
        epochs = self.recipe.epochs
        with Progress(*columns, console=self.console) as bar:
            done = len(self.history)
            task = bar.add_task("Training", total=epochs * self.steps, completed=done * self.steps, said="")
            for epoch in range(done, epochs):
                bar.update(task, description=f"Epoch {epoch + 1}/{epochs}")
                self.history.append(self._epoch(epoch, lambda said: bar.update(task, advance=1, said=said)))
                self._save()
                if self.evaluate_every and (epoch + 1) % self.evaluate_every == 0 and epoch + 1 < epochs:
                    self._test(bar.console)
        if not any(key.startswith("recall@1 ") for key in self.history[-1]):
            self._test(self.console)
        return self.out / "last.safetensors"

    def _epoch(self, epoch: int, report: Any) -> Row:
        self.network.train()
        # Seeded by epoch, so that a resumed run repeats what an uninterrupted one does.
        torch.manual_seed(self.recipe.seed * 100_003 + epoch)
        started, total, seen = time.perf_counter(), 0.0, 0
        for step, (sets, places) in enumerate(self._batches(epoch)):
            rate = self._set_rate(epoch * self.steps + step)
            autocast = torch.autocast(self.device.type, torch.bfloat16) if self.bfloat16 else nullcontext()
            with autocast:
                outputs = self._forward(sets)
            loss = total_loss(outputs, places, self.recipe)
            value = float(loss.detach())
            if not math.isfinite(value):
                raise self._diverged(f"The loss became {value}", epoch, step)
            self.optimizer.zero_grad(set_to_none=True)
            loss.backward()  # type: ignore[no-untyped-call]
            self.optimizer.step()
            self._follow(epoch * self.steps + step)
            total += value
            seen += len(places) * len(sets)
            speed = seen / (time.perf_counter() - started)
            report(f"loss {total / (step + 1):.3f}  {speed:.1f} images/s")
        if not all(bool(torch.isfinite(tensor).all()) for tensor in self.network.state_dict().values()):
            raise self._diverged("A weight is no longer a number", epoch, self.steps - 1)
        seconds = time.perf_counter() - started
        return {
            "epoch": epoch + 1,
            "loss": total / self.steps,
            "lr": rate,
            "seconds": seconds,
            "images_per_second": seen / seconds,
        }

    def _diverged(self, found: str, epoch: int, step: int) -> InputError:
        kept = f"{self.out} keeps the model of epoch {epoch}; " if epoch else ""
        return InputError(
            f"{found} in epoch {epoch + 1}, step {step + 1}; {kept}start again with a smaller --lr in another --out."
        )

    def _forward(self, sets: dict[str, Tensor]) -> dict[str, tuple[Tensor, Tensor]]:
        """Embeddings and scores of each set.

        Each set is a batch of its own, as published, or those that share weights and partition are one: BatchNorm then
        sees them together.
        """
        outputs: dict[str, tuple[Tensor, Tensor]] = {}
        spec = self.network.spec
        groups = spec.groups()
        batches: dict[object, list[str]] = {}
        for name in sets:
            key = next(g for g in groups if branch_of(name) in g) if self.recipe.joint_views else name
            batches.setdefault(key, []).append(name)
        for names in batches.values():
            embeddings, scores = self.network(torch.cat([sets[name] for name in names]), branch_of(names[0]))
            sizes = [len(sets[name]) for name in names]
            for name, e, s in zip(names, embeddings.split(sizes), scores.split(sizes), strict=True):
                outputs[name] = (e, s)
        return outputs

    def _batches(self, epoch: int) -> Iterator[tuple[dict[str, Tensor], Tensor]]:
        """One epoch's steps; the next batch is prepared while the caller computes."""
        order = np.random.default_rng([self.recipe.seed, epoch]).permutation(len(self.places))
        chunks = [order[i * self.recipe.batch : (i + 1) * self.recipe.batch] for i in range(self.steps)]
        with ThreadPoolExecutor(1) as pool:
            ahead = pool.submit(self._batch, chunks[0], epoch)
            for position in range(len(chunks)):
                sets, places = ahead.result()
                if position + 1 < len(chunks):
                    ahead = pool.submit(self._batch, chunks[position + 1], epoch)
                yield {name: pictures.to(self.device) for name, pictures in sets.items()}, places.to(self.device)

    def _batch(self, chunk: Any, epoch: int) -> tuple[dict[str, Tensor], Tensor]:
        sets: dict[str, list[Any]] = {name: [] for name in self.places.files}
        for place in chunk:
            rng = np.random.default_rng([self.recipe.seed, epoch, int(place)])
            angle, mirror = place_draw(self.recipe, rng)
            for name, files in self.places.files.items():
                path = files[place][int(rng.integers(len(files[place])))]
                panorama = self.dataset.panoramas and name == "street"
                picture = augment(self.places.picture(path), self.recipe, rng, angle, mirror, branch_of(name), panorama)
                sets[name].append(images.normalise(picture))
        batch = {
            name: torch.from_numpy(np.stack(pictures)).contiguous(memory_format=torch.channels_last)
            for name, pictures in sets.items()
        }
        return batch, torch.from_numpy(np.asarray(chunk, dtype=np.int64))

    def _set_rate(self, step: int) -> float:
        recipe = self.recipe
        factor = min(1.0, (step + 1) / max(recipe.warmup_epochs * self.steps, 1))
        if recipe.schedule == "cosine":
            factor *= 0.5 * (1 + math.cos(math.pi * step / (recipe.epochs * self.steps)))
        elif step >= recipe.decay_epoch * self.steps:
            factor *= 0.1
        for group, rate in zip(self.optimizer.param_groups, self.rates, strict=True):
            group["lr"] = rate * factor
        return self.rates[-1] * factor

    @torch.no_grad()
    def _follow(self, step: int) -> None:
        """Move the average towards the weights, faster at the start."""
        if self.average is None:
            return
        share = 1 - min(self.recipe.ema, (1 + step) / (10 + step))
        for mean, value in zip(self.average.state_dict().values(), self.network.state_dict().values(), strict=True):
            if mean.is_floating_point():
                mean.lerp_(value, share)
            else:
                mean.copy_(value)

    def _test(self, console: Console) -> None:
        """Recall@1 of every task the test split offers, printed with the protocol and noted in the log."""
        model = checkpoints.load_torch(self.out / "last.safetensors", self.device)
        row: Row = {}
        for task in self.dataset.tasks():
            if set(task.split("-to-")) <= set(model.views):
                result = evaluate(model, self.dataset, task, cached=False)
                recall = result.recall
                console.print(
                    f"{task}: R@1 {recall['1']:.2f}  R@5 {recall['5']:.2f}  R@10 {recall['10']:.2f}  "
                    f"R@1% {recall['1%']:.2f}  AP {result.ap:.2f}  ({result.queries} queries, {result.gallery} tiles)"
                )
                row |= {f"recall@1 {task}": recall["1"], f"ap {task}": result.ap}
        if row:
            console.print(result.said)
            self.history[-1] |= row
            self._save()

    def _load_init(self, init: Path) -> None:
        filled, total, missing = checkpoints.load_backbone(self.network, init)
        rest = f"; not or not wholly in it, so as initialised: {', '.join(missing)}" if missing else ""
        self.console.print(f"{init.name} fills {filled} of the backbone's {total} tensors{rest}.")

    def _save_model(self, path: Path) -> None:
        metadata = {
            "recipe": self.recipe.to_json(),
            "epochs": str(len(self.history)),
            "data": self.dataset.root.resolve().name,
        }
        checkpoints.save(self.average or self.network, path, metadata)

    def _save(self) -> None:
        """Model, log, and last the state, which is what a resumed run trusts."""
        self._save_model(self.out / "last.safetensors")
        keys = list(dict.fromkeys(key for row in self.history for key in row))
        log = io.StringIO()
        writer = csv.DictWriter(log, keys)
        writer.writeheader()
        writer.writerows(self.history)
        write_whole(self.out / "log.csv", log.getvalue().encode())
        state = {
            "recipe": self.recipe.to_json(),
            "places": self._places_digest,
            "history": json.dumps(self.history),
            "network": self.network.state_dict(),
            "average": self.average.state_dict() if self.average is not None else {},
            "optimizer": self.optimizer.state_dict(),
        }
        whole = io.BytesIO()
        torch.save(state, whole)
        write_whole(self.out / "state.pt", whole.getvalue())

    def _resume(self) -> None:
        path = self.out / "state.pt"
        if not path.is_file():
            raise InputError(f"There is no state.pt in {self.out} to resume from; start without --resume.")
        try:
            state: Any = torch.load(path, map_location=self.device, weights_only=True)
            saved = json.loads(state["recipe"])
            history, places = json.loads(state["history"]), state["places"]
        except (pickle.UnpicklingError, RuntimeError, EOFError, KeyError, ValueError, TypeError) as error:
            raise ModelFileError(
                f"{path} is damaged; start the run again without --resume, in another --out."
            ) from error
        differs = [k for k, v in json.loads(self.recipe.to_json()).items() if saved.get(k) != v]
        if differs:
            raise InputError(
                f"The run in {self.out} was started with another {', '.join(differs)}; resume it with the same."
            )
        if places != self._places_digest:
            raise InputError(
                f"The run in {self.out} was started with other training pictures; give the same --data, or start anew in "
                "another --out."
            )
        try:
            self.network.load_state_dict(state["network"])
            if self.average is not None:
                self.average.load_state_dict(state["average"])
            self.optimizer.load_state_dict(state["optimizer"])
        except (RuntimeError, ValueError, KeyError) as error:
            raise ModelFileError(
                f"{path} does not fit its own recipe, so it is damaged; start anew in another --out."
            ) from error
        self.history = cast("list[Row]", history)
        self.console.print(f"Going on after epoch {len(self.history)} of {self.recipe.epochs}.")


def branch_of(name: str) -> View:
    """The view whose branch a set of pictures goes through."""
    return "street" if name == "google" else cast(View, name)


def _spec(recipe: Recipe, places: Places) -> ModelSpec:
    spec = ModelSpec(
        backbone=recipe.backbone,
        last_layer=recipe.last_layer,
        views=places.views,
        shared=recipe.shared and "drone" in places.views,
        n_parts=recipe.n_parts,
        layout=recipe.layout,
        weighting=recipe.weighting,
        classes=len(places),
        dropout=recipe.dropout,
        input_size=recipe.input_size,
        pooling=recipe.pooling,
        maps=recipe.maps,
        polar=recipe.polar,
    )
    if recipe.pooling == "safa":
        return replace(spec, embedding=spec.maps * CHANNELS[spec.backbone, spec.last_layer])
    return spec


def _optimizer(network: LPN, recipe: Recipe) -> torch.optim.Optimizer:
    """Two groups: the backbones at their lower rate, then the heads."""
    backbone = {id(p): p for view in network.spec.views for p in network.branch(view).model.parameters()}
    heads = [p for p in network.parameters() if id(p) not in backbone]
    groups = [
        {"params": list(backbone.values()), "lr": recipe.lr * recipe.backbone_ratio},
        {"params": heads, "lr": recipe.lr},
    ]
    if recipe.optimizer in ("adam", "adamw"):
        kind = torch.optim.AdamW if recipe.optimizer == "adamw" else torch.optim.Adam
        return kind(groups, weight_decay=recipe.weight_decay)
    return torch.optim.SGD(groups, momentum=0.9, nesterov=True, weight_decay=recipe.weight_decay)


def _has_bfloat16(device: torch.device) -> bool:
    """Whether bfloat16 arithmetic is in the hardware; emulated, it would be slower than float32."""
    if device.type == "cuda":
        return bool(torch.cuda.is_bf16_supported(including_emulation=False))
    return bool(torch.cpu._is_avx512_bf16_supported())
