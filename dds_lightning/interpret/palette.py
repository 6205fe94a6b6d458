"""Sixteen colours for skills.

They start from Okabe and Ito's set and Tol's "muted" one, moved apart in CIELAB as seen by normal eyes and by
simulated deuteranopes and protanopes (a test holds the distances). No sixteen colours are safe for everybody, so
every figure also writes the code's number where the skill is used: colour helps, the number decides.
"""

SKILL_COLOURS = (
    "#0072b2",
    "#fb9c29",
    "#009e73",
    "#c96800",
    "#56b4e9",
    "#c4a8bc",
    "#ffd300",
    "#332288",
    "#882255",
    "#45b095",
    "#816718",
    "#bb5891",
    "#117733",
    "#8fb8de",
    "#bf7d76",
    "#5a3d1e",
)
WALL = "#c9ced6"
START = "#ff7f0e"
GOAL = "#c1121f"
NO_SKILL = "#5c6470"


def skill_colour(code: int) -> str:
    """Colour of a code; grey for -1, an actor without skills. From 16 codes on the colours come round again."""
    return NO_SKILL if code < 0 else SKILL_COLOURS[code % len(SKILL_COLOURS)]
