"""Makes `docs/screenshot.png`: `python -m bench.screenshot OUT.png`.

Pictures of real data sets may not be handed on, so the places are drawn here and a small network is trained on them
for a minute, from the backbone weights in LPN_BACKBONE_WEIGHTS where it is set; everything else is the app as it is.
"""

from __future__ import annotations

import os
import shutil
import sys
import tempfile
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from playwright.sync_api import sync_playwright

from bench.page import QUIET, Process, free_port
from lpn.datasets import open_dataset
from lpn.export import export
from lpn.images import Picture, rotate
from lpn.recipes import RECIPES
from lpn.train import Trainer

SIZE = 512
ROOFS = ((158, 150, 140), (182, 178, 172), (150, 92, 72), (120, 116, 118), (205, 200, 190), (134, 108, 92))


def campus(seed: int) -> Picture:
    """A plan view of an invented block: lawn, streets, buildings with shadows, trees."""
    rng = np.random.default_rng(seed)
    ground = np.array([92, 112, 74]) + rng.integers(-14, 15, 3)
    picture = np.empty((SIZE, SIZE, 3), np.float32)
    picture[:] = ground
    coarse = cv2.resize(rng.normal(0, 9, (24, 24)).astype(np.float32), (SIZE, SIZE), interpolation=cv2.INTER_CUBIC)
    picture += coarse[..., None]
    tilt = rng.uniform(-35, 35)
    for axis in (0, 1):
        for at in rng.choice([70, 150, 360, 440], rng.integers(1, 3), replace=False):
            line = [(-200, int(at)), (SIZE + 200, int(at))] if axis else [(int(at), -200), (int(at), SIZE + 200)]
            _street(picture, line, tilt, int(rng.integers(22, 38)))
    shapes = [(256 + rng.integers(-14, 15), 256 + rng.integers(-14, 15), *rng.integers(80, 150, 2))]
    for _ in range(40):
        x, y, w, h = (*rng.integers(10, SIZE - 10, 2), *rng.integers(34, 110, 2))
        if all(abs(x - a) > (w + c) / 2 + 10 or abs(y - b) > (h + d) / 2 + 10 for a, b, c, d in shapes):
            shapes.append((x, y, w, h))
    for x, y, w, h in shapes[: rng.integers(9, 18)]:
        _building(picture, (float(x), float(y)), (float(w), float(h)), tilt, rng)
    for x, y in rng.integers(0, SIZE, (rng.integers(40, 130), 2)):
        radius = int(rng.integers(5, 12))
        cv2.circle(picture, (int(x) + 3, int(y) + 3), radius, (48, 56, 42), -1, cv2.LINE_AA)
        green = (54 + int(rng.integers(0, 22)), 80 + int(rng.integers(0, 26)), 46)
        cv2.circle(picture, (int(x), int(y)), radius, green, -1, cv2.LINE_AA)
    picture += rng.normal(0, 5, picture.shape)
    return np.clip(picture, 0, 255).astype(np.uint8)


def _turned(points: list[tuple[float, float]], degrees: float) -> np.ndarray:
    matrix = cv2.getRotationMatrix2D((SIZE / 2, SIZE / 2), degrees, 1.0)
    return (np.array(points) @ matrix[:, :2].T + matrix[:, 2]).astype(np.int32)


def _street(picture: np.ndarray, line: list[tuple[int, int]], tilt: float, width: int) -> None:
    start, end = (tuple(int(v) for v in point) for point in _turned([(float(a), float(b)) for a, b in line], tilt))
    cv2.line(picture, start, end, (150, 148, 142), width + 8, cv2.LINE_AA)
    cv2.line(picture, start, end, (98, 98, 100), width, cv2.LINE_AA)
    cv2.line(picture, start, end, (170, 168, 150), 1, cv2.LINE_AA)


def _building(
    picture: np.ndarray, at: tuple[float, float], size: tuple[float, float], tilt: float, rng: np.random.Generator
) -> None:
    (x, y), (w, h) = at, (size[0] / 2, size[1] / 2)
    kind = int(rng.integers(3))
    outline = [(x - w, y - h), (x + w, y - h), (x + w, y + h), (x - w, y + h)]
    if kind == 1:
        outline = [(x - w, y - h), (x + w, y - h), (x + w, y), (x, y), (x, y + h), (x - w, y + h)]
    shape, tall = _turned(outline, tilt), int(rng.integers(8, 22))
    cv2.fillPoly(picture, [shape + np.array([tall, tall])], (44, 48, 46), cv2.LINE_AA)
    roof = np.array(ROOFS[int(rng.integers(len(ROOFS)))]) + rng.integers(-10, 11, 3)
    cv2.fillPoly(picture, [shape], roof.tolist(), cv2.LINE_AA)
    cv2.polylines(picture, [shape], True, (roof * 0.75).tolist(), 2, cv2.LINE_AA)
    if kind == 0:
        ridge = _turned([(x - w, y), (x + w, y)], tilt)
        cv2.line(picture, ridge[0].tolist(), ridge[1].tolist(), (roof * 0.7).tolist(), 2, cv2.LINE_AA)
    for _ in range(int(rng.integers(0, 5))):
        centre = _turned([(x + rng.uniform(-0.7, -0.1) * w, y + rng.uniform(-0.8, -0.1) * h)], tilt)[0]
        cv2.rectangle(picture, (centre - 4).tolist(), (centre + 4).tolist(), (218, 218, 214), -1)


def from_drone(picture: Picture, seed: int) -> Picture:
    """The same place, turned, a little off, from nearer, in warmer and dimmer light, seen at a slant."""
    rng = np.random.default_rng(seed)
    turned = rotate(picture, float(rng.uniform(-12, 12)))
    x, y = rng.integers(52, 88, 2)
    near = turned[y : y + 372, x : x + 372]
    corners = np.array([[0, 0], [372, 0], [372, 372], [0, 372]], np.float32)
    slant = corners + np.array([[34, 0], [-34, 0], [-4, 0], [4, 0]], np.float32)
    seen = cv2.warpPerspective(near, cv2.getPerspectiveTransform(slant, corners), (372, 372))
    lit = cv2.GaussianBlur(seen, (0, 0), 1.0) * np.array([1.06, 0.96, 0.84]) * rng.uniform(0.8, 1.1)
    return np.clip(lit + rng.uniform(-8, 18), 0, 255).astype(np.uint8)


def draw(root: Path, train: int = 120, test: int = 60) -> Path:
    """A data set of such places in University-1652's layout."""
    for label in range(1, train + test + 1):
        satellite = campus(label)
        for view, picture in (("satellite", satellite), ("drone", from_drone(satellite, label))):
            folders = [f"train/{view}"] if label <= train else [f"test/query_{view}", f"test/gallery_{view}"]
            for folder in folders:
                path = root / folder / f"{label:04d}" / "picture.jpg"
                path.parent.mkdir(parents=True, exist_ok=True)
                cv2.imwrite(str(path), cv2.cvtColor(picture, cv2.COLOR_RGB2BGR))
    return root


def main() -> None:
    """Draw, train, start the app, and take the picture of a failure."""
    out = Path(sys.argv[1])
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        data = draw(folder / "drawn-places")
        recipe = replace(RECIPES["small"], size=128, epochs=12, batch=24)
        weights = os.environ.get("LPN_BACKBONE_WEIGHTS")
        run = Trainer(open_dataset(data), folder / "run", recipe, init=Path(weights) if weights else None)
        export(run.run(), folder / "lpn-drawn.onnx")
        arguments = [
            "explore",
            "--data",
            str(data),
            "--model",
            str(folder / "lpn-drawn.onnx"),
            "--port",
            str(free_port()),
        ]
        environment = {**os.environ, "LPN_CACHE": str(folder / "cache")}
        app = stack.enter_context(Process([sys.executable, "-m", "lpn.cli", *arguments], environment))
        browser = stack.enter_context(sync_playwright()).chromium.launch(
            executable_path=shutil.which("chromium"), args=QUIET
        )
        page = browser.new_page(viewport={"width": 1456, "height": 835})
        page.goto(app.url)
        page.wait_for_selector("#lpn-status:not([data-seq='0'])", state="attached", timeout=60_000)
        page.wait_for_timeout(2500)
        for notice in page.locator(".mantine-Notification-closeButton").all():
            notice.click()
        page.keyboard.press("f")
        page.wait_for_timeout(2500)
        page.screenshot(path=str(out))
        browser.close()


if __name__ == "__main__":
    main()
