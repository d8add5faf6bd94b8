"""A hook of MkDocs: pages outside docs, and the commands with their options, become pages of the site.

`make docs` builds the site, and fails on a broken link or anchor.
"""

from __future__ import annotations

import io
import os
import re
from contextlib import redirect_stdout, suppress
from pathlib import Path
from typing import Any

from mkdocs.structure.files import File

from lpn.cli import main

_ROOT = Path(__file__).parents[1]
# MkDocs would take a README for the first page, which is docs/index.md.
_PAGES = {"overview.md": "README.md", "glossary.md": "explorer/screen/glossary.md"}
_PAGES |= {name: name for name in ("SECURITY.md", "CONTRIBUTING.md", "CHANGELOG.md")}


def on_files(files: Any, config: Any) -> Any:
    """Add the pages that do not lie in docs."""
    for page, name in _PAGES.items():
        files.append(File.generated(config, page, content=(_ROOT / name).read_text("utf-8")))
    files.append(File.generated(config, "commands.md", content=_commands()))
    return files


def on_page_markdown(markdown: str, **_of: Any) -> str:
    """Let links between docs and pages outside lead to the site's pages; a link to another file becomes its path as code."""
    markdown = re.sub(
        r"\]\((?:\.\./)*(?:docs/|explorer/screen/)?((?:[\w-]+\.(?:md|webp|jpg))(?:#[^)]*)?)\)", r"](\1)", markdown
    )
    # A list right below a paragraph needs a blank line in MkDocs, but not on a repository's page.
    markdown = re.sub(r"^(?![-|\s*\d])(.+)\n(- )", r"\1\n\n\2", markdown, flags=re.MULTILINE)
    return re.sub(r"\[[^\]]*\]\((?:\.\./)*((?!https?:)[^)#]*(?:\.py|\.toml|\.cff|LICENSE|\.txt))\)", r"`\1`", markdown)


def _commands() -> str:
    os.environ["COLUMNS"] = "100"
    pages = ["# Commands\n", "Every option of every command, as `lpn COMMAND --help-all` prints it.\n"]
    for name in sorted(main.commands()):
        printed = io.StringIO()
        with redirect_stdout(printed), suppress(SystemExit):
            main.main([name, "--help-all"])
        pages.append(f"## {name}\n\n```text\n{printed.getvalue().strip()}\n```\n")
    return "\n".join(pages)
