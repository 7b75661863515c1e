"""A person in front of a real browser: opens, drags, zooms, edits colours, clicks, saves and closes."""

import contextlib
import io
import json
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from PIL import Image as Pillow

pytest.importorskip("websockets", reason="the extra `view` is not installed")
import browser as browsers
import by_reference

import jaxsph as js

pytestmark = pytest.mark.skipif(browsers.found() is None, reason="there is no chromium on the PATH")
ROOT = Path(__file__).parent.parent.parent
SIZE, SAMPLES, PARTICLES = (96, 72), 16, 300
SECONDS = 120


@contextlib.contextmanager
def served(*more, of=(f"scene:radial:particles={PARTICLES}",), size=SIZE):
    """A view that is served, as the command line does it, with pictures of the reference: its address."""
    words = [*of, *([] if size is None else ["--size", f"{size[0]}x{size[1]}"]), "--samples", str(SAMPLES)]
    more = ["--integrator", "samples", "--no-browser", "-q", *more]
    command = [sys.executable, by_reference.__file__, "view", *words, *more]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, cwd=ROOT)
    yield process.stdout.readline().strip()
    process.send_signal(signal.SIGINT)
    try:
        assert process.wait(60) == 0
    finally:
        process.kill()
        process.wait()


@pytest.fixture(scope="module")
def address():
    with served() as found:
        yield found


@pytest.fixture(scope="module")
def browser(tmp_path_factory):
    made = browsers.Browser(tmp_path_factory.mktemp("browser"))
    yield made
    made.close()


@pytest.fixture
def page(browser, address):
    with opened(browser, address) as made:
        yield made


@contextlib.contextmanager
def opened(browser, address, scale=1):
    """The page once its picture stands still; nothing may go wrong in it."""
    made = browser.page(address, scale)
    made.until("document.body.dataset.final == 'true'", SECONDS)
    yield made
    assert not [said for said in made.said if "exceptionDetails" in said or said["entry"]["level"] == "error"]
    made.close()


def changed(page, does):
    """Do something, and wait until its picture stands still."""
    before = page.ask("+document.body.dataset.version")
    does()
    page.until(f"+document.body.dataset.version > {before} && document.body.dataset.final == 'true'", SECONDS)


def shown(page):
    """What the canvas shows, (H, W, 3)."""
    width, height, values = page.ask(
        "(() => { const c = document.querySelector('.picture');"
        " return [c.width, c.height, [...c.getContext('2d').getImageData(0, 0, c.width, c.height).data]]; })()"
    )
    return np.array(values, np.uint8).reshape(height, width, 4)[..., :3]


def rendered(page):
    """What is made of the same view by the code that the page tells, (H, W, 3)."""
    page.ask("document.querySelector('button[title=\"Python\"]').click()")
    code = page.until("document.querySelector('.code').textContent")
    page.ask("document.querySelector('dialog[open] button').click(), document.querySelector('.code').textContent = ''")
    space = {}
    with by_reference.pictures_by_reference():
        exec(code.replace('image.save("view.png")', ""), space)
    return space["image"].to_uint8()


def near(picture, other):
    return np.abs(picture.astype(int) - other.astype(int)).max() <= 1


def test_what_stands_still_is_the_picture(page):
    scene, camera = js.scenes.load("radial", PARTICLES, width=SIZE[0], height=SIZE[1])
    image = by_reference.render(scene, camera, js.Settings(samples=SAMPLES))
    assert near(shown(page), image.to_uint8()) and image.to_uint8().max() > 100
    assert page.ask("document.querySelector('.status').innerText").replace("\n", " ").startswith(f"full {SIZE[0]} x {SIZE[1]}")
    assert page.ask("document.querySelectorAll('.editor .absorbed').length") in (0, 64)


def test_drag_zoom_edit_and_click(page):
    first = shown(page)
    x, y = page.middle(".picture")
    changed(page, lambda: page.drag([(x, y), (x + 40, y + 5), (x + 90, y + 30)]))
    dragged = shown(page)
    assert not near(first, dragged) and near(dragged, rendered(page))
    changed(page, lambda: page.mouse("Wheel", x + 20, y, deltaX=0, deltaY=-240))
    zoomed = shown(page)
    assert not near(dragged, zoomed) and near(zoomed, rendered(page))
    changed(page, lambda: page.drag([(x, y), (x + 30, y)], button="right"))
    points = page.ask("document.querySelectorAll('.editor .point').length")
    where = page.middle(".editor .point:nth-child(2)")
    changed(page, lambda: page.drag([where, (where[0] + 5, where[1] - 20), (where[0] + 10, where[1] - 45)]))
    edited = shown(page)
    assert not near(zoomed, edited) and near(edited, rendered(page))
    across, down = page.middle(".editor .ground")
    changed(page, lambda: page.click(across - 40, down - 50))
    assert page.ask("document.querySelectorAll('.editor .point').length") == points + 1
    changed(page, lambda: page.key("Delete", number=46))
    assert page.ask("document.querySelectorAll('.editor .point').length") == points
    page.click(x, y)
    said = page.until("document.querySelectorAll('.numbers dt').length > 3 && document.querySelector('.numbers').innerText")
    assert "depth at half light" in said and "quantity" in said
    row, column = 20, 60  # of a picture that is as wide as its element, and lower
    wide = page.ask("document.querySelector('.picture').getBoundingClientRect().width")
    scale = wide / SIZE[0]
    assert scale * SIZE[1] < page.ask("document.querySelector('.picture').getBoundingClientRect().height") - 10
    page.click(x + (column + 0.5 - SIZE[0] / 2) * scale, y + (row + 0.5 - SIZE[1] / 2) * scale)
    page.until(f"document.querySelector('.numbers').innerText.includes('row {row}, column {column} of')")
    changed(page, lambda: page.click(x, y, clicks=2))


def test_opacity_takes_a_shape_whose_colours_stay(page):
    before = shown(page)
    choose = "(() => { const of = document.querySelector('select[aria-label=\"shape of opacity\"]');"
    choose += " of.value = 'hill'; of.dispatchEvent(new Event('change')); })()"
    changed(page, lambda: page.ask(choose))
    assert page.ask("document.querySelectorAll('.editor .point').length") == 5
    after = shown(page)
    assert not near(before, after) and near(after, rendered(page))
    changed(page, lambda: page.ask("document.querySelector('button[title=\"undo (u)\"]').click()"))
    assert near(shown(page), before)


def test_a_surface_has_colours_a_depth_and_a_normal_and_no_opacity(browser):
    with served("--surface", "0.2", size=(32, 24)) as address, opened(browser, address) as page:
        assert shown(page).max() > 100
        said = page.ask("document.querySelector('.panel').innerText.toLowerCase()")
        assert "colour and opacity" not in said and "thinner" not in said and "extinction" not in said
        assert "surface to rounding" in page.ask("document.querySelector('.status').innerText")
        page.click(*page.middle(".picture"))
        found = page.until("document.querySelectorAll('.numbers dt').length > 3 && document.querySelector('.numbers').innerText")
        assert "depth of the surface" in found and "normal" in found
        where = page.middle(".editor .point:nth-child(2)")
        before = page.ask("document.querySelector('.editor .point:nth-child(2)').getAttribute('cy')")
        changed(page, lambda: page.drag([where, (where[0] + 5, where[1] - 20), (where[0] + 10, where[1] - 45)]))
        assert page.ask("document.querySelector('.editor .point:nth-child(2)').getAttribute('cy')") == before
        coloured = shown(page)
        assert near(coloured, rendered(page))
        for name in ("level", "smoothing"):
            slider = f"document.querySelector('input[aria-label={name}]')"
            changed(page, lambda slider=slider: page.ask(f"{slider}.value = -1, {slider}.dispatchEvent(new Event('input')) && 0"))
        assert not near(shown(page), coloured) and near(shown(page), rendered(page))


def test_frames_of_a_sequence_are_chosen_and_one_that_is_damaged_is_named(browser, tmp_path):
    fluid = js.scenes.load("radial", PARTICLES)[0].particles.to_numpy()
    files = [tmp_path / f"s_{number}.npz" for number in range(3)]
    for number, file in enumerate(files):
        position = fluid["position"] * (1 - 0.1 * number)
        np.savez(file, position=position, heat=fluid["quantity"], support=fluid["support"], time=number)
    files[2].write_bytes(files[2].read_bytes()[:999])
    with served("--surface", "none", of=map(str, files)) as address, opened(browser, address) as page:
        page.ask("document.querySelector('.picture').focus()")
        first = shown(page)
        changed(page, lambda: page.key("."))
        assert not near(first, shown(page)) and near(shown(page), rendered(page))
        page.ask("document.querySelector('.picture').focus()")
        page.key(".")
        page.until("document.querySelector('.told').innerText.includes('s_2.npz')")
        slider = "document.querySelector('.panel input[type=range]')"
        assert page.ask(f"{slider}.value") == "2"
        changed(page, lambda: page.ask(f"{slider}.value = 0, {slider}.dispatchEvent(new Event('input')) && 0"))
        assert near(shown(page), first) and page.ask("document.querySelector('.told').hidden")


def test_keys_alone_suffice(page):
    page.ask("document.querySelector('.picture').focus()")
    before = shown(page)
    special = {"ArrowUp": {"modifiers": 8}, "1": {"code": "Digit1"}}
    for key in ("ArrowLeft", "ArrowUp", "+", "]", "1", "0", "f"):
        changed(page, lambda key=key: page.key(key, **special.get(key, {})))
    changed(page, lambda: page.key("h"))
    page.key("i")
    page.until("document.querySelectorAll('.numbers dt').length > 3")
    page.key("?", text="?")
    assert page.until("document.querySelector('dialog[open]')?.innerText").count("\n") > 10
    page.key("Escape", number=27)
    page.until("!document.querySelector('dialog[open]')")
    page.ask("document.querySelector('.editor .point').focus()")
    changed(page, lambda: page.key("ArrowUp"))
    changed(page, lambda: page.ask("document.querySelector('button[title^=\"as it was\"]').click()"))
    assert not near(before, np.zeros_like(before))


def test_a_cut_is_chosen_moved_and_turned_and_the_address_holds_it(page):
    page.ask("document.querySelector('.picture').focus()")
    whole = shown(page)
    changed(page, lambda: page.key("x"))
    plane = shown(page)
    assert not near(whole, plane) and near(plane, rendered(page))
    page.ask("document.querySelector('.picture').focus()")
    for key in ("m", "N", "o", "k", "ArrowLeft"):
        changed(page, lambda key=key: page.key(key))
    assert not near(shown(page), plane) and near(shown(page), rendered(page))
    page.until("decodeURIComponent(location.hash).includes('plane')")
    changed(page, lambda: page.ask("[...document.querySelectorAll('button')].find((b) => b.innerText === 'Sphere').click()"))
    across, down = page.middle("input[aria-label^=place]")
    changed(page, lambda: page.drag([(across - 40, down), (across - 80, down), (across - 110, down)]))
    assert near(shown(page), rendered(page))
    for key in ("o", "x"):
        page.ask("document.querySelector('.picture').focus()")
        changed(page, lambda key=key: page.key(key))
    changed(page, lambda: page.key("h"))
    assert near(shown(page), whole) and page.ask("document.querySelector('input[aria-label^=place]').offsetParent === null")


def test_a_picture_is_saved_and_the_address_holds_the_view(page, browser):
    x, y = page.middle(".picture")
    changed(page, lambda: page.drag([(x, y), (x - 60, y)]))
    picture = shown(page)
    page.key("s")
    saved, end = browser.folder / "view.png", time.monotonic() + 60
    while not saved.exists():
        assert time.monotonic() < end
        time.sleep(0.05)
    with Pillow.open(io.BytesIO(saved.read_bytes())) as found:
        assert near(picture, np.asarray(found.convert("RGB")))
    page.until("location.hash.length > 20")
    held = page.ask("location.href")
    changed(page, lambda: page.key("h"))
    other = browser.page(held)
    other.until("document.body.dataset.final == 'true' && location.hash.length > 20", SECONDS)
    deadline = time.monotonic() + 60
    while not near(shown(other), picture):
        assert time.monotonic() < deadline
    other.close()
    assert json.loads(page.ask("decodeURIComponent(location.hash.slice(1)) || '{}'")) is not None


def test_where_there_is_little_width_the_panel_is_below_the_picture(page):
    """Of a window, or of a cell of a notebook in a window that has more."""
    direction = "getComputedStyle(document.querySelector('.whole')).flexDirection"
    assert page.ask(direction) == "row"
    page.ask("document.body.style.width = '400px'")
    page.until(f"{direction} === 'column' && document.querySelector('.picture').clientWidth > 390")
    longest = "256 x 192, 64 samples a ray; error not estimated; 737,280 rays left, and 134,312 particles · 135 ms"
    for width in (400, 700, 1000):  # words that come and go leave the picture where it is
        page.ask(f"document.body.style.width = '{width}px'")
        write = "(document.querySelector('.words').textContent = {!r}, document.querySelector('.picture').clientHeight)"
        assert page.ask(write.format(longest)) == page.ask(write.format("full"))


@pytest.mark.parametrize(
    ("size", "direction"), [((780, 480), "row"), ((600, 400), "row"), ((500, 700), "column"), ((400, 420), "column")]
)
def test_in_small_windows_all_controls_can_be_reached(page, size, direction):
    page.size(*size)
    page.until(f"getComputedStyle(document.querySelector('.whole')).flexDirection === '{direction}'")
    reach = """(() => { const p = document.querySelector('.panel'); p.scrollTop = p.scrollHeight;
      const r = p.getBoundingClientRect(), last = [...p.querySelectorAll('button')].pop().getBoundingClientRect();
      const c = document.querySelector('.picture').getBoundingClientRect();
      return [r.top, r.bottom, last.bottom, innerHeight, r.height, c.height]; })()"""
    top, bottom, last, window, panel, picture = page.ask(reach)
    assert 0 <= top < bottom <= window + 1 and last <= bottom + 1 and panel > 120 and picture > 60
    page.size(1280, 800)


def test_a_picture_has_the_pixels_of_the_screen_that_its_window_has_room_for(browser):
    room = "[document.querySelector('.frame')].map((e) => e.getBoundingClientRect())"
    room += ".flatMap((b) => [b.height, b.width]).map((side) => Math.round(devicePixelRatio * side))"
    with served(size=None) as address, opened(browser, address, 0.1) as page:
        for size in ((1280, 800), (900, 660)):
            changed(page, lambda size=size: page.size(*size)) if size != (1280, 800) else None
            picture = shown(page)
            assert list(picture.shape[:2]) == page.ask(room) and near(picture, rendered(page)) and picture.max() > 100
        before = shown(page)
        page.ask("document.querySelector('.words').textContent = 'word '.repeat(200)")  # words are no window
        time.sleep(0.5)
        assert shown(page).shape == before.shape


def test_nothing_says_that_a_picture_is_final_until_it_is_that_of_the_view(page):
    """From what is asked for on, in the very moment that it is known."""
    told = "[document.querySelector('.chip').textContent, document.body.dataset.final]"
    page.ask(f"""(window.told = [], new MutationObserver(() => window.told.push([...{told}, +document.body.dataset.version]))
      .observe(document.body, {{subtree: true, childList: true, characterData: true, attributes: true}}), 1)""")
    before = page.ask("+document.body.dataset.version")
    x, y = page.middle(".picture")
    page.click(x, y)
    changed(page, lambda: page.key("2", text="2", code="Digit2"))
    told = page.ask("window.told")
    first = next(nth for nth, (_, final, _) in enumerate(told) if final == "false")
    waited = [row for row in told[first:] if row[2] == before]
    assert waited and all(final == "false" for _, final, _ in waited)
    assert not any(chip in ("full", "tolerance") for chip, _, _ in waited[1:])


def test_code_is_copied(page):
    page.ask("document.querySelector('button[title=\"Python\"]').click()")
    page.until("document.querySelector('dialog[open] .code')?.textContent")
    page.ask("document.querySelector('button[title=\"copy to the clipboard\"]').click()")
    page.until("document.querySelector('dialog[open] output').textContent")
    assert page.ask("getSelection().toString()").strip().startswith("import")
    page.ask("document.querySelector('dialog[open] form button').click()")


def luminance(color):
    red, green, blue = (
        part / 12.92 if part <= 0.04045 else ((part + 0.055) / 1.055) ** 2.4 for part in (one / 255 for one in color)
    )
    return 0.2126 * red + 0.7152 * green + 0.0722 * blue


def test_text_stands_out_from_its_ground(page):
    """Contrast of 4.5 at least (WCAG AA), of all text on grounds of one colour."""
    page.key("?", text="?")
    pairs = page.ask("""[...document.querySelectorAll('.panel *, .status *, dialog *')].filter((e) => e.innerText?.trim()
      && !e.disabled && [...e.childNodes].some((n) => n.nodeType === 3)).map((e) => {
        let ground = e;
        while (ground && getComputedStyle(ground).backgroundColor === 'rgba(0, 0, 0, 0)') ground = ground.parentElement;
        return [e.innerText.slice(0, 20), getComputedStyle(e).color, getComputedStyle(ground ?? document.body).backgroundColor];
      })""")
    assert len(pairs) > 30
    for text, *colors in pairs:
        low, high = sorted(luminance([float(part) for part in re.findall(r"[\d.]+", color)[:3]]) for color in colors)
        assert (high + 0.05) / (low + 0.05) >= 4.5, (text, colors)
