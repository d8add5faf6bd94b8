"""The page's style sheets, and the theme's colours as CSS variables."""

from __future__ import annotations

from pathlib import Path

from lpn.drawing import charts, theme

# In the order of the cascade: a later sheet overrides an earlier one.
_SHEETS = (
    *("tokens", "panels", "page", "stage", "explain", "failure_lab", "flight", "stories", "browse", "lab_map"),
    "first_screen",
)


def part_ink(part: int) -> str:
    """Return the text colour of a part; it follows the page's theme."""
    return f"var(--lpn-part-{part % len(theme.PART_COLOURS)})"


def verdict_ink(true: bool | None, doubted: bool = False) -> str:
    """Return the text colour of a right, wrong, or unknown (None) answer; it follows the page's theme.

    Args:
        doubted: details place the photo, and something contradicts them.
    """
    return f"var(--lpn-{'contradicted' if doubted else 'unknown' if true is None else 'right' if true else 'wrong'})"


def _read_sheets() -> str:
    folder = Path(__file__).parent / "css"
    return "".join((folder / f"{name}.css").read_text("utf-8") for name in _SHEETS)


# The colours as they are, for maps and photos, which are drawn alike in both themes.
_RAW = ";".join(f"--raw-{name}:{theme.css(colour)}" for name, colour in theme.COLOURS.items())
STYLE = (
    f"<style>:root{{{_RAW};{theme.variables(theme.DARK)}}}:root[data-mantine-color-scheme=light]{{{theme.variables(theme.LIGHT)}}}"
    f"{charts.STYLE}{_read_sheets()}</style>"
)
