"""Sixteen colours for skills.

They result from a search that started at hand-picked hues (blue, red, green, sky, pink, violet, gold, wine, then eight
fillers) and moved them as little as possible until they were distinct in CIELAB as seen by normal eyes and by simulated
deuteranopes and protanopes (Machado et al., 2009, severity 1), from each other, from white paper, from the walls and
from the orange of the starts. The first eight differ by at least 23 in every view, all sixteen by at least 12 (a
test checks both). No sixteen colours can be distinguished by everybody, so every figure also shows the code's number
where the skill is used.
"""

SKILL_COLOURS = (
    "#2779d2",
    "#d0271a",
    "#10a06f",
    "#67ccf9",
    "#de71b3",
    "#501593",
    "#c3b352",
    "#4a1020",
    "#2d2fd6",
    "#d2764a",
    "#0f5a3c",
    "#9a9af0",
    "#a82a8a",
    "#7d8187",
    "#94e27a",
    "#88653f",
)
WALL = "#d9dde3"
START = "#ff9f1c"
START_EDGE = "#7a3b00"
GOAL = "#111111"
NO_SKILL = "#5c6470"


def skill_colour(code: int) -> str:
    """Return the colour of a code; grey for -1, an actor without skills. Beyond 16 codes the colours repeat."""
    return NO_SKILL if code < 0 else SKILL_COLOURS[code % len(SKILL_COLOURS)]


def ink(colour: str) -> str:
    """Return the text colour for a background: white if its contrast is at least 3 (WCAG 2, large text), else black."""
    channels = [int(colour[i : i + 2], 16) / 255 for i in (1, 3, 5)]
    linear = [c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4 for c in channels]
    luminance = sum(weight * c for weight, c in zip((0.2126, 0.7152, 0.0722), linear, strict=True))
    return "white" if 1.05 / (luminance + 0.05) >= 3.0 else "black"
