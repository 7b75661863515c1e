"""Claim: what is rendered with no options fills the frame, is lit, and shows its brightest parts.

Files and built-in scenes as `read_scene` and `scenes.load` give them, at 256 x 256. Of each picture: `fills`, the
longest side of the box around its lit pixels (a channel over 24 of 255) over that of the frame, at least 0.6; `lit`, the share of
that box that is lit, at least a tenth; and `brightest`, the 99th percentile of the largest channel, at least a half. Writes
`results/first_pictures.json`, and with `--sheet` a picture of all of them; ends in an assert.

    python benchmarks/first_pictures.py [FILE or scene:NAME ...] [--size 256] [--sheet OUT.png]
"""

from __future__ import annotations

import argparse
import json
import pathlib
import time
from typing import Any

import numpy as np
from PIL import Image as Picture
from PIL import ImageDraw

import jaxsph as js
from jaxsph.io.replace import written_whole
from jaxsph.trade.sweep import of_this_run

RESULTS = pathlib.Path(__file__).with_name("results") / "first_pictures.json"
LIT = 24 / 255
FILLS, SHARE, BRIGHTEST = 0.6, 0.1, 0.5
COLUMNS, CAPTION = 5, 14
SCENE = "scene:"


def picture_of(source: str, size: int) -> np.ndarray:
    """Colours of what is shown with no options, (size, size, 3)."""
    if source.startswith(SCENE):
        scene, camera = js.scenes.load(source.removeprefix(SCENE), width=size, height=size)
    else:
        scene, camera = js.io.read_scene(source, size=(size, size))
    return np.asarray(js.render(scene, camera).color)


def judged(color: np.ndarray) -> dict[str, Any]:
    """What is measured of a picture, and whether it is good enough."""
    largest = color.max(-1)
    lit = largest > LIT
    rows, columns = np.nonzero(lit)
    sides = (np.ptp(rows) + 1, np.ptp(columns) + 1) if len(rows) else (0, 0)
    found = {
        "fills": float(max(sides) / max(lit.shape)),
        "lit": float(lit.sum() / (sides[0] * sides[1])) if len(rows) else 0.0,
        "brightest": float(np.percentile(largest, 99)),
    }
    good = found["fills"] >= FILLS and found["lit"] >= SHARE and found["brightest"] >= BRIGHTEST
    return found | {"good": bool(good)}


def sheet(pictures: dict[str, np.ndarray], path: pathlib.Path) -> None:
    """All pictures beside each other, with their names."""
    size = len(next(iter(pictures.values())))
    rows = -(-len(pictures) // COLUMNS)
    whole = Picture.new("RGB", (size * min(COLUMNS, len(pictures)), (size + CAPTION) * rows), (60, 60, 60))
    draw = ImageDraw.Draw(whole)
    for number, (name, color) in enumerate(pictures.items()):
        x, y = number % COLUMNS * size, number // COLUMNS * (size + CAPTION)
        draw.text((x + 2, y + 1), name, fill=(255, 255, 255))
        whole.paste(Picture.fromarray((np.clip(color, 0, 1) * 255 + 0.5).astype(np.uint8)), (x, y + CAPTION))
    with written_whole(path) as temporary:
        whole.save(temporary)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sources", nargs="*", help="files, or scene:NAME (default: all built-in scenes)")
    parser.add_argument("--size", type=int, default=256)
    parser.add_argument("--sheet", type=pathlib.Path)
    options = parser.parse_args()
    sources = options.sources or [SCENE + name for name in js.scenes.names()]
    pictures, records = {}, []
    for source in sources:
        begun = time.perf_counter()
        color = picture_of(source, options.size)
        name = source if source.startswith(SCENE) else pathlib.Path(source).name
        record = {"source": name, **judged(color), "seconds": time.perf_counter() - begun}
        pictures[name] = color
        records.append(record)
        told = f"fills {record['fills']:.2f}  lit {record['lit']:.2f}  brightest {record['brightest']:.2f}"
        print(f"{name:44s} {told}  {'' if record['good'] else 'NOT GOOD ENOUGH'}", flush=True)
    if options.sheet:
        sheet(pictures, options.sheet)
    with written_whole(RESULTS) as temporary:
        temporary.write_text(json.dumps({**of_this_run(), "size": options.size, "pictures": records}, indent=1) + "\n")
    assert all(record["good"] for record in records), "some pictures are small, thin or dark"


if __name__ == "__main__":
    main()
