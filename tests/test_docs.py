"""The pages say what is there: links lead somewhere, tests that are named exist, and short pages stay short."""

from __future__ import annotations

import re
import tomllib
from collections import defaultdict
from pathlib import Path

import pytest
import yaml

import lpn

ROOT = Path(__file__).parents[1]
PAGES = [*ROOT.glob("*.md"), *(ROOT / "docs").glob("*.md"), ROOT / "assets" / "README.md"]


def _anchors(page: Path) -> set[str]:
    """Return the anchors of a page's headings, as GitHub makes them."""
    headings = re.findall(r"^#+ (.+)$", page.read_text("utf-8"), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_lead_somewhere(page: Path) -> None:
    dead = []
    for target in re.findall(r"\]\((?!https?://)([^)\s]+)\)", page.read_text("utf-8")):
        name, _, anchor = target.partition("#")
        file = page.parent / name if name else page
        if not file.exists() or (anchor and anchor not in _anchors(file)):
            dead.append(target)
    assert not dead


def test_tests_that_the_pages_name_exist() -> None:
    functions = defaultdict(set)
    for file in (ROOT / "tests").rglob("test_*.py"):
        functions[file.name] |= set(re.findall(r"^ *def (test_\w+)", file.read_text("utf-8"), re.MULTILINE))
    missing = []
    for page in PAGES:
        if page.name == "CHANGELOG.md":
            continue
        file = "test_robustness.py"
        for name in re.findall(r"`(?:tests/[\w/]+/)?((?:test_\w+\.py)?(?:::)?(?:test_\w+)?)`", page.read_text("utf-8")):
            named, _, function = name.partition("::") if ".py" in name or name.startswith("::") else ("", "", name)
            file = named or ("test_robustness.py" if not name.startswith("::") else file)
            if name and (file not in functions or (function and function not in functions[file])):
                missing.append(f"{page.name}: {name}")
    assert not missing


def test_only_equations_and_sections_of_the_paper_are_cited() -> None:
    sections = {"I", "II", "II-A", "II-B", "III", "III-A", "III-B", "IV", *(f"IV-{letter}" for letter in "ABCDE"), "V"}
    cited = re.compile(
        r"\b(?:equations?|eqs?\.) (\d+)(?: (?:and|to) (\d+))?|\bsections? ([IV]+(?:-[A-Z])?)\b", re.IGNORECASE
    )
    sources = [file for top in ("lpn", "explorer", "tools") for file in (ROOT / top).rglob("*.py")]
    wrong, count = [], 0
    for page in [*PAGES, *sources]:
        for first, last, section in cited.findall(page.read_text("utf-8")):
            count += 1
            if section.upper() not in sections if section else not {first, last or first} <= set("123456"):
                wrong.append(f"{page.name}: {first or section}")
    assert count > 20
    assert not wrong


def test_the_readme_is_read_in_two_minutes() -> None:
    assert len((ROOT / "README.md").read_text("utf-8").splitlines()) <= 100


def test_the_citation_is_of_this_version_and_names_the_paper() -> None:
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text("utf-8"))
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    assert citation["cff-version"] == "1.2.0"
    assert {"title", "message", "authors"} <= set(citation)
    assert (citation["version"], citation["license"]) == (lpn.__version__, project["license"])
    assert all(author["name"] in (ROOT / "LICENSE").read_text("utf-8") for author in citation["authors"])
    (paper,) = citation["references"]
    readme = (ROOT / "README.md").read_text("utf-8").partition("## Cite")[2]
    assert "CITATION.cff" in readme
    for fact in ("doi", "title", "year", "start", "end", "journal"):
        assert str(paper[fact]) in readme, fact
    assert [name for name in (author["family-names"] for author in paper["authors"]) if name not in readme] == []


@pytest.mark.parametrize("page", ["README.md", "docs/results.md", "docs/reproduction.md"])
def test_a_page_says_first_that_no_figure_of_the_paper_was_reproduced(page: str) -> None:
    text = (ROOT / page).read_text("utf-8")
    shown = text if page == "README.md" else text.partition("\n## ")[0]
    assert "**No figure of the paper was reproduced on its own data sets**" in shown
    assert "paper's tables again" not in text


@pytest.mark.parametrize("page", ["scale.md", "serving.md"])
def test_a_page_of_a_task_opens_with_its_command_and_has_short_paragraphs(page: str) -> None:
    title, opening, *_ = (ROOT / "docs" / page).read_text("utf-8").split("\n\n")
    assert title.startswith("# ")
    assert opening.startswith("    ")
    blocks = re.split(r"\n\s*\n", (ROOT / "docs" / page).read_text("utf-8"))
    assert not [block for block in blocks if not block.startswith(("    ", "|", "-", "`")) and block.count("\n") > 4]
