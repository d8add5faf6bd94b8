"""The page's style sheets, and the theme's colours as CSS variables."""

from __future__ import annotations

from pathlib import Path

from lpn.drawing import charts, theme

# In the order of the cascade: a later sheet overrides an earlier one.
_SHEETS = (
    *("tokens", "panels", "page", "explain", "failure_lab", "flight", "stories", "browse", "lab_map"),
    "first_screen",
)
_VARIABLES = {f"part-{i}": colour for i, colour in enumerate(theme.PART_COLOURS)} | {
    "true": theme.TRUE_COLOUR,
    "false": theme.FALSE_COLOUR,
    "unknown": theme.UNKNOWN_COLOUR,
}


def part_ink(part: int) -> str:
    """Return the text colour of a part; it follows the page's theme."""
    return f"var(--lpn-part-{part % len(theme.PART_COLOURS)})"


def verdict_ink(true: bool | None) -> str:
    """Return the text colour of a right, wrong, or unknown (None) match; it follows the page's theme."""
    return f"var(--lpn-{'unknown' if true is None else 'true' if true else 'false'})"


def variables(dark: bool) -> str:
    """Return a rule with the theme's colours as CSS variables, for a page of one theme."""
    return f":root{{{_variables(theme.DARK if dark else theme.LIGHT)}}}"


def _variables(palette: theme.Palette) -> str:
    return ";".join(f"--lpn-{name}:{theme.css(palette.ink(colour))}" for name, colour in _VARIABLES.items())


def _read_sheets() -> str:
    folder = Path(__file__).parent / "css"
    return "".join((folder / f"{name}.css").read_text("utf-8") for name in _SHEETS)


STYLE = (
    f"<style>:root{{{_variables(theme.DARK)}}}:root[data-mantine-color-scheme=light]{{{_variables(theme.LIGHT)}}}"
    f"{charts.STYLE}{_read_sheets()}</style>"
)
