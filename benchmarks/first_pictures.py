"""Claim: what is rendered with no options fills the frame, is lit, shows its brightest parts, and is soon there.

Files and built-in scenes as `read_scene` and `scenes.load` give them, at 256 x 256. Of each picture: `fills`, the
longest side of the box around its lit pixels (a channel over 24 of 255) over that of the frame, at least 0.6; `lit`, the share of
that box that is lit, at least a tenth; and `brightest`, the 99th percentile of the largest channel, at least a half. With
`--waits` each is also `jaxsph render FILE`, one after the other in new processes, from an empty folder of compiled programs on;
again; and `js.render` in Python: which programs were new, and what in them differs from the most similar one before. On two
cores the first is to take at most 6 s, the others 3 s in the median, 1 s of it for programs; and nothing is compiled twice.
Writes `results/first_pictures.json`, and with `--sheet` a picture of all of them; ends in asserts.

    python benchmarks/first_pictures.py [FILE or scene:NAME ...] [--size 256] [--sheet OUT.png] [--waits]
"""

from __future__ import annotations

import argparse
import json
import os
import pathlib
import statistics
import subprocess
import sys
import tempfile
import time
from typing import Any

import numpy as np
from kept import keep
from PIL import Image as Picture, ImageDraw

import jaxsph as js
from jaxsph.io.replace import written_whole

WAITS = "command", "again", "python"
RESULTS = pathlib.Path(__file__).with_name("results") / "first_pictures.json"
LIT = 24 / 255
FILLS, SHARE, BRIGHTEST = 0.6, 0.1, 0.5
COLUMNS, CAPTION = 5, 14
SCENE = "scene:"
FIRST, OTHERS, COMPILING = 6.0, 3.0, 1.0  # seconds that may pass
WAITED = """
import contextlib, dataclasses, io, json, sys
from jax.tree_util import keystr, tree_leaves_with_path

def told(name, value):
    if dataclasses.is_dataclass(value):
        fields = [told(f"{name}.{field.name}", getattr(value, field.name)) for field in dataclasses.fields(value)]
        return {name: text for field in fields for name, text in field.items()}
    return {name: getattr(value, "__name__", type(value).__name__ if " at 0x" in repr(value) else repr(value))}

def noted(function, arguments, static):
    made = {name: text for one, value in static.items() for name, text in told(one, value).items()}
    made |= {keystr(path): str(leaf) for path, leaf in tree_leaves_with_path(programs.shapes_of(arguments))}
    found.append((function.__name__, made))

found, source, by = [], sys.argv[1], sys.argv[2]
from jaxsph.engine.runtime import programs
get = programs.Programs.get
programs.Programs.get = lambda own, *given: (noted(*given), get(own, *given))[1]
if by == "python":
    import jaxsph as js
    scene, camera = js.scenes.load(source[6:]) if source.startswith("scene:") else js.io.read_scene(source)
    compiling = js.render(scene, camera).stats["seconds"]["compile"]
else:
    from jaxsph.cli.main import main
    sys.argv[1:] = ["render", source, "-o", sys.argv[3], "--json"]
    with contextlib.redirect_stdout(io.StringIO()) as said:
        assert main() == 0
    compiling = json.loads(said.getvalue())["seconds"]["compile"]
print(json.dumps({"compiling": compiling, "programs": found}))
"""


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


def waited(source: str, by: str, folder: str, known: dict[str, list[dict[str, str]]]) -> dict[str, Any]:
    """Of a picture that a process of its own makes: seconds, and programs that were not in the folder; `known` grows by all.

    Of each new program, what differs from the most similar one before; nothing where that is its structure alone.
    """
    environment = {name: value for name, value in os.environ.items() if not name.startswith("JAX_")} | {"XDG_CACHE_HOME": folder}
    command = [sys.executable, "-c", WAITED, source, by, os.path.join(folder, "picture.png")]
    before, began, begun = kept_in(folder), os.times(), time.perf_counter()
    done = subprocess.run(command, check=True, env=environment, capture_output=True, text=True)
    elapsed, ended, new, found = time.perf_counter() - begun, os.times(), {}, json.loads(done.stdout)
    for name in sorted(path.removeprefix("jit_").rsplit("-", 2)[0] for path in kept_in(folder) - before):
        name = name.rpartition("_")[0] if name.rpartition("_")[0] in dict(found["programs"]) else name  # of this code
        made = [one for function, one in found["programs"] if function == name][-1:]
        differ = [{key for key in one | other if one.get(key) != other.get(key)} for one in made for other in known.get(name, [])]
        new[name] = sorted(min(differ, key=len, default=()), key=lambda key: (key.startswith("["), key))[:6]
    for name, one in found["programs"]:
        known.setdefault(name, []).append(one)
    cpu = ended.children_user + ended.children_system - began.children_user - began.children_system
    called = source if source.startswith(SCENE) else pathlib.Path(source).name
    why = "; ".join(f"{name} ({', '.join(differs)})" for name, differs in new.items())
    print(f"{by:8s} {called:44s} {elapsed:5.2f} s, {cpu:5.2f} s of CPU, compiling {found['compiling']:5.2f} s  {why}", flush=True)
    return {"source": called, "seconds": elapsed, "cpu": cpu, "compiling": found["compiling"], "new": new}


def kept_in(folder: str) -> set[str]:
    """Names of the programs in a cache folder."""
    return {path.name for path in pathlib.Path(folder).rglob("*-cache")}


def waits(sources: list[str]) -> dict[str, list[dict[str, Any]]]:
    """Of each source: by a command, again, and in Python."""
    known: dict[str, list[dict[str, str]]] = {}
    with tempfile.TemporaryDirectory() as folder:
        return {by: [waited(source, by, folder, known) for source in sources] for by in WAITS}


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


def variants() -> list[str]:
    """Names of all that is compared."""
    return ["picture", *WAITS]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sources", nargs="*", help="files, or scene:NAME (default: all built-in scenes)")
    parser.add_argument("--size", type=int, default=256)
    parser.add_argument("--sheet", type=pathlib.Path)
    parser.add_argument("--waits", action="store_true", help="measure commands and Python in processes of their own, too")
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
    found = waits(sources) if options.waits else {}
    keep(RESULTS, ("picture", *found), size=options.size, pictures=records, waits=found)
    assert all(record["good"] for record in records), "some pictures are small, thin or dark"
    if options.waits:
        first, *others = found["command"]
        assert not any(record["new"] for how in ("again", "python") for record in found[how]), "something was compiled twice"
        assert first["seconds"] <= FIRST, first
        medians = [statistics.median(record[name] for record in others) for name in ("seconds", "compiling")]
        assert medians[0] <= OTHERS and medians[1] <= COMPILING, medians


if __name__ == "__main__":
    main()
