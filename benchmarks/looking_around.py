"""Claim: a view of 44 thousand particles answers a drag within 100 ms once compiled, and neither compiles nor grows in its use.

Of each source at 1024 x 768, without a browser: `first`, from the beginning of a view to its first draft, and `first_full` to its
first picture of all pixels, where another view has compiled before; `drag`, from an input to its draft, the median of 50, and
`drag_90`, of which nine in ten are faster; `full`, what a picture of all pixels takes over `jaxsph.render` of the same settings,
in turns, each with a plan of its own; `compiled`, programs of drags; `resident`, bytes before 2,000 inputs and after each tenth
of them, and `compiled_by_inputs`: plans that had to grow. Writes `results/looking_around.json`; ends in an assert on programs and
memory, and says which times hold, as those are of a machine that nobody else uses.

With `--surface LEVEL` it is of surfaces of the particles; `edited`, from an edit of colours to its draft, likewise. With
`--browser` it is `jaxsph view` in a Chromium of this machine, alone: `in_browser`, from a move of the mouse to the draft on its
page, the median of 50.

    python benchmarks/looking_around.py [FILE or scene:NAME ...] [--inputs 2000] [--surface LEVEL] [--browser]
"""

from __future__ import annotations

import argparse
import dataclasses
import gc
import json
import os
import pathlib
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from typing import Any

import jax
from kept import keep

import jaxsph as js
from jaxsph.trade.sweep import of_this_run
from jaxsph.viewer.session import Session
from jaxsph.viewer.stages import DRAFT, FULL

RESULTS = pathlib.Path(__file__).with_name("results") / "looking_around.json"
SIZE = 1024, 768
DRAGS, TURNS, TOGETHER, PERIOD, PARTS = 50, 3, 20, 200, 10
FIRST, DRAG, TIMES = 1.0, 0.1, 2.0
GROWTH = 64 << 20
"""Bytes that a view may hold more in the second half of its inputs than in the first: allocators keep what was freed."""
SCENE = "scene:"
COMPILED = "/jax/core/compile/backend_compile_duration"
TURN = [{"do": "orbit", "right": 0.02, "down": 0.0}] * 2
MAPS = [{"do": "colormap", "name": name} for name in ("magma", "viridis")]
WATCHED = """void (window.drawn = new Promise((done) => {
    const began = performance.now(), seen = new MutationObserver(() => (seen.disconnect(), done(performance.now() - began)));
    seen.observe(document.body, {attributeFilter: ["data-version"]});
}))"""
CUTS = {"do": "cut", "kind": "plane"}, {"do": "cut", "share": 0.2}, {"do": "cut", "kind": "off"}


def opened(source: str, level: float | None) -> tuple[js.Scene, js.Camera]:
    if source.startswith(SCENE):
        scene, camera = js.scenes.load(source.removeprefix(SCENE), width=SIZE[0], height=SIZE[1])
    else:
        scene, camera = js.io.read_scene(source, size=SIZE, surface=False)
    return dataclasses.replace(scene, surface=None if level is None else js.Surface(level)), camera


def resident() -> int:
    gc.collect()
    return int(pathlib.Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


def inputs(session: Session, number: int) -> None:
    """Of all kinds, as fast as they are taken; now and then a draft is waited for."""
    rows = session.state()["look"]["points"]
    for count in range(number):
        kind, small = count % 8, 0.002 * (count % 40 - 20)
        if kind == 5:
            rows[0][1] = abs(rows[0][1] + small)
            session.do({"do": "points", "points": rows, "done": False})
        elif kind == 6:
            session.do({"do": "zoom", "factor": 1.02 if count % 16 == 6 else 1 / 1.02})
        elif kind == 7:
            session.do({"do": "cut", "kind": "plane", "share": small})
        else:
            session.do({"do": "orbit", "right": 0.01, "down": small})
        if count % TOGETHER == TOGETHER - 1:
            session.wait(DRAFT)
        if count % PERIOD == PERIOD - 1:
            session.do({"do": "home"})
    session.do({"do": "cut", "kind": "off"})
    session.wait(DRAFT)


def timed(session: Session, messages: list[dict[str, Any]]) -> list[float]:
    """Seconds from inputs to their drafts."""
    found = []
    for message in messages:
        begun = time.perf_counter()
        session.do(message)
        session.wait(DRAFT)
        found.append(time.perf_counter() - begun)
    return found


def measured(source: str, number: int, level: float | None = None) -> dict[str, Any]:
    scene, camera = opened(source, level)
    settings = js.Settings()  # point samples: the picture of all pixels is the last
    with Session(scene, camera, settings) as session:  # which compiles
        session.wait(FULL)
        for message in ({"do": "orbit", "right": 0.1, "down": 0}, MAPS[0], *CUTS, {"do": "home"}):
            session.do(message)
            session.wait(FULL)
    compiled: list[str] = []
    jax.monitoring.register_event_duration_secs_listener(
        lambda name, _, **more: compiled.append(more.get("fun_name", "")) if name == COMPILED else None
    )
    begun = time.perf_counter()
    with Session(scene, camera, settings) as session:
        session.wait(DRAFT)
        first = time.perf_counter() - begun
        session.wait(FULL)
        first_full = time.perf_counter() - begun
        drags, edits = (timed(session, DRAGS // 2 * pair) for pair in (TURN, MAPS))
        by_drags = sorted(set(compiled))
        view, alone = [], []
        for _ in range(TURNS):
            session.do({"do": "orbit", "right": 0.1, "down": 0.0})
            picture = session.wait(FULL)
            view.append(picture.facts["milliseconds"] / 1000)
            known, begun = len(compiled), time.perf_counter()
            jax.block_until_ready(js.render(picture.scene, picture.camera, settings).color)
            alone.append(time.perf_counter() - begun)
            del compiled[known:]  # for a plan without room
        inputs(session, PERIOD)  # all views that there will be
        compiled.clear()
        held, seconds = [resident()], 0.0
        for _ in range(PARTS):
            begun = time.perf_counter()
            inputs(session, number // PARTS)
            seconds += time.perf_counter() - begun
            held.append(resident())
    full = statistics.median(view) / min(alone)
    return {
        "source": (source if source.startswith(SCENE) else pathlib.Path(source).name) + ("" if level is None else f", {level=}"),
        "particles": scene.particle_set.num_particles,
        "first": first,
        "first_full": first_full,
        "drag": statistics.median(drags),
        "drag_90": sorted(drags)[int(0.9 * DRAGS)],
        "edited": statistics.median(edits),
        "full": full,
        "full_seconds": statistics.median(view),
        "render_seconds": alone,
        "compiled": by_drags,
        "compiled_by_inputs": sorted(set(compiled)),
        "inputs": number,
        "inputs_seconds": seconds,
        "resident": held,
        "holds": {"first": first <= FIRST, "drag": statistics.median(drags) <= DRAG, "full": full <= TIMES},
    }


def in_browser(source: str) -> dict[str, Any]:
    """Seconds from moves of the mouse to drafts on a page, of what is shown with no options."""
    sys.path.insert(0, str(pathlib.Path(__file__).parent.parent / "tests" / "shared"))
    import browser as browsers

    words = ["view", source, "--size", "{}x{}".format(*SIZE), "--no-browser", "-q"]
    server = subprocess.Popen([sys.executable, "-m", "jaxsph", *words], stdout=subprocess.PIPE, text=True)
    with tempfile.TemporaryDirectory() as folder:
        browser = browsers.Browser(folder)
        try:
            page = browser.page(server.stdout.readline().strip())  # type: ignore[union-attr]
            page.until("document.body.dataset.final == 'true'", 300)
            (x, y), drags = page.middle("canvas"), []
            page.mouse("Pressed", x, y, "left", 1)
            for nth in range(DRAGS + 5):
                page.ask(WATCHED)
                page.mouse("Moved", x + 3 * nth + 20, y + nth % 7, "left")
                drags.append(page.ask("window.drawn") / 1000)
            page.mouse("Released", x, y, "left", 1)
        finally:
            browser.close()
            server.send_signal(signal.SIGINT)
            server.wait(60)
    drags = sorted(drags[5:])
    return {"source": pathlib.Path(source).name, "in_browser": statistics.median(drags), "in_browser_90": drags[int(0.9 * DRAGS)]}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sources", nargs="*", default=[SCENE + "mixer"], help="files, or scene:NAME (default: scene:mixer)")
    parser.add_argument("--inputs", type=int, default=2000)
    parser.add_argument("--surface", type=float, metavar="LEVEL")
    parser.add_argument("--browser", action="store_true")
    options = parser.parse_args()
    records = []
    for source in options.sources:
        load = os.getloadavg()[0]
        made = in_browser(source) if options.browser else measured(source, options.inputs, options.surface)
        record = made | {"load_before": load, **of_this_run()}
        print(json.dumps(record, indent=1), flush=True)
        kept = json.loads(RESULTS.read_text())["views"] if RESULTS.exists() else []
        views = [*(one for one in kept if (one["source"], "in_browser" in one) != (record["source"], options.browser)), record]
        keep(RESULTS, [one["source"] for one in views], size=SIZE, views=views)
        records += [] if options.browser else [record]
    assert not any(record["compiled"] for record in records), "a view compiles while it is used"
    halves = [(record["resident"][: PARTS // 2], record["resident"][PARTS // 2 :]) for record in records]
    assert all(max(after) <= max(before) + GROWTH for before, after in halves), "a view grows"


if __name__ == "__main__":
    main()
