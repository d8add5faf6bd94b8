"""Makes the pictures in `docs/`: `python -m bench.screenshot docs BASELINE.onnx`, the demo's three stories (docs/demo.md).

BASELINE is the demo's network with n = 1; without it, the picture that needs it is left as it is.
"""

from __future__ import annotations

import os
import shutil
import sys
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import cv2
from playwright.sync_api import Browser, sync_playwright

from bench.page import QUIET, Process, free_port
from lpn.commands.using import DEMO, DEMO_QUERY
from lpn.files import write_whole

QUALITY = 84


@dataclass(frozen=True)
class Shot:
    """One picture: of which query, after which keys, and whether by the baseline."""

    file: str
    query: str
    keys: str = ""
    baseline: bool = False


SHOTS = (
    Shot("success.jpg", DEMO_QUERY, "m"),
    Shot("twin-n1.jpg", "0447/07", baseline=True),
    Shot("twin-n4.jpg", "0447/07"),
    Shot("failure.jpg", "0449/05"),
    Shot("failure-map.jpg", "0449/05", "m"),
)


def main() -> None:
    """Start the app with each model, open it, take the pictures."""
    out = Path(sys.argv[1])
    models = [(False, DEMO / "lpn.onnx"), *((True, Path(argument)) for argument in sys.argv[2:3])]
    with ExitStack() as stack:
        browser = stack.enter_context(sync_playwright()).chromium.launch(
            executable_path=shutil.which("chromium"), args=QUIET
        )
        for baseline, model in models:
            for shot in SHOTS:
                if shot.baseline == baseline:
                    _take(browser, shot, model, out)
        browser.close()


def _take(browser: Browser, shot: Shot, model: Path, out: Path) -> None:
    command = [sys.executable, "-m", "lpn.cli", "explore", "--data", str(DEMO), "--model", str(model)]
    with Process([*command, "--query", shot.query, "--port", str(free_port())], dict(os.environ)) as app:
        _open(browser, app.url, shot, out)


def _open(browser: Browser, url: str, shot: Shot, out: Path) -> None:
    page = browser.new_page(viewport={"width": 1456, "height": 835})
    page.add_init_script("localStorage.setItem('lpn-tour', 'seen')")
    page.goto(url)
    page.wait_for_selector("#lpn-status:not([data-seq='0'])", state="attached", timeout=60_000)
    page.wait_for_timeout(4000)
    for notice in page.locator(".mantine-Notification-closeButton").all():
        notice.click()
    page.wait_for_timeout(1000)
    for key in shot.keys:
        page.keyboard.press(key)
        page.wait_for_timeout(6000)
    with TemporaryDirectory() as folder:
        file = Path(folder) / "page.png"
        page.screenshot(path=str(file))
        data = cv2.imencode(".jpg", cv2.imread(str(file)), [cv2.IMWRITE_JPEG_QUALITY, QUALITY])[1].tobytes()
    write_whole(out / shot.file, data)
    page.close()


if __name__ == "__main__":
    main()
