"""Colours by name, by number and as R, G and B.

Flow: name, #rrggbb or three numbers -> [colors] -> (3,) in [0, 1], display-referred.
"""

from __future__ import annotations

import re
from typing import Any

import numpy as np

from jaxsph.numerics.names import did_you_mean

NAMES = {
    "white": "#ffffff",
    "black": "#000000",
    "gray": "#808080",
    "grey": "#808080",
    "silver": "#c0c0c0",
    "red": "#ff0000",
    "green": "#008000",
    "lime": "#00ff00",
    "blue": "#0000ff",
    "navy": "#000080",
    "yellow": "#ffff00",
    "orange": "#ffa500",
    "gold": "#ffd700",
    "cyan": "#00ffff",
    "magenta": "#ff00ff",
    "purple": "#800080",
    "pink": "#ffc0cb",
    "brown": "#a52a2a",
}
"""As CSS has them (W3C CSS Color Module Level 4, section 6.1)."""


def rgb(color: Any) -> tuple[float, float, float]:
    """R, G and B in [0, 1], display-referred.

    Args:
        color: one of `NAMES`, `"#rgb"`, `"#rrggbb"`, `"R,G,B"` or three numbers in [0, 1].

    Raises:
        ValueError: no colour.
    """
    given = color
    if isinstance(color, str):
        text = NAMES.get(color.lower(), color)
        if re.fullmatch(r"#(?:[0-9a-fA-F]{3}){1,2}", text):
            digits = text[1:] if len(text) == 7 else "".join(digit * 2 for digit in text[1:])
            given = [int(digits[at : at + 2], 16) / 255 for at in (0, 2, 4)]
        else:
            given = text.split(",")
    try:
        values = np.asarray(given, np.float64)
    except (TypeError, ValueError):
        values = np.empty(0)
    if values.shape != (3,) or not ((values >= 0) & (values <= 1)).all():
        meant = did_you_mean(color, NAMES) if isinstance(color, str) else ""
        raise ValueError(f"`color` must be a name such as white, #rrggbb, or R,G,B from 0 to 1; got {color!r}{meant}")
    return float(values[0]), float(values[1]), float(values[2])
