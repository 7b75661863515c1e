"""A server of a view for browsers of this machine: a page, its modules, pictures to keep, and a socket for inputs and pictures.

Flow: Session -> pictures -> [server, 127.0.0.1 alone] <-> pages.

Nobody gets anything without the token of the address, from another origin, or by another name of this machine: such requests are
answered with 403. A tab that is slow gets the newest picture and misses others. All tabs show the same view.
"""

from __future__ import annotations

import asyncio
import contextlib
import functools
import hmac
import http
import importlib.resources
import json
import logging
import secrets
import signal
import struct
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs, urlsplit

from jaxsph.io.damage import require
from jaxsph.viewer.inputs import InputError
from jaxsph.viewer.session import Session
from jaxsph.viewer.stages import Picture

HOST = "127.0.0.1"
NAMES = (HOST, "localhost")
MAX_MESSAGE, MAX_RECEIVED = 1 << 16, 1 << 20  # bytes of an input; and of what closes the connection
MAX_TABS, MAX_ANSWERS = 16, 64
SAVE_SECONDS = 120.0
TEXTS = {".html": "text/html", ".js": "text/javascript", ".css": "text/css"}
TYPES = {**TEXTS, ".png": "image/png", ".exr": "image/x-exr", ".json": "application/json"}
HEADERS = {
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' blob: data:; "
    "connect-src 'self'; base-uri 'self'; form-action 'none'; frame-ancestors 'none'",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cache-Control": "no-store",
    "Cross-Origin-Resource-Policy": "same-origin",
}

LOG = logging.getLogger(__name__)
LOG.addHandler(logging.NullHandler())  # what garbage does to its own connection is nobody's news, unless somebody asks


class Tab:
    """A page that is open: what is to be sent to it, of which the newest of a kind replaces what has not been sent."""

    def __init__(self, socket: Any) -> None:
        self.socket = socket
        self._newest: dict[str, bytes | str] = {}
        self._answers: list[str] = []
        self._ready = asyncio.Event()

    def show(self, kind: str, what: bytes | str) -> None:
        """Send the newest of a kind, after what is under way."""
        self._newest[kind] = what
        self._ready.set()

    def answer(self, what: dict[str, Any]) -> None:
        """Send an answer, of which none replaces another."""
        self._answers = [*self._answers, json.dumps(what)][-MAX_ANSWERS:]
        self._ready.set()

    async def send(self) -> None:
        """Send for ever."""
        while True:
            await self._ready.wait()
            self._ready.clear()
            waiting = *self._answers, *self._newest.values()
            self._answers, self._newest = [], {}
            for what in waiting:
                await self.socket.send(what)


class Server:
    """Serves one view.

    Attributes:
        session: the view.
        token: without which nobody gets anything.
        port: of 127.0.0.1, known once it serves.
    """

    def __init__(self, session: Session, port: int = 0) -> None:
        self.session, self.port, self.token = session, port, secrets.token_urlsafe(24)
        self._tabs: set[Tab] = set()
        folder = importlib.resources.files(__package__) / "page"
        self._files = {file.name: file.read_bytes() for file in folder.iterdir() if Path(file.name).suffix in TEXTS}

    @property
    def url(self) -> str:
        """The address of the page."""
        return f"http://{HOST}:{self.port}/?token={self.token}"

    async def serve(self, ready: Callable[[], None], stop: asyncio.Event) -> None:
        """Serve until `stop` is set; `ready` is called once the port is open.

        Raises:
            OSError: the port is taken.
            ImportError: the library `websockets` is not installed.
        """
        library = require("websockets.asyncio.server", "an interactive view", "view")
        loop = asyncio.get_running_loop()
        undo = self.session.listen(functools.partial(self._told, loop))
        try:
            async with library.serve(
                self._connected, HOST, self.port, process_request=self._requested, compression=None, max_size=MAX_RECEIVED,
                logger=LOG, server_header=None, close_timeout=1,
            ) as served:  # fmt: skip
                self.port = served.sockets[0].getsockname()[1]
                ready()
                await stop.wait()
        finally:
            undo()

    # Requests.

    def _refused(self, path: str, headers: Any) -> bool:
        """Whether who asks has no token, another origin, or another name for this machine."""
        asked = urlsplit(path)
        first, _, _ = asked.path.lstrip("/").partition("/")
        given = first if first else next(iter(parse_qs(asked.query).get("token", [])), "")
        hosts, origins = headers.get_all("Host"), headers.get_all("Origin")
        name = hosts[0].rpartition(":")[0] if len(hosts) == 1 and ":" in hosts[0] else "".join(hosts)
        mine = name in NAMES and all(origin == f"http://{hosts[0]}" for origin in origins)
        goes = headers.get("Sec-Fetch-Mode") == "navigate" and headers.get("Sec-Fetch-Dest") == "document" and not first
        crossed = headers.get("Sec-Fetch-Site") in ("cross-site", "same-site") and not goes  # as from the file of `jaxsph view`
        return not (mine and not crossed and hmac.compare_digest(given.encode(), self.token.encode()))

    async def _requested(self, connection: Any, request: Any) -> Any:
        """The answer to a request; None lets a socket be opened."""
        try:
            refused = self._refused(request.path, request.headers)
        except ValueError:  # no path of an address
            refused = True
        if refused:
            return _answer(connection, http.HTTPStatus.FORBIDDEN, b"403: the token of the address is needed, on this machine\n")
        if getattr(request, "method", "GET") != "GET":
            return _answer(connection, http.HTTPStatus.METHOD_NOT_ALLOWED, b"405: only GET\n")
        name = urlsplit(request.path).path.removeprefix(f"/{self.token}").lstrip("/")
        if name == "socket":
            full = len(self._tabs) >= MAX_TABS
            return _answer(connection, http.HTTPStatus.SERVICE_UNAVAILABLE, b"503: too many tabs\n") if full else None
        if name == "":
            page = self._files["index.html"].replace(b"{{BASE}}", f"/{self.token}/".encode())
            return _answer(connection, http.HTTPStatus.OK, page, "index.html")
        if name in self._files:
            return _answer(connection, http.HTTPStatus.OK, self._files[name], name)
        if name in ("view.png", "view.exr", "look.json", "keys.json"):
            content = await asyncio.to_thread(self._kept, name)
            if content is not None:
                return _answer(connection, http.HTTPStatus.OK, content, name, attached=True)
        return _answer(connection, http.HTTPStatus.NOT_FOUND, b"404: there is no such page\n")

    def _kept(self, name: str) -> bytes | None:
        """A file to keep: a picture of all pixels of the view as it is, its look or its key frames; None where there is none."""
        try:
            state = self.session.snapshot()
            what: Any = state.path if name == "keys.json" else state.transfer
            if not name.endswith(".json"):
                what = self.session.whole(SAVE_SECONDS).image
        except (TimeoutError, RuntimeError):
            return None
        if what is None:
            return None
        with tempfile.TemporaryDirectory(prefix="jaxsph-") as folder:
            path = Path(folder) / name
            what.save(path)
            return path.read_bytes()

    # Sockets.

    async def _connected(self, socket: Any) -> None:
        """One tab, until it is closed."""
        tab = Tab(socket)
        self._tabs.add(tab)
        sending = asyncio.create_task(tab.send())
        try:
            for what in self.session.shown():
                tab.show(*(packed(what) if isinstance(what, dict) else await asyncio.to_thread(packed, what)))
            async for message in socket:
                answer = await asyncio.to_thread(self.session.answer, message, read)
                if answer is not None:
                    tab.answer(answer)
        except _closed():
            pass
        finally:
            self._tabs.discard(tab)
            sending.cancel()
            with contextlib.suppress(asyncio.CancelledError, _closed()):
                await sending

    def _told(self, loop: asyncio.AbstractEventLoop, what: Any) -> None:
        """A picture, or something else, from a thread of the session."""
        message = packed(what)
        with contextlib.suppress(RuntimeError):  # the loop has ended
            loop.call_soon_threadsafe(self._broadcast, *message)

    def _broadcast(self, kind: str, what: bytes | str) -> None:
        for tab in self._tabs:
            tab.show(kind, what)


def packed(what: Any) -> tuple[str, bytes | str]:
    """Of which kind something is, and its message; of a picture 4 bytes, how long its header is, that, JSON, and its file."""
    if not isinstance(what, Picture):
        return what["is"], json.dumps(what)
    header = json.dumps(what.header()).encode()
    return "picture", struct.pack(">I", len(header)) + header + what.encoded


def read(message: Any) -> Any:
    """A message as what it says; `InputError` where it says nothing, or is too long."""
    if not isinstance(message, str):
        raise InputError("a message must be text, JSON")
    if len(message) > MAX_MESSAGE:
        raise InputError(f"a message must have at most {MAX_MESSAGE:,} characters, got {len(message):,}")
    try:
        return json.loads(message)
    except (ValueError, RecursionError):
        raise InputError("a message must be a JSON object") from None


def run(server: Server, ready: Callable[[], None]) -> None:
    """Serve until SIGINT, which is no error.

    Raises:
        OSError: the port is taken.
    """

    async def serve() -> None:
        stop, loop = asyncio.Event(), asyncio.get_running_loop()
        with contextlib.suppress(NotImplementedError):  # where signals are not the loop's, as on Windows
            loop.add_signal_handler(signal.SIGINT, stop.set)
        await server.serve(ready, stop)

    asyncio.run(serve())


def _closed() -> Any:
    return require("websockets.exceptions", "an interactive view", "view").ConnectionClosed


def _answer(connection: Any, status: http.HTTPStatus, content: bytes, name: str = ".txt", *, attached: bool = False) -> Any:
    """A whole answer."""
    answer = connection.respond(status, "")
    answer.body = content
    kind = TYPES.get(Path(name).suffix, "text/plain")
    told = {"Content-Type": f"{kind}; charset=utf-8" if kind.startswith("text/") else kind, "Content-Length": str(len(content))}
    more = {"Content-Disposition": f'attachment; filename="{name}"'} if attached else {}
    for key, value in {**told, **HEADERS, **more}.items():
        with contextlib.suppress(KeyError):
            del answer.headers[key]
        answer.headers[key] = value
    return answer
