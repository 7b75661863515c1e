"""Words of placing and showing that all commands that draw read, each with a value: `tests/cli/test_drawing.py` tries them."""

EYE, KEY = ["--eye", "0.3,0.2,3"], ["--annotate"]
UNIT = {"render": "erg", "project": "Msun/pc**2", "slice": "erg", "movie": "erg"}
WORDS = {
    "--view": (["x"], []), "--view a direction": (["1,2,3"], []), "--up": (["1,0,0"], []), "--eye": (EYE[1:], []),
    "--target": (["0.9,0.1,0.2"], EYE), "--fov": (["9"], EYE), "--center": (["0.3,0.4,0.5"], ["--width", "0.5"]),
    "--width": (["0.3"], []), "--clip": (["box:0.2,0.2,0.2,0.9,0.7,0.8"], []), "--where": (["heat > 0.5"], []),
    "--background": (["white"], []), "--annotate": ([], []), "--title": (["A title"], KEY), "--dpi": (["300"], KEY),
    "--font-size": (["11"], KEY), "--length-unit": (["Mpc"], KEY), "--unit": (None, KEY), "--contours": (["2*heat"], KEY),
    "--panels": ([], []), "--axes": ([], ["--view", "z", *KEY]),
}  # fmt: skip
"""Of each a value, and what else is asked for with and without it."""
NOT_OF = {"--contours": ("movie",), "--panels": ("movie",)}
