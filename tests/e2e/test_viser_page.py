"""The contract of viser_compat.js: each thing of viser's page that the page's scripts lean on, by its name."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

import pytest
from playwright.sync_api import BrowserContext, Error, Page

from tests.e2e.conftest import ExplorerPage, RunningApp

WEB = Path(__file__).parents[2] / "explorer" / "web" / "js"
# Names of viser and of what it is made of; timers go through `lpn.every`.
OF_VISER = re.compile(r"mantine|tabler|__viser|webgl-software|data-engine|#root\b|\bWorker\b|setInterval|__r3f")


# Milliseconds for what must come, for each name.
WAIT = 60_000
# The kinds of messages that viser's page sends to its worker.
POSTED = """window.posted = [];
const post = Worker.prototype.postMessage;
Worker.prototype.postMessage = function (...all) { posted.push(all[0]?.type); return post.apply(this, all); };"""
# The texts of the page whenever it changes.
HEARD = """() => {
  window.heard = [];
  const hear = () => heard.push(document.body.innerText);
  new MutationObserver(hear).observe(document.body, {childList: true, subtree: true});
}"""
# Selectors that need something to be done first: what is done.
AFTER = {
    "dialog": "lpn.send('glossary')",
    "notification": "lpn.send('story-play', 'no such story')",
}
# Each of them comes with the one above.
WITH = {"dialog": ("dialogTitle", "dialogHeader", "dialogBody", "dialogButton"), "notification": ("notificationText",)}
ALWAYS = (
    *("app", "canvas", "stageFrame", "shade", "window", "folderHead", "unfolded", "scrollRoot", "scrolled", "upload"),
    *("tab", "left", "leftOpen", "softwareNotice"),
)
# On a phone alone.
SHEET = ("sheet", "sheetHead", "sheetParts")
# Conditions on viser's globals, attributes, and controls, which viser_compat.js relies on.
TRUE = {
    "__viserMutable.camera": "lpn.viser.camera().matrixWorld.elements.length === 16",
    "camera.quaternion": "lpn.viser.camera().quaternion.toArray().length === 4",
    "__viserMutable.cameraControl": "'maxPolarAngle' in lpn.viser.cameraControls()",
    "cameraControl.azimuthRotateSpeed": "lpn.viser.cameraControls().azimuthRotateSpeed === 1",
    "cameraControl.polarRotateSpeed": "lpn.viser.cameraControls().polarRotateSpeed === 1",
    "cameraControl.constructor.ACTION": "'SCREEN_PAN' in lpn.viser.cameraControls().constructor.ACTION",
    "cameraControl.mouseButtons": "'left' in lpn.viser.cameraControls().mouseButtons",
    "cameraControl.touches": "'one' in lpn.viser.cameraControls().touches",
    "__viserMutable.sendCamera": "typeof window.__viserMutable.sendCamera === 'function'",
    "__viserMutable.requestRender": "typeof window.__viserMutable.requestRender === 'function'",
    "__viserSceneTree": "lpn.viser.axes().length === 4",
    "label of a control": "lpn.viser.field(lpn.bridge) instanceof HTMLInputElement",
    "opacity of the shade": "lpn.viser.shaded() === false",
    "data-mantine-color-scheme": "document.documentElement.hasAttribute(lpn.viser.SCHEME)",
}


def lacks(page: Page, script: str) -> bool:
    """Return True if a condition does not come true in a page."""
    try:
        page.wait_for_function(f"() => {{ try {{ return {script} }} catch {{ return false }} }}", timeout=WAIT)
    except Error:
        return True
    return False


def missing(page: Page, *names: str) -> list[str]:
    """The names of viser_compat.js whose selectors match nothing in a page."""
    return [name for name in names if lacks(page, f"!!document.querySelector(lpn.viser.SELECTORS.{name})")]


@pytest.mark.parametrize("file", sorted(WEB.glob("*.js")), ids=lambda file: file.name)
def test_viser_is_named_in_one_script(file: Path) -> None:
    lines = enumerate(file.read_text("utf-8").splitlines(), 1)
    named = [f"{file.name}:{number}: {line.strip()}" for number, line in lines if OF_VISER.search(line)]
    assert bool(named) == (file.name == "viser_compat.js"), "\n".join(named)


def test_viser_s_page_is_as_the_scripts_know_it(explorer: ExplorerPage, tmp_path: Path) -> None:
    page = explorer.page
    changed = missing(page, *ALWAYS)
    changed += [name for name, script in TRUE.items() if lacks(page, script)]
    for name, script in AFTER.items():
        page.evaluate(script)
        changed += missing(page, name, *WITH[name])
        page.keyboard.press("Escape")
    page.wait_for_function("() => !lpn.glossary.open()")
    page.keyboard.press("Control+k")
    changed += missing(page, "palette")
    assert not changed, f"viser has changed: {', '.join(changed)}"
    named = {*ALWAYS, *AFTER, *(name for names in WITH.values() for name in names), "palette", *SHEET}
    assert set(page.evaluate("Object.keys(lpn.viser.SELECTORS)")) == named  # each is tried, `SHEET` below
    # An upload is said in viser's words.
    page.keyboard.press("Escape")
    page.wait_for_function("() => !document.querySelector(lpn.viser.SELECTORS.palette)")
    (tmp_path / "no.png").write_bytes(b"no picture")
    page.evaluate("lpn.viser.SELECTORS.notificationText = '#none'")  # else the words are replaced at once
    page.evaluate(HEARD)
    explorer.upload(tmp_path / "no.png")
    assert not lacks(page, "heard.some(text => text.includes(lpn.viser.UPLOADED))")


def test_a_phone_s_panels_are_as_the_scripts_know_them(
    app: RunningApp, contexts: Callable[..., BrowserContext]
) -> None:
    page = contexts(viewport={"width": 390, "height": 844}).new_page()
    page.add_init_script(POSTED)
    ExplorerPage(page).open(app.url)
    assert not missing(page, *SHEET)
    assert "set_server" in page.evaluate("posted")
