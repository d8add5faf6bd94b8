"""How the page looks beyond what its panels say: colours of both themes, small screens, the tour's card."""

from __future__ import annotations

from lpn.drawing import overlays

_INKS = {f"part-{i}": colour for i, colour in enumerate(overlays.PART_COLOURS)} | {
    "true": overlays.TRUE_COLOUR,
    "false": overlays.FALSE_COLOUR,
    "unknown": overlays.UNKNOWN_COLOUR,
}


def part_ink(part: int) -> str:
    """The colour of words about a part, which follows the page's theme."""
    return f"var(--lpn-part-{part % len(overlays.PART_COLOURS)})"


def verdict_ink(true: bool | None) -> str:
    """The colour of words and signs about a match, which follows the page's theme."""
    return f"var(--lpn-{'unknown' if true is None else 'true' if true else 'false'})"


def _inks(palette: overlays.Palette) -> str:
    return ";".join(f"--lpn-{name}:{overlays.css(palette.ink(colour))}" for name, colour in _INKS.items())


_THEMES = f":root{{{_inks(overlays.DARK)}}}:root[data-mantine-color-scheme=light]{{{_inks(overlays.LIGHT)}}}"
_RULES = """
.lpn .top{display:flex;gap:.8em;align-items:baseline}
.lpn .top h2{flex:1;min-width:0;overflow-wrap:anywhere}
.lpn .tools{white-space:nowrap;font-size:12px}
.lpn .tools a{cursor:pointer;margin-left:.7em;opacity:.75;text-decoration:underline;text-underline-offset:2px}
.lpn .tools a:hover{opacity:1}
:root:not([data-mantine-color-scheme=light]) .lpn .when-light,:root[data-mantine-color-scheme=light] .lpn .when-dark{display:none}
.lpn .busy{display:inline-block;width:.75em;height:.75em;margin-right:.5em;border:2px solid;border-top-color:transparent;
border-radius:50%;animation:lpn-turn .8s linear infinite;vertical-align:-1px;box-sizing:border-box}
@keyframes lpn-turn{to{transform:rotate(360deg)}}
#lpn-said{position:fixed;z-index:500;left:50%;bottom:8%;transform:translateX(-50%);max-width:min(34em,88vw);padding:.6em 1em;
border-radius:6px;background:#262626;color:#f2f2f2;font-size:14px;box-shadow:0 2px 12px rgba(0,0,0,.5);opacity:0;
transition:opacity .2s;pointer-events:none}
#lpn-said.shown{opacity:1}
#lpn-tour{position:fixed;z-index:190;width:min(300px,calc(100vw - 24px));box-sizing:border-box;padding:.8em 1em;border-radius:8px;
background:#0f5c8a;color:#fff;font-size:14px;line-height:1.4;box-shadow:0 4px 20px rgba(0,0,0,.55)}
#lpn-tour b{display:block;font-size:15px;margin-bottom:.2em}
#lpn-tour .foot{display:flex;align-items:center;gap:.8em;margin-top:.7em}
#lpn-tour .foot span{flex:1;opacity:.8;font-size:12px}
#lpn-tour button{font:inherit;color:inherit;background:none;border:1px solid rgba(255,255,255,.6);border-radius:5px;
padding:.3em .9em;cursor:pointer}
#lpn-tour button.next{background:#fff;color:#0f5c8a;font-weight:600}
@media (pointer:coarse){#lpn-tour .keys,#lpn-keys{display:none}}
#lpn-tour kbd{border:1px solid rgba(255,255,255,.6);border-radius:3px;padding:0 .35em;font-size:12px}
#lpn-spot{position:fixed;z-index:189;box-sizing:border-box;border:3px solid #56b4e9;border-radius:8px;pointer-events:none;
box-shadow:0 0 0 2px rgba(0,0,0,.6)}
@media (max-width:36em){
.lpn-stage{height:calc(100% - var(--lpn-sheet,0px))!important}
.mantine-Paper-root[style*="max-height: 60%"]{width:100%!important;max-height:54%!important}
.mantine-Paper-root[style*="max-height: 60%"] div[style="width: 20em;"]{width:100%!important}}
"""
STYLE = f"<style>{_THEMES}{_RULES}</style>"
