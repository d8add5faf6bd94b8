"""A report in a browser: on a screen, on a phone, and on paper."""

from __future__ import annotations

import re
from pathlib import Path

from playwright.sync_api import Browser

import lpn
from lpn import report
from lpn.datasets import open_dataset
from lpn.report import Options
from lpn.tasks.opening import describe_task
from tests.e2e.conftest import empty_context


def test_a_report_needs_nothing_else_fits_a_phone_and_prints_two_pages_a_query(
    browser: Browser, data: Path, model_file: Path, tmp_path: Path
) -> None:
    task, file = describe_task(lpn.load(model_file), "model.onnx", open_dataset(data)), tmp_path / "report.html"
    file.write_bytes(report.build(task, [0, 5], Options()))
    context = empty_context(browser, viewport={"width": 1100, "height": 900}, color_scheme="dark")
    page = context.new_page()
    requests, messages = [], []
    page.on("request", lambda request: requests.append(request.url))
    page.on("console", lambda message: messages.append(message.text))
    page.goto(file.as_uri())
    page.get_by_role("link", name="0012").click()
    assert page.url.endswith("#q2")
    assert {url for url in requests if not url.startswith("data:")} == {file.as_uri()}
    assert messages == []
    assert page.evaluate("[...document.images].every(image => image.complete && image.naturalWidth > 0)")
    dark = page.evaluate("getComputedStyle(document.body).backgroundColor")
    page.emulate_media(media="print")
    assert page.evaluate("getComputedStyle(document.body).backgroundColor") == "rgb(255, 255, 255)" != dark
    printed = page.pdf(prefer_css_page_size=True, print_background=True)
    assert len(re.findall(rb"/Type\s*/Page\b", printed)) == 1 + 2 * 2
    assert re.search(rb"/MediaBox \[0 0 59[45][.\d]* 84[12]", printed)
    page.emulate_media(media="screen")
    page.set_viewport_size({"width": 390, "height": 800})
    assert page.evaluate("document.documentElement.scrollWidth") <= 390
    context.close()
