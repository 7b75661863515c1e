"""Draws the pictures of docs/gallery.md and of the README: what commands show, and every particle file of a folder by default.

python docs/draw_gallery.py FOLDER [files|front|posters|NAME_OF_A_CARD ...]
"""

from __future__ import annotations

import os
import pathlib
import sys
import tempfile

from PIL import Image, ImageDraw

import jaxsph as js
from jaxsph.cli import main as cli

HERE = pathlib.Path(__file__).parent.resolve() / "gallery"
sys.path.append(str(HERE.parents[1] / "benchmarks"))
GALAXY = HERE.parent.parent / "notebooks" / "gallery" / "galaxy.png"
CELL, CAPTION, COLUMNS = 300, 34, 4
CARD, SQUARE, FRONT = (480, 360), (400, 400), (1600, 400)
REFUSED = "BROKEN"
BOX, DISC, FLUID = "gadget4_lcdm_gas_snapshot_002.hdf5", "gadget2_binary_gas_9030.gadget", "mixer_001.npz"
CLOSE = "--eye", "0.9,2.0,4.1", "--target", "0.25,-0.35,0.2"
CARDS = {
    "render": (BOX, "render", "--center", "densest"),
    "annotate": (BOX, "render", "--center", "densest", "--annotate", "--background", "white"),
    "project": (BOX, "project", "--norm", "log"),
    "surface": ("scene:dam_break", "render", "--surface", *CLOSE),
    "mean": (BOX, "project", "--of", "InternalEnergy", "--weight", "mass", "--norm", "log", "--colormap", "magma"),
    "arrows": (DISC, "project", "--center", "densest", "--width", "12", "--norm", "log", "--annotate", "--arrows", "velocity"),
    "temperature": (DISC, "render", "--preset", "temperature", "--opacity-by", "log10:density"),
    "halo": ("sphviewer_dm_halo.hdf5", "render", "--center", "densest", "--width", "0.2"),
    "clip": (FLUID, "render", "--clip", "plane:0,0,0,0.4,0,-1"),
    "slice": (FLUID, "slice", "--plane", "0,0,0,0,0,-1"),
    "where": (FLUID, "render", "--where", "hypot(x, z) > 0.5", "--surface", "none"),
    "letters": ("scene:letters", "render", "--tolerance", "0.01", "--integrator", "segments"),
    "transfer": (BOX, "transfer"),
    "explain": ("scene:checker_board", "explain", "--pixel", "180", "240", "--integrator", "segments", "--tolerance", "0.01"),
}
"""File or scene, command and options of every card."""
WIDE, KEPT = (1600, 900), ("--tolerance", "0.004", "--integrator", "segments")
POSTERS = {
    "cosmic_web": (BOX, "render", "--center", "densest", "--width", "48000", "--exposure", "0.5", *KEPT),
    "splash": ("splashsurf_double_dam_break_f26.vtk", "render"),
    "stirred_tank": ("mixer_002.npz", "render"),
    "column_density": (BOX, "project", "--width", "50000", "--norm", "log", "--colormap", "magma"),
}
"""The same of pictures to be printed; and a galaxy of points in gas, which is of Python."""
STARS, CELLS = 60_000, 128


def drawn(command: list[str], output: pathlib.Path) -> Image.Image:
    """The picture that a command writes."""
    if cli.main([*command, "-o", str(output)]):
        raise SystemExit(f"the command failed: jaxsph {' '.join(command)}")
    picture = Image.open(output)
    return Image.alpha_composite(Image.new("RGBA", picture.size, "white"), picture.convert("RGBA")).convert("RGB")


def card(name: str, size: tuple[int, int], folder: pathlib.Path, *more: str) -> Image.Image:
    """What the command of a card shows, at a size, with more options."""
    source, command, *options = CARDS[name]
    shape = () if command == "transfer" else ("--size", f"{size[0]}x{size[1]}")
    return drawn([command, source, *options, *shape, *more], folder / f"{name}.png")


def draw_front(folder: pathlib.Path) -> None:
    """The wide picture of the README: cosmic gas, a galaxy of points in gas, a fluid's surface, a column density."""
    made = Image.new("RGB", FRONT, "black")
    galaxy = Image.open(GALAXY).convert("RGB")
    galaxy = galaxy.resize((galaxy.width * SQUARE[1] // galaxy.height, SQUARE[1]), Image.Resampling.LANCZOS)
    aside = (galaxy.width - SQUARE[0]) // 2
    pictures = (
        card("render", SQUARE, folder, "--width", "42000"),
        galaxy.crop((aside, 0, aside + SQUARE[0], SQUARE[1])),
        card("surface", SQUARE, folder, "--fov", "56"),
        card("project", SQUARE, folder),
    )
    for place, picture in enumerate(pictures):
        made.paste(picture, (place * SQUARE[0], 0))
    made.save(HERE / "front.jpg", quality=88, optimize=True)


def draw_posters(folder: pathlib.Path) -> None:
    """Pictures to be printed, each to a tolerance of 0.004 where it has one."""
    for name, (source, command, *options) in POSTERS.items():
        size = "--size", f"{WIDE[0]}x{WIDE[1]}"
        _save_poster(drawn([command, source, *options, *size], folder / f"{name}.png"), name)
    import cosmos

    scene, camera = cosmos.galaxy(STARS, CELLS, width=WIDE[0], height=WIDE[1])
    image = js.render(scene, camera, js.Settings(integrator="segments", tolerance=0.004))
    _save_poster(Image.fromarray(image.to_uint8()), "galaxy")


def _save_poster(picture: Image.Image, name: str) -> None:
    folder = HERE / "posters"
    folder.mkdir(exist_ok=True)
    picture.save(folder / f"{name}.jpg", quality=85, optimize=True)


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
    made.save(path, optimize=True)


def draw_card(name: str, folder: pathlib.Path) -> None:
    """One picture of the gallery; parallel rays along an axis of a box fill a square."""
    picture = card(name, SQUARE if name in ("project", "mean") else CARD, folder)
    picture.thumbnail(CARD, Image.Resampling.LANCZOS)
    picture.save(HERE / f"{name}.jpg", quality=88, optimize=True)


def draw_files(folder: pathlib.Path) -> None:
    """Every file of the folder, with nothing chosen by hand."""
    names = sorted(file.name for file in pathlib.Path().iterdir() if file.suffix != ".md" and not file.name.startswith(REFUSED))
    asked = [(name, ["render", name]) for name in names]
    asked.append((f"{BOX} --part-type 1", ["render", BOX, "--part-type", "1"]))
    size = "--size", f"{CELL}x{CELL}"
    shown = [(text, drawn([*words, *size], folder / f"{number}.png")) for number, (text, words) in enumerate(asked)]
    sheet(shown, HERE / "files.png")


def main() -> None:
    """Draw all, or what is named."""
    os.chdir(sys.argv[1])  # figures name the files that they show
    with tempfile.TemporaryDirectory() as folder:
        groups = {"files": draw_files, "front": draw_front, "posters": draw_posters}
        for name in sys.argv[2:] or [*groups, *CARDS]:
            place = pathlib.Path(folder)
            groups[name](place) if name in groups else draw_card(name, place)


if __name__ == "__main__":
    main()
