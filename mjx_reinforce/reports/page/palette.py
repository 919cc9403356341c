"""Colours of the report's page and pictures, on light and on dark ground.

Charts name a colour as a CSS variable, so that one drawing fits both and print.
"""

import re

#: Okabe and Ito's colours, told apart by colour-blind people (https://jfly.uni-koeln.de/color/);
#: without their yellow, which is lost on white.
_SERIES_LIGHT = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#b87a00", "#56b4e9", "#4d4d4d")
_SERIES_DARK = ("#4aa8e0", "#f2803a", "#2cc79a", "#e39cc4", "#e69f00", "#8fd0f7", "#c8c8c8")
_GROUND = {
    "light": {"paper": "#ffffff", "ink": "#1b1b1b", "soft": "#5c5c5c", "line": "#d9d9d6"},
    "dark": {"paper": "#16181b", "ink": "#ececea", "soft": "#a9abae", "line": "#3a3d42"},
}
LIGHT = _GROUND["light"] | {f"series-{i}": colour for i, colour in enumerate(_SERIES_LIGHT)}
DARK = _GROUND["dark"] | {f"series-{i}": colour for i, colour in enumerate(_SERIES_DARK)}
#: As many configurations as have a colour and a dash of their own.
SERIES = len(_SERIES_LIGHT)
#: Dashes, as lengths of strokes and gaps; not as many as colours, so that pairs repeat late.
DASHES = ([1, 0], [7, 3], [2, 2], [9, 3, 2, 3])


def colour(place: int) -> str:
    """Returns the colour of the configuration at a place."""
    return f"var(--series-{place % SERIES})"


def dash(place: int) -> list[int]:
    """Returns its dashes."""
    return DASHES[place % len(DASHES)]


def in_light(text: str) -> str:
    """Returns a text with light colours in place of the variables, for what does not know CSS."""
    return re.sub(r"var\(--([\w-]+)\)", lambda name: LIGHT[name[1]], text)
