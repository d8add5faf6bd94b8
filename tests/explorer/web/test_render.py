"""Templates and attributes escape what comes from files."""

from __future__ import annotations

import json
import re
from html.parser import HTMLParser
from pathlib import Path

import explorer.web
import pytest
from explorer.panels import pages
from explorer.web.render import press, progress_bar, render, send

HOSTILE = (
    "<img src=x onerror=alert(1)>",
    "\"' onload='alert(1)",
    "</style><script>alert(1)</script>",
    "&lt;b&gt;",
    "{{ 7 * 7 }}",
)


class Attributes(HTMLParser):
    """Collects the names of all elements and attributes, and the text."""

    def __init__(self, html: str) -> None:
        super().__init__()
        self.names: list[str] = []
        self.values: dict[str, str | None] = {}
        self.text = ""
        self.feed(html)
        self.close()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.names += [tag, *(name for name, _ in attrs)]
        self.values |= dict(attrs)

    def handle_data(self, data: str) -> None:
        self.text += data


@pytest.mark.parametrize("text", HOSTILE)
def test_text_of_a_template_is_shown_as_it_is(text: str) -> None:
    parsed = Attributes(pages.note(text, "lpn-x"))
    assert parsed.names == ["div", "class", "id"]
    assert parsed.text.strip() == text


@pytest.mark.parametrize("value", [*HOSTILE, None, 3, ["a", '"', 1]])
def test_a_click_sends_the_value_it_was_given(value: object) -> None:
    parsed = Attributes(f"<a {send('lab-sort', value)}>")
    assert parsed.names == ["a", "role", "tabindex", "onclick"]
    assert parsed.values["onclick"] == f'lpn.send("lab-sort",{json.dumps(value)})'


@pytest.mark.parametrize("uuid", HOSTILE)
def test_a_button_is_pressed_by_its_uuid(uuid: str) -> None:
    assert Attributes(f"<a {press(uuid)}>").names == ["a", "role", "tabindex", "onclick"]
    assert Attributes(pages.hidden([uuid])).names == ["style"]


def test_a_missing_value_is_an_error() -> None:
    with pytest.raises(Exception, match="text"):
        render("panels/note", id="")


def test_a_script_runs_by_the_onload_of_an_image() -> None:
    html = render("run_script", body='"a < b && \\"c\\""')
    assert Attributes(html).values["onload"] == 'Function("a < b && \\"c\\"")()'


def test_a_control_that_shows_a_sign_has_a_name() -> None:
    (folder,) = explorer.web.__path__
    signs = 0
    for template in Path(folder).rglob("*.j2"):
        # Expressions may hold angle brackets.
        source = re.sub(
            r"{{.*?}}", lambda match: match[0].replace("<", "").replace(">", ""), template.read_text("utf-8")
        )
        for tag, attributes, text in re.findall(r"<(a|button)\b([^>]*)>([^<]*)</", source):
            if re.search(r"[A-Za-z]", text) is None:
                signs += 1
                assert "aria-label" in attributes, f"{template.name}: <{tag}{attributes}>{text}"
    assert signs > 10


def test_a_bar_stands_beside_its_number_and_escapes_the_text() -> None:
    for text in HOSTILE:
        assert Attributes(progress_bar(3, 7, text)).names == ["progress", "class", "value", "max", "aria-label"]
        assert Attributes(progress_bar(0, 0, text)).names == []  # how much it is in all is not known
    assert 'value="3" max="7"' in progress_bar(3, 7, "3 of 7")
