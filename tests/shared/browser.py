"""A real browser: Chromium from the system, driven by its own protocol over a socket (DevTools), without a window."""

import base64
import contextlib
import json
import os
import shutil
import subprocess
import time
import urllib.request
from pathlib import Path

from websockets.sync.client import connect

NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
SECONDS = 60


def found():
    """The browser of this machine; None where there is none."""
    return next((path for name in NAMES if (path := shutil.which(name))), None)


class Page:
    """A tab."""

    def __init__(self, browser, address, scale):
        request = urllib.request.Request(f"http://127.0.0.1:{browser.port}/json/new?about:blank", method="PUT")
        with urllib.request.urlopen(request, timeout=SECONDS) as answer:
            told = json.load(answer)
        self.opened = contextlib.ExitStack()
        self.socket = self.opened.enter_context(connect(told["webSocketDebuggerUrl"], max_size=None, open_timeout=SECONDS))
        self.number, self.said, self.scale = 0, [], scale
        self.call("Page.enable")
        self.call("Runtime.enable")
        self.call("Log.enable")
        self.call("Browser.setDownloadBehavior", behavior="allow", downloadPath=str(browser.folder))
        self.size(1280, 800)
        self.go(address)

    def call(self, method, **parameters):
        self.number += 1
        self.socket.send(json.dumps({"id": self.number, "method": method, "params": parameters}))
        while True:
            message = json.loads(self.socket.recv(timeout=SECONDS))
            if message.get("id") == self.number:
                assert "error" not in message, message
                return message["result"]
            if message.get("method") in ("Runtime.exceptionThrown", "Log.entryAdded"):
                self.said.append(message["params"])

    def size(self, width, height):
        size = {"width": width, "height": height}
        self.call("Emulation.setDeviceMetricsOverride", **size, deviceScaleFactor=self.scale, mobile=False)

    def go(self, address):
        self.call("Page.navigate", url=address)

    def ask(self, expression):
        """What JavaScript makes of it."""
        told = self.call("Runtime.evaluate", expression=expression, returnByValue=True, awaitPromise=True)
        assert "exceptionDetails" not in told, told
        return told["result"].get("value")

    def until(self, expression, seconds=SECONDS):
        """Wait until JavaScript finds it true."""
        end = time.monotonic() + seconds
        careful = f"(() => {{ try {{ return {expression}; }} catch {{ return null; }} }})()"  # a page that is not there yet
        while not (value := self.ask(careful)):
            assert time.monotonic() < end, (expression, self.ask("document.body.innerText"), self.said)
            time.sleep(0.02)
        return value

    def mouse(self, kind, x, y, button="none", clicks=0, shift=False, **more):
        self.call("Input.dispatchMouseEvent", type=f"mouse{kind}", x=x, y=y, button=button, clickCount=clicks,
                  modifiers=8 if shift else 0, **more)  # fmt: skip

    def drag(self, way, button="left", shift=False):
        """Along places (x, y) of the window."""
        self.mouse("Pressed", *way[0], button, 1, shift)
        for place in way[1:]:
            self.mouse("Moved", *place, button, 0, shift)
        self.mouse("Released", *way[-1], button, 1, shift)

    def click(self, x, y, clicks=1):
        for count in range(1, clicks + 1):
            self.mouse("Pressed", x, y, "left", count)
            self.mouse("Released", x, y, "left", count)

    def key(self, key, code="", number=0, text=None, modifiers=0):
        told = {"key": key, "code": code or key, "windowsVirtualKeyCode": number, "modifiers": modifiers}
        self.call("Input.dispatchKeyEvent", type="keyDown", **told, **({"text": text} if text else {}))
        self.call("Input.dispatchKeyEvent", type="keyUp", **told)

    def middle(self, selector):
        """Of an element, in the window."""
        return self.ask(f"(() => {{ const b = document.querySelector({selector!r}).getBoundingClientRect();"
                        " return [b.left + b.width / 2, b.top + b.height / 2]; })()")  # fmt: skip

    def picture(self):
        """A screenshot, the bytes of a PNG."""
        return base64.b64decode(self.call("Page.captureScreenshot", format="png")["data"])

    def close(self):
        with contextlib.suppress(Exception):
            self.call("Page.close")
        self.opened.close()


class Browser:
    """A browser with a profile of its own in a folder, where downloads go, too."""

    def __init__(self, folder):
        self.folder = Path(folder)
        profile = self.folder / "profile"
        flags = ["--headless=new", "--remote-debugging-port=0", f"--user-data-dir={profile}", "--no-first-run", "--disable-gpu",
                 "--disable-dev-shm-usage", "--hide-scrollbars", "--remote-allow-origins=*"]  # fmt: skip
        if os.name == "posix" and os.geteuid() == 0:
            flags.append("--no-sandbox")
        self.process = subprocess.Popen([found(), *flags, "about:blank"], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        place, end = profile / "DevToolsActivePort", time.monotonic() + SECONDS
        while not (place.exists() and place.read_text().count("\n")):
            assert self.process.poll() is None and time.monotonic() < end, "the browser does not start"
            time.sleep(0.05)
        self.port = int(place.read_text().split()[0])
        self.pages = []

    def page(self, address, scale=1):
        """A tab, on a screen that has so many pixels for one of its window, along each side."""
        self.pages.append(Page(self, address, scale))
        return self.pages[-1]

    def close(self):
        for page in self.pages:
            page.close()
        self.process.terminate()
        try:
            self.process.wait(10)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()
