"""Makes the pictures in `docs/`: `python -m bench.screenshot docs`, the demo's failure NAME as pair and as map."""

from __future__ import annotations

import os
import shutil
import sys
from contextlib import ExitStack
from pathlib import Path

from playwright.sync_api import sync_playwright

from bench.page import QUIET, Process, free_port

NAME = "0156/02"


def main() -> None:
    """Start the app, open it, take the pictures."""
    out = Path(sys.argv[1])
    with ExitStack() as stack:
        command = [sys.executable, "-m", "lpn.cli", "explore", "--port", str(free_port())]
        app = stack.enter_context(Process(command, dict(os.environ)))
        browser = stack.enter_context(sync_playwright()).chromium.launch(
            executable_path=shutil.which("chromium"), args=QUIET
        )
        page = browser.new_page(viewport={"width": 1456, "height": 835})
        page.goto(app.url)
        page.wait_for_selector("#lpn-status:not([data-seq='0'])", state="attached", timeout=60_000)
        page.wait_for_timeout(2500)
        for notice in page.locator(".mantine-Notification-closeButton").all():
            notice.click()
        row = page.locator('label:text-is("Find name")').locator("xpath=ancestor::div[contains(@class,'Flex')][1]")
        row.locator("input").last.fill(NAME)
        page.wait_for_timeout(1000)
        row.locator("input").last.blur()
        page.wait_for_timeout(2000)
        page.screenshot(path=str(out / "screenshot.png"))
        page.keyboard.press("m")
        page.wait_for_timeout(3500)
        page.screenshot(path=str(out / "map.png"))
        browser.close()


if __name__ == "__main__":
    main()
