"""A view in a notebook: the same page, whose messages go through the kernel."""

import base64
import json
import sys
import time

import browser as browsers
import pytest
from by_reference import pictures_by_reference
from views import HEIGHT, SETTINGS, WIDTH, camera, scene

import jaxsph as js

pytest.importorskip("anywidget", reason="the extra `view` is not installed")
from jaxsph.viewer.widget import bundle

SECONDS = 240
NOTEBOOK = """
import sys
sys.path.insert(0, {shared!r})
import jaxsph as js
from views import SETTINGS, camera, scene
widget = js.view(scene(), camera(), SETTINGS)
picture = widget.session.wait()
print(picture.words)
widget
"""

SHIM = """(async () => {
  window.sent = [];
  window.model = { send: (message) => sent.push(message), on: (_, receive) => { window.heard = receive; }, off() {} };
  const url = URL.createObjectURL(new Blob([atob(BUNDLE)], { type: 'text/javascript' }));
  const module = await import(url);
  const el = document.createElement('div');
  document.body.append(el);
  module.default.render({ model, el });
})()"""


class Notebook:
    """Who sees a widget, and answers that pictures have come."""

    def __init__(self, widget, answers=True):
        self.widget, self.answers, self.told = widget, answers, []
        widget._sender._send = self.receive

    def receive(self, message, buffers=()):
        self.told.append((message, list(buffers)))
        if message["is"] == "picture" and self.answers:
            self.say({"do": "seen"})

    def say(self, message):
        self.widget._received(message)

    def wait(self, *kinds):
        end = time.monotonic() + SECONDS
        while not set(kinds) <= {message["is"] for message, _ in self.told}:
            assert time.monotonic() < end, [message["is"] for message, _ in self.told]
            time.sleep(0.01)
        return {message["is"]: (message, buffers) for message, buffers in self.told}


@pytest.fixture(scope="module")
def widget():
    with pictures_by_reference():
        made = js.view(scene(), camera(), SETTINGS)
        yield made
        made.close()
    assert not made.session._listeners


def test_messages_of_a_notebook_are_done_and_answered(widget):
    notebook = Notebook(widget)
    notebook.say({"do": "hello"})
    widget.session.wait(seconds=SECONDS)
    told = notebook.wait("state", "picture", "histogram")
    assert told["picture"][1][0][:2] in (b"\xff\xd8", b"\x89P") and told["state"][0]["size"] == [WIDTH, HEIGHT]
    notebook.say({"do": "pick", "right": 0, "down": 0})
    notebook.say({"do": "code"})
    notebook.say({"do": "nothing of the kind"})
    notebook.say("garbage")
    told = notebook.wait("picked", "code", "error")
    assert "given to js.view" in told["code"][0]["python"]


def test_frames_do_not_pile_up_where_a_notebook_is_slow(widget):
    notebook = Notebook(widget, answers=False)
    for _ in range(5):
        notebook.say({"do": "orbit", "right": 0.1, "down": 0})
        widget.session.wait(seconds=SECONDS)
    pictures = [message for message, _ in notebook.told if message["is"] == "picture"]
    assert len(pictures) <= 2
    notebook.say({"do": "seen"})
    assert [message for message, _ in notebook.told if message["is"] == "picture"][-1]["version"] == widget.session.version


def test_without_the_extra_it_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "anywidget", None)
    with pytest.raises(ImportError, match=r"jaxsph\[view\]"):
        js.view(scene(), camera(), SETTINGS)


@pytest.mark.skipif(browsers.found() is None, reason="there is no chromium on the PATH")
def test_the_modules_are_one_module_that_shows_pictures(widget, tmp_path):
    notebook = Notebook(widget)
    notebook.say({"do": "hello"})
    widget.session.wait(seconds=SECONDS)
    told = notebook.wait("state", "picture", "histogram")
    browser = browsers.Browser(tmp_path)
    try:
        page = browser.page("about:blank")
        page.ask(SHIM.replace("BUNDLE", json.dumps(base64.b64encode(bundle().encode()).decode())))
        assert page.ask("sent.map((m) => m.do)") == ["hello"]
        for message, buffers in (told["state"], told["histogram"], told["picture"]):
            data = base64.b64encode(buffers[0]).decode() if buffers else ""
            page.ask(f"heard({json.dumps(message)}, [Uint8Array.from(atob({json.dumps(data)}), (c) => c.charCodeAt(0))])")
        page.until("document.querySelector('.chip').textContent !== '…'")
        assert page.ask("sent.map((m) => m.do)") == ["hello", "seen"]
        assert page.ask("document.querySelectorAll('.editor .point').length") == 4
        page.ask("window.keys = [], document.addEventListener('keydown', (event) => { keys.push(event.key); })")
        for selector in (".picture", ".editor .point", ".panel button", ".panel select"):
            page.ask(f"document.querySelector({selector!r}).focus()")
            page.key("d", text="d")  # twice deletes a cell of a notebook
            page.key("s", modifiers=2)
        assert page.ask("keys") == ["s"] * 4  # with Ctrl it is the notebook's
    finally:
        browser.close()


@pytest.mark.notebook
def test_a_notebook_shows_it():
    import nbformat
    from nbclient import NotebookClient

    shared = str(browsers.__file__).rsplit("/", 1)[0]
    notebook = nbformat.v4.new_notebook(cells=[nbformat.v4.new_code_cell(NOTEBOOK.format(shared=shared))])
    NotebookClient(notebook, timeout=SECONDS, kernel_name="python3").execute()
    said, shown = notebook.cells[0].outputs
    assert said["text"].startswith("full: 48 x 32") and "application/vnd.jupyter.widget-view+json" in shown["data"]
