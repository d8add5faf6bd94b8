"""Make the pictures of the app in docs: `python -m tools.bench.screenshot docs [FILE ...]`."""

from __future__ import annotations

import argparse
import os
import sys
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import cv2
import numpy as np
import torch
from playwright.sync_api import Browser, sync_playwright

from lpn.core.arrays import UInt8Array
from lpn.core.demo import DEMO, DEMO_BASELINE, DEMO_MODEL, DEMO_QUERY
from lpn.core.files import write_atomic
from lpn.models.timm_networks import import_timm
from tools.bench.page import ServerProcess
from tools.fixtures import panorama_model, seeded, small_worlds
from tools.fixtures.chromium import launch
from tools.fixtures.processes import free_port

QUALITY, _WORST = 74, 46


@dataclass(frozen=True)
class Shot:
    """One picture.

    Attributes:
        file: its name.
        query: that is shown; the demo's first without one.
        address: what follows it in the address, such as "panel=sweep"; the ranking is plain, or as a place of the demo opens.
        keys: pressed in succession.
        baseline: whether the baseline answers.
        beside: whether the baseline is offered for comparison.
        vit: whether a DINOv2 ViT-S/14 with seeded weights answers by its rings, and the demo's LPN is offered for comparison.
        demo: whether all places of the demo are offered, in place of the city.
        strips: whether an untrained SAFA with LPN's strips answers panoramas of drawn places.
        size: of the window, in pixels.
        light: the colours.
        hover: a selector of what the pointer is over.
        own: whether a photo of the city is handed over as an own one.
    """

    file: str
    query: str = ""
    address: str = ""
    keys: str = ""
    baseline: bool = False
    beside: bool = False
    vit: bool = False
    demo: bool = False
    strips: bool = False
    size: tuple[int, int] = (1456, 835)
    light: bool = False
    hover: str = ""
    own: bool = False


SHOTS = (
    Shot("screen.webp", demo=True, size=(1440, 900)),
    Shot("screen-light.webp", demo=True, light=True),
    Shot("screen-phone.webp", demo=True, size=(390, 664)),
    Shot("screen-missed.webp", "0449/05", demo=True),
    Shot("screen-ring.webp", demo=True, hover="#rows [data-part='2']"),
    Shot("screen-apart.webp", address="view=apart", keys="g", demo=True),
    Shot("screen-own.webp", demo=True, own=True),
    Shot("screen-strips.webp", strips=True),
    Shot("laboratory.webp", "0449/05", "panel=lab", demo=True),
    Shot("why.webp", address="panel=why", demo=True),
    Shot("success.webp", DEMO_QUERY, keys="g"),
    Shot("twin-n1.webp", "0447/07", baseline=True),
    Shot("twin-n4.webp", "0447/07"),
    Shot("failure.webp", "0449/05"),
    Shot("failure-map.webp", "0449/05", keys="g"),
    Shot("story-context.webp", "0445/05", "panel=compare", beside=True),
    Shot("story-turn.webp", "0334/08", "panel=sweep&sweep=rotation"),
    Shot("story-constant.webp", "0381/02", "shows=evidence"),
    Shot("dinov2-beside-lpn.webp", "0445/05", "panel=compare&shows=evidence", vit=True),
    Shot("flight.webp", "LPN_0106.webp", "show=flight&panel=flight&flight_over=swipe", demo=True),
)


def _encoded(picture: UInt8Array, before: Path) -> bytes:
    """Encode a picture as a WebP that is no larger than the one that it replaces, as far as a quality of `_WORST` allows."""
    for quality in range(QUALITY, _WORST - 1, -2):
        data = cv2.imencode(".webp", picture, [cv2.IMWRITE_WEBP_QUALITY, quality])[1].tobytes()
        if not before.exists() or len(data) <= before.stat().st_size:
            break
    return data


def main() -> None:
    """Start the app with each model, open it, take the pictures."""
    parser = argparse.ArgumentParser(description="Take the pictures of the docs from the app.")
    parser.add_argument("folder", type=Path, help="of the pictures; those that are there are replaced")
    parser.add_argument(
        "names", nargs="*", metavar="NAME", help="of the pictures to take, such as flight.webp; all by default"
    )
    given = parser.parse_args()
    if unknown := sorted(set(given.names) - {shot.file for shot in SHOTS}):
        parser.error(f"There is no picture {unknown[0]}; expected some of {', '.join(shot.file for shot in SHOTS)}.")
    with ExitStack() as stack:
        browser = launch(stack.enter_context(sync_playwright()))
        for shot in SHOTS:
            if not given.names or shot.file in given.names:
                _take(browser, shot, given.folder)
        browser.close()


def _take(browser: Browser, shot: Shot, out: Path) -> None:
    with TemporaryDirectory() as folder:
        model, data = str(DEMO_BASELINE if shot.baseline else DEMO_MODEL), DEMO
        if shot.vit:
            model = _seeded_vit(Path(folder))
        if shot.strips:
            model, data = str(panorama_model.write(Path(folder))), small_worlds.make_cvusa(Path(folder) / "pairs", 12)
        beside = DEMO_MODEL if shot.vit else DEMO_BASELINE if shot.beside else None
        command = [sys.executable, "-m", "lpn", "explore", "--port", str(free_port())]
        command += [] if shot.demo else [str(data), "--model", model]
        command += ["--pooling", "rings:4"] if shot.vit else []
        command += [] if beside is None else ["--beside", str(beside)]
        with ServerProcess(command, dict(os.environ)) as app:
            _open(browser, app.url, shot, out)


def _seeded_vit(folder: Path) -> str:
    """Write a DINOv2 ViT-S/14 of timm with seeded weights, for 126 x 126 pixels; return it as a value of --model."""
    name = "vit_small_patch14_dinov2"
    network = import_timm().create_model(name)
    shapes = {entry: list(tensor.shape) for entry, tensor in network.state_dict().items()}
    torch.save(seeded.entries(shapes), folder / "dinov2.pth")
    (folder / "opts.yaml").write_text("h: 126\nw: 126\n")
    return f"timm:{name}:{folder / 'dinov2.pth'}"


def _open(browser: Browser, url: str, shot: Shot, out: Path) -> None:
    width, height = shot.size
    context = browser.new_context(
        viewport={"width": width, "height": height},
        color_scheme="light" if shot.light else "dark",
        device_scale_factor=2 if width < 700 else 1,
    )
    page = context.new_page()
    query, scoring = f"query={shot.query}" if shot.query else "", "" if shot.demo or shot.strips else "scoring=plain"
    page.goto(f"{url}/?{'&'.join(filter(None, (query, scoring, shot.address)))}")
    for key in ("", *shot.keys):
        if key:
            page.keyboard.press(key)
        page.wait_for_selector("body[data-sequence]:not(.wait):not(.turning)", timeout=600_000)
        page.wait_for_timeout(15_000)  # the scene, the curve, and what a panel computes
    if shot.own:
        page.set_input_files("#file", DEMO / "test" / "query_drone" / "0394" / "image-02.webp")
        page.wait_for_timeout(6000)
    if shot.hover:
        page.hover(shot.hover)
        page.wait_for_timeout(1000)
    with TemporaryDirectory() as folder:
        file = Path(folder) / "page.png"
        page.screenshot(path=str(file))
        shown = cv2.imread(str(file))
        assert shown is not None
        write_atomic(out / shot.file, _encoded(np.asarray(shown, np.uint8), out / shot.file))
    context.close()


if __name__ == "__main__":
    main()
