"""Draws the sheets of docs/gallery.md: every particle file of a folder as `jaxsph render FILE` shows it, and what else is asked.

python docs/draw_gallery.py FOLDER
"""

from __future__ import annotations

import pathlib
import sys
import tempfile

from PIL import Image, ImageDraw

from jaxsph.cli import main as cli

HERE = pathlib.Path(__file__).parent / "gallery"
CELL, CAPTION, COLUMNS = 300, 34, 4
REFUSED = "BROKEN"
DENSE, SPIRAL, FLUID = "gadget4_lcdm_gas_snapshot_002.hdf5", "gadget2_binary_gas_9030.gadget", "mixer_001.npz"
ASKED = (
    ("colour by heat, opacity by density", SPIRAL, ["render", "--preset", "temperature", "--opacity-by", "log10:density"]),
    ("--center densest: the box wraps", DENSE, ["render", "--center", "densest"]),
    ("column density: jaxsph project", DENSE, ["project", "--norm", "log"]),
    ("mean of energy by mass", DENSE, ["project", "--of", "InternalEnergy", "--weight", "mass", "--norm", "log"]),
    ("--clip plane:...", FLUID, ["render", "--clip", "plane:0,0,0,0.4,0,-1"]),
    ("jaxsph slice", FLUID, ["slice", "--plane", "0,0,0,0,0,-1"]),
    ("--where 'hypot(x, z) > 0.5'", FLUID, ["render", "--where", "hypot(x, z) > 0.5", "--surface", "none"]),
    ("--annotate: bar, scale, axes, time", DENSE, ["render", "--annotate"]),
)
"""What it says below, file, command and options."""


def drawn(command: list[str], file: pathlib.Path, folder: pathlib.Path, number: int) -> Image.Image:
    """The picture of a command."""
    output = folder / f"{number}.png"
    name, *options = command
    arguments = [name, str(file), "-o", str(output), "--size", f"{CELL}x{CELL}", *options]
    if cli.main(arguments):
        raise SystemExit(f"{file.name}: the command failed: jaxsph {' '.join(arguments)}")
    return Image.open(output).convert("RGB")


def sheet(pictures: list[tuple[str, Image.Image]], path: pathlib.Path) -> None:
    """Pictures with what they are below, row by row."""
    rows = -(-len(pictures) // COLUMNS)
    made = Image.new("RGB", (COLUMNS * CELL, rows * (CELL + CAPTION)), "black")
    draw = ImageDraw.Draw(made)
    for place, (text, picture) in enumerate(pictures):
        x, y = place % COLUMNS * CELL, place // COLUMNS * (CELL + CAPTION)
        picture.thumbnail((CELL, CELL))
        made.paste(picture, (x + (CELL - picture.width) // 2, y + (CELL - picture.height) // 2))
        draw.text((x + CELL // 2, y + CELL + CAPTION // 2), text, fill="white", anchor="mm", font_size=12)
    path.parent.mkdir(exist_ok=True)
    made.save(path, optimize=True)


def main() -> None:
    """Draw both."""
    data = pathlib.Path(sys.argv[1])
    files = sorted(file for file in data.iterdir() if file.suffix != ".md" and not file.name.startswith(REFUSED))
    with tempfile.TemporaryDirectory() as folder:
        place = pathlib.Path(folder)
        shown = [(file.name, drawn(["render"], file, place, number)) for number, file in enumerate(files)]
        dark = data / DENSE
        shown.append((f"{dark.name} --part-type 1", drawn(["render", "--part-type", "1"], dark, place, len(files))))
        sheet(shown, HERE / "files.png")
        asked = [(text, drawn(command, data / file, place, number)) for number, (text, file, command) in enumerate(ASKED)]
        sheet(asked, HERE / "asks.png")


if __name__ == "__main__":
    main()
