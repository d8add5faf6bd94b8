"""The pages are true: links lead somewhere, named tests exist, and short pages stay short."""

from __future__ import annotations

import io
import re
import shlex
import tomllib
from collections import defaultdict
from contextlib import redirect_stderr
from functools import cache
from importlib import import_module
from itertools import dropwhile
from pathlib import Path

import pytest
import yaml

import lpn
from explorer.cli import Explore
from lpn.cli import main, parsing
from lpn.cli.compare import CompareCommand
from lpn.cli.explain import ExplainCommand
from lpn.core import log
from lpn.core.errors import LPNError
from lpn.sources import SourceOptions
from tools.world.__main__ import Rendering

ROOT = Path(__file__).parents[1]
PAGES = [*ROOT.glob("*.md"), *ROOT.glob("docs/*.md"), ROOT / "assets/README.md", ROOT / "explorer/screen/glossary.md"]
# Words of a page that stand for one of an option's words or numbers.
STAND_INS = {"TASK": "drone-to-satellite", "K": "3", "N": "1"}
# Options of every command, of a benchmark, and of the scripts that the authors released.
FURTHER_OPTIONS = {"--help", "--help-all", "--version", log.FLAG, "--own-seeds"}
FURTHER_OPTIONS |= {"--extra", "--extra-Google", "--multi-loss"} | set(parsing.options(Rendering))
# The program beside `lpn` whose commands are parsed, too.
WORLD = "tools.world"


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
    tops = [ROOT / top for top in ("lpn", "explorer", "tools")]
    sources = [file for top in tops for pattern in ("*.py", "*.toml") for file in top.rglob(pattern)]
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


@pytest.mark.parametrize("page", ["README.md", "docs/results.md", "docs/evaluation.md", "docs/reproduction.md"])
def test_a_page_says_first_that_no_figure_of_the_paper_was_reproduced(page: str) -> None:
    text = (ROOT / page).read_text("utf-8")
    shown = text if page == "README.md" else text.partition("\n## ")[0]
    assert "**No figure of the paper was reproduced on its own data sets**" in shown
    assert "paper's tables again" not in text


def test_the_constants_that_decide_are_those_of_the_code() -> None:
    page = (ROOT / "docs" / "how-a-photo-is-placed.md").read_text("utf-8")
    rows = re.findall(r"^\| `(\w+)\.(\w+)` \| ([\d.]+) \|", page, re.MULTILINE)
    assert len(rows) > 20
    modules = {name: import_module(f"lpn.flight.locate.{name}") for name, _, _ in rows}
    assert not [row for row in rows if getattr(modules[row[0]], row[1], None) != float(row[2])]


@pytest.mark.parametrize("page", ["scale.md", "serving.md"])
def test_a_page_of_a_task_opens_with_its_command_and_has_short_paragraphs(page: str) -> None:
    title, opening, *_ = (ROOT / "docs" / page).read_text("utf-8").split("\n\n")
    assert title.startswith("# ")
    assert opening.startswith("    ")
    blocks = re.split(r"\n\s*\n", (ROOT / "docs" / page).read_text("utf-8"))
    assert not [block for block in blocks if not block.startswith(("    ", "|", "-", "`")) and block.count("\n") > 4]


def commands_of(page: str) -> list[tuple[int, list[str]]]:
    """Return the commands in a page's blocks of code: the line on which each begins, and its words.

    Comments are left out, lines that end with a backslash are joined, and a pipe, `&&`, or `>` ends a command.
    """
    found: list[tuple[int, list[str]]] = []
    fenced, begun, text = False, 0, ""
    for number, line in enumerate(page.splitlines(), 1):
        fenced ^= line.startswith("```")
        if not (fenced or line.startswith("    ")):
            continue
        begun, text = begun if text else number, text + line.strip()
        if text.endswith("\\"):
            text = text.removesuffix("\\") + " "
            continue
        lexer, text = shlex.shlex(text, posix=True, punctuation_chars=True), ""
        lexer.whitespace_split = True
        try:
            words = list(lexer)
        except ValueError:  # an apostrophe: no line of a shell
            continue
        parts: list[list[str]] = [[]]
        for word in words:
            if set(word) <= set("();<>|&"):
                parts.append([])
            else:
                parts[-1].append(word)
        found += [(begun, part) for part in parts]
    return found


def arguments_of(words: list[str]) -> list[str] | None:
    """Return the arguments of `lpn`, or `tools.world` and its own, with words in place of placeholders; None of others."""
    words = list(dropwhile(re.compile(r"[A-Z_]+=").match, words))
    own = words[words.index("-m") + 1 :] if words[:1] == ["python"] and "-m" in words else words
    if own[:1] not in (["lpn"], ["tools.world"]):
        return None
    bare = [re.sub(r"^\[|\]$|\.\.\.$|\]?\.\.\.\]?$", "", word) for word in own[1:]]
    return [WORLD] * (own[0] == WORLD) + [STAND_INS.get(word, word) for word in bare if word]


def refusal(arguments: list[str]) -> str:
    """Return the sentence with which the parser of a command refuses arguments; empty if it takes them."""
    _, arguments = log.parse_level(arguments)
    if not arguments or arguments[0] in ("-h", "--help", "--version"):
        return ""
    command = Rendering if arguments[0] == WORLD else main.commands().get(arguments[0])
    if command is None:
        return f"lpn has no command {arguments[0]!r}"
    said = io.StringIO()
    try:
        with redirect_stderr(said):
            parsed = main.reader(command)(arguments[1:], f"lpn {arguments[0]}")
        # The demo and two pictures need no source, and take no option of one.
        needs_one = not isinstance(parsed, Explore | ExplainCommand) or {"--data", "--map"} & set(parsed.of_source())
        if isinstance(parsed, SourceOptions | CompareCommand) and not parsed.source and needs_one:
            return "there is no SOURCE"
    except LPNError as error:
        return str(error)
    except SystemExit as error:
        return " ".join(said.getvalue().split()) if error.code else ""
    return ""


def refused_commands(page: str) -> list[str]:
    """Return the line of each `lpn` command of a page that its parser refuses, and the parser's sentence."""
    found = [(line, arguments_of(words)) for line, words in commands_of(page)]
    tried = [(line, refusal(arguments)) for line, arguments in found if arguments is not None]
    return [f"line {line}: {sentence}" for line, sentence in tried if sentence]


@pytest.mark.parametrize("page", [page for page in PAGES if page.name != "CHANGELOG.md"], ids=lambda page: page.name)
def test_each_command_of_a_page_is_one_that_its_parser_takes(page: Path) -> None:
    assert refused_commands(page.read_text("utf-8")) == []


def test_a_command_that_no_parser_takes_is_named_with_its_line_and_the_parsers_sentence() -> None:
    page = """
    LPN_LOG=debug lpn train --data ROOT --out run \\
        --recipe small --learning-speed 3 | tee log.txt     # it's quick
    cd there && lpn exploit --data ROOT

```bash
lpn compare --model n4.onnx n1.onnx
```
"""
    expected = {2: "--learning-speed", 4: "lpn has no command 'exploit'", 7: "there is no SOURCE"}
    for told, (line, said) in zip(refused_commands(page), expected.items(), strict=True):
        assert told.startswith(f"line {line}: ")
        assert said in told
    assert unknown_options("`lpn train --teacher x`, `lpn exploit`") == [
        "line 1: lpn train has no --teacher",
        "line 1: lpn has no command exploit",
    ]


@cache
def known_options(command: str) -> set[str]:
    """Return the options of a command and of its modes; of all commands for an empty name."""
    if not command:
        return FURTHER_OPTIONS.union(*map(known_options, main.commands()))
    of = main.commands()[command]
    return FURTHER_OPTIONS.union(*map(parsing.options, [of, *parsing.modes(of).values()]), parsing.modes(of))


def unknown_options(page: str) -> list[str]:
    """Return the line of each option in a page's `code` that the command, or any where none is named, does not have."""
    found = []
    for number, line in enumerate(page.splitlines(), 1):
        for code in re.findall(r"`((?:lpn |--)[^`]+)`", line):
            named = re.match(r"lpn ([a-z]+)", code)
            command = named[1] if named else ""
            if command not in ("", *main.commands()):
                found.append(f"line {number}: lpn has no command {command}")
                continue
            for option in re.findall(r"(?<![\w-])--[a-z][\w-]*", code):
                option = option.replace("_", "-")
                if not {option, option.replace("--no-", "--", 1)} & known_options(command):
                    found.append(f"line {number}: {' '.join(['lpn', *command.split()])} has no {option}")
    return found


@pytest.mark.parametrize("page", [page for page in PAGES if page.name != "CHANGELOG.md"], ids=lambda page: page.name)
def test_each_option_that_a_page_names_is_one_of_a_command(page: Path) -> None:
    assert unknown_options(page.read_text("utf-8")) == []


def test_the_commands_of_the_makefile_are_taken() -> None:
    text = (ROOT / "Makefile").read_text("utf-8")
    text = re.sub(r"^DEMO_TRAIN = (.*)$", lambda line: text.replace("$(DEMO_TRAIN)", line[1]), text, flags=re.MULTILINE)
    text = re.sub(r"\$\([A-Z]+\)", "1", re.sub(r"^\t@?\$\(BIN\)/", "    ", text, flags=re.MULTILINE))
    while (plain := re.sub(r"\$\([^()]*\)", "", text)) != text:
        text = plain
    named = {arguments[0] for _, words in commands_of(text) if (arguments := arguments_of(words))}
    assert named >= {"explore", WORLD, "train"}
    assert refused_commands(text) == []
