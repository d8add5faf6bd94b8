"""Put a former workbench beside today's, at three sizes, dark and light: `python -m tools.bench.before_after FORMER FILE.webp`.

FORMER is a folder with the former version, such as `git archive f93a7db2 | tar x -C FORMER` writes.
"""

from __future__ import annotations

import argparse
import os
import sys
from pathlib import Path

import cv2
import numpy as np
from playwright.sync_api import Browser, sync_playwright

from lpn.core.arrays import UInt8Array
from lpn.core.demo import DEMO_QUERY
from lpn.core.files import write_atomic
from tools.bench.page import ServerProcess
from tools.bench.screenshot import AS_OPENED
from tools.fixtures.chromium import RETURNING, launch
from tools.fixtures.processes import free_port

SIZES = (1440, 900), (1024, 768), (390, 844)
# The room of one picture in pixels, and the space between two.
ROOM, SPACE = (400, 300), 8
MOST_BYTES = 150_000
_PAPER = 128
# `lpn explore` of the version on the path: the installed list of commands names some that a former version lacks.
_EXPLORE = "import tyro; from explorer.cli import Explore; tyro.cli(Explore, config=(tyro.conf.OmitArgPrefixes,)).run()"


def sheet(pictures: list[list[UInt8Array]]) -> UInt8Array:
    """Put rows of pictures on one sheet, each as large as its room allows; (H, W, 3) uint8."""
    rows = []
    for row in pictures:
        cells = [_fitted(picture) for picture in row]
        height = max(cell.shape[0] for cell in cells)
        canvas = np.full((height + SPACE, len(cells) * (ROOM[0] + SPACE), 3), _PAPER, np.uint8)
        for column, cell in enumerate(cells):
            left = column * (ROOM[0] + SPACE) + (ROOM[0] - cell.shape[1]) // 2
            canvas[: cell.shape[0], left : left + cell.shape[1]] = cell
        rows.append(canvas)
    return np.concatenate(rows)[:-SPACE, :-SPACE]


def encoded(picture: UInt8Array) -> bytes:
    """Encode a sheet as WebP, as good as `MOST_BYTES` allows."""
    for quality in range(80, 10, -5):
        data = cv2.imencode(".webp", picture, [cv2.IMWRITE_WEBP_QUALITY, quality])[1].tobytes()
        if len(data) <= MOST_BYTES:
            return data
    raise SystemExit(f"The sheet takes more than {MOST_BYTES:,} bytes at any quality.")


def _fitted(picture: UInt8Array) -> UInt8Array:
    scale = min(ROOM[0] / picture.shape[1], ROOM[1] / picture.shape[0])
    size = round(picture.shape[1] * scale), round(picture.shape[0] * scale)
    return np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA), np.uint8)


def _taken(browser: Browser, url: str, size: tuple[int, int], theme: str) -> UInt8Array:
    context = browser.new_context(viewport={"width": size[0], "height": size[1]}, color_scheme=theme)  # type: ignore[arg-type]
    context.add_init_script(RETURNING.partition("localStorage.setItem('lpn-panels'")[0])
    context.add_init_script(AS_OPENED)
    page = context.new_page()
    page.goto(f"{url}/?query={DEMO_QUERY}&screen=all&theme={theme}", timeout=120_000)
    page.wait_for_selector("#lpn-status:not([data-seq='0'])", state="attached", timeout=600_000)
    page.wait_for_timeout(8000)
    shown = cv2.imdecode(np.frombuffer(page.screenshot(), np.uint8), cv2.IMREAD_COLOR)
    context.close()
    return np.asarray(shown, np.uint8)


def main() -> None:
    """Start both versions on the demo's city, take their pictures, write the sheet."""
    parser = argparse.ArgumentParser(description="Put a former workbench beside today's.")
    parser.add_argument("former", type=Path, help="folder of the former version")
    parser.add_argument("file", type=Path, help="WebP file to write")
    given = parser.parse_args()
    if not (given.former / "explorer").is_dir():
        parser.error(f"{given.former} holds no former version: it lacks the folder explorer.")
    columns: list[list[UInt8Array]] = []
    with sync_playwright() as playwright:
        browser = launch(playwright)
        for theme in ("dark", "light"):
            for root in (given.former.resolve(), Path.cwd()):
                demo = root / "assets" / "demo"
                command = [sys.executable, "-P", "-c", _EXPLORE, "--port", str(free_port())]
                command += ["--data", str(demo), "--model", str(demo / "lpn.onnx")]
                with ServerProcess(command, {**os.environ, "PYTHONPATH": str(root)}) as app:
                    columns.append([_taken(browser, app.url, size, theme) for size in SIZES])
        browser.close()
    write_atomic(given.file, encoded(sheet([list(row) for row in zip(*columns, strict=True)])))


if __name__ == "__main__":
    main()
