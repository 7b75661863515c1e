"""The server of a view: this machine alone, nothing without the token, and no message that ends it."""

import asyncio
import contextlib
import dataclasses
import http.client
import json
import os
import re
import signal
import socket
import struct
import subprocess
import sys
import threading
import time
from pathlib import Path

import jax
import numpy as np
import pytest
from views import HEIGHT, SETTINGS, WIDTH, camera, scene

pytest.importorskip("websockets", reason="the extra `view` is not installed")
from by_reference import pictures_by_reference
from commanded import run as commanded
from derivatives import QUICKLY
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import connect

import jaxsph as js
from jaxsph.cli import scene as cli_scene
from jaxsph.cli.commands import view as command
from jaxsph.io.opening import values
from jaxsph.viewer.server import MAX_MESSAGE, MAX_RECEIVED, MAX_TABS, Server
from jaxsph.viewer.session import Session

pytestmark = pytest.mark.usefixtures("quick_programs")

SECONDS = 240
ROOT = Path(__file__).parent.parent.parent


@pytest.fixture(scope="module")
def server():
    """A server on a thread of its own, whose view is rendered."""
    with pictures_by_reference(), Session(scene(), camera(), SETTINGS) as session:
        made, began, stops = Server(session), threading.Event(), []

        async def serve():
            stop = asyncio.Event()
            stops.append((asyncio.get_running_loop(), stop))
            await made.serve(began.set, stop)

        thread = threading.Thread(target=asyncio.run, args=(serve(),))
        thread.start()
        assert began.wait(60)
        yield made
        loop, stop = stops[0]
        loop.call_soon_threadsafe(stop.set)
        thread.join(60)
        assert not thread.is_alive()


def got(server, path, method="GET", **headers):
    """Status, headers and content of an answer."""
    connection = http.client.HTTPConnection("127.0.0.1", server.port, timeout=SECONDS)
    connection.request(method, path, headers={"Host": f"127.0.0.1:{server.port}", **headers})
    answer = connection.getresponse()
    return answer.status, answer.headers, answer.read()


def tab(server, **more):
    return connect(f"ws://127.0.0.1:{server.port}/{server.token}/socket", max_size=None, open_timeout=SECONDS, **more)


def heard(socket, kind, seconds=SECONDS):
    """The next message of a kind: what it says, and its picture."""
    end = time.monotonic() + seconds
    while True:
        message = socket.recv(timeout=max(0.0, end - time.monotonic()))
        if isinstance(message, str):
            told, picture = json.loads(message), None
        else:
            (length,) = struct.unpack(">I", message[:4])
            told, picture = json.loads(message[4 : 4 + length]), message[4 + length :]
        if told["is"] == kind:
            return told, picture


def test_the_page_and_its_modules_are_there_and_load_nothing_from_elsewhere(server):
    status, headers, page = got(server, f"/?token={server.token}")
    assert status == 200 and headers["Content-Type"].startswith("text/html") and f"/{server.token}/".encode() in page
    policy = headers["Content-Security-Policy"]
    assert "default-src 'none'" in policy and "http" not in policy and headers["Referrer-Policy"] == "no-referrer"
    for name, kind in (("main.js", "text/javascript"), ("view.js", "text/javascript"), ("view.css", "text/css")):
        status, headers, text = got(server, f"/{server.token}/{name}")
        assert status == 200 and headers["Content-Type"].startswith(kind)
        assert not re.search(rb"https?://(?!www\.w3\.org/2000/svg)", text)
    assert got(server, f"/{server.token}/nothing.js")[0] == 404


def test_without_the_token_or_from_elsewhere_there_is_nothing(server):
    good = f"/?token={server.token}"
    tokens = "", "?token=", "?token=wrong", f"?token={server.token}x"
    for path in (*tokens, "view.js", "x/view.js", "socket", "/", "%00", "../etc"):
        assert got(server, f"/{path}")[0] == 403, path
    mine = f"127.0.0.1:{server.port}"
    evil = [{"Origin": origin} for origin in ("http://evil.example", "null", f"https://{mine}")]
    evil += [{"Host": host} for host in ("evil.example", f"evil.example:{server.port}", "")] + [{"Sec-Fetch-Site": "cross-site"}]
    for headers in evil:
        assert got(server, good, **headers)[0] == 403, headers
    entered = {"Sec-Fetch-Site": "cross-site", "Sec-Fetch-Mode": "navigate", "Sec-Fetch-Dest": "document"}  # as from a file
    assert got(server, good, **entered)[0] == 200
    for path in ("/", "/?token=wrong", f"/{server.token}/view.js", f"/{server.token}/view.png"):
        assert got(server, path, **entered)[0] == 403, path
    assert got(server, good, **entered | {"Sec-Fetch-Dest": "iframe"})[0] == 403
    assert got(server, good, Origin=f"http://127.0.0.1:{server.port}")[0] == 200
    assert got(server, good, Host=f"localhost:{server.port}")[0] == 200
    for address, more in ((f"/socket?token={server.token}", {}), (f"/{server.token}/socket", {"origin": "http://evil.example"})):
        with pytest.raises(InvalidStatus, match="403"):
            connect(f"ws://127.0.0.1:{server.port}{address}", **more)


def test_nothing_listens_beyond_this_machine(server):
    if Path("/proc/net/tcp").exists():
        rows = [line.split() for file in ("tcp", "tcp6") for line in Path(f"/proc/net/{file}").read_text().splitlines()[1:]]
        mine = {row[1].split(":")[0] for row in rows if row[3] == "0A" and int(row[1].split(":")[1], 16) == server.port}
        assert mine == {"0100007F"}  # 127.0.0.1, little-endian
    with pytest.raises(OSError):
        socket.create_connection(("127.0.0.2", server.port), timeout=5)


def test_inputs_become_frames_with_words(server):
    with tab(server) as page:
        state, _ = heard(page, "state")
        assert state["size"] == [WIDTH, HEIGHT] and len(state["look"]["points"]) == 4
        page.send(json.dumps({"do": "orbit", "right": 0.1, "down": 0}))
        told, picture = heard(page, "picture")
        while not told["final"] or told["version"] == state["version"]:
            told, picture = heard(page, "picture")
        assert told["format"] == "png" and picture[:4] == b"\x89PNG" and "full: 48 x 32" in told["words"]
        histogram, _ = heard(page, "histogram")
        assert len(histogram["edges"]) == len(histogram["absorbed"]) + 1 and max(histogram["absorbed"]) == 1
        page.send(json.dumps({"do": "pick", "right": 0, "down": 0}))
        assert heard(page, "picked")[0]["of"] == [HEIGHT, WIDTH]
        page.send(json.dumps({"do": "code"}))
        assert "js.render(scene, camera" in heard(page, "code")[0]["python"]


GARBAGE = ["", "{", "[]", "null", '"x"', "[" * 30000, '{"do":', b"\x00\xff", "x" * (MAX_MESSAGE + 1), "\ud7ff"]
GARBAGE += ['{"do": "orbit", "right": 1e999, "down": 0}', '{"do": "orbit", "right": NaN, "down": 0}', '{"do": {"do": 1}}']


@pytest.mark.parametrize("message", GARBAGE, ids=range(len(GARBAGE)))
def test_garbage_is_answered_and_ends_nothing(server, message):
    version = server.session.version
    with tab(server) as page:
        heard(page, "picture")
        page.send(message)
        assert heard(page, "error")[0]["text"]
        page.send(json.dumps({"do": "pick", "right": 0, "down": 0}))
        heard(page, "picked")
    assert server.session.version == version


def test_what_is_much_too_long_closes_its_own_tab_alone(server, capfd):
    with tab(server) as other, tab(server) as page:
        page.send("x" * (MAX_RECEIVED + 1))
        with pytest.raises(ConnectionClosed):
            while True:
                page.recv(timeout=SECONDS)
        other.send(json.dumps({"do": "code"}))
        heard(other, "code")
    with contextlib.suppress(http.client.RemoteDisconnected, ConnectionResetError):
        assert got(server, f"/?token={server.token}", method="POST")[0] == 405
    broken = socket.create_connection(("127.0.0.1", server.port))
    broken.sendall(b"\x00\xff\x17 nothing of HTTP\r\n\r\n")
    broken.close()
    assert got(server, f"/?token={server.token}")[0] == 200
    assert capfd.readouterr().err == ""


def test_tabs_show_one_view_and_may_be_closed_and_opened_again(server):
    with tab(server) as one:
        with tab(server) as other:
            heard(other, "state")
            one.send(json.dumps({"do": "roll", "degrees": 7}))
            version = None
            while version != server.session.version:
                version = heard(other, "state")[0]["version"]
        one.send(json.dumps({"do": "roll", "degrees": 7}))
        while heard(one, "picture")[0]["version"] != server.session.version:
            pass
    with tab(server) as again:
        assert heard(again, "state")[0]["version"] == server.session.version
    with contextlib.ExitStack() as tabs:
        for _ in range(MAX_TABS):
            tabs.enter_context(tab(server))
        with pytest.raises(InvalidStatus, match="503"):
            tabs.enter_context(tab(server))
    end = time.monotonic() + 30
    while server._tabs and time.monotonic() < end:
        time.sleep(0.02)
    assert not server._tabs


def test_pictures_and_looks_can_be_kept(server, tmp_path):
    import jaxsph as js

    server.session.wait(seconds=SECONDS)
    status, headers, content = got(server, f"/{server.token}/view.exr")
    assert status == 200 and "attachment" in headers["Content-Disposition"]
    (tmp_path / "view.exr").write_bytes(content)
    image = js.io.read_image(tmp_path / "view.exr")
    assert np.allclose(np.asarray(image.color), np.asarray(server.session.picture.image.color), atol=1e-5)
    (tmp_path / "look.json").write_bytes(got(server, f"/{server.token}/look.json")[2])
    assert np.array_equal(js.TransferFunction.load(tmp_path / "look.json").values, server.session.snapshot().transfer.values)
    assert got(server, f"/{server.token}/keys.json")[0] == 404
    version = server.session.version
    for _ in range(2):
        server.session.do({"do": "key"})
    (tmp_path / "keys.json").write_bytes(got(server, f"/{server.token}/keys.json")[2])
    assert js.CameraPath.load(tmp_path / "keys.json").legs[0].times == (0, 2)
    assert server.session.version == version  # no picture is made again


def test_words_of_a_command_that_make_no_sense(capsys, empty):
    wrong_port, as_json = ["scene:radial", "--port", "70000"], ["scene:radial", "--json"]
    for arguments, said in (([], "FILE"), (wrong_port, "--port"), (as_json, "--json"), (["nowhere.npz"], "nowhere.npz")):
        code, _, wrong = commanded(capsys, "view", *arguments)
        assert code in (1, 2) and len(wrong) == 1 and said in wrong[0]


def test_a_port_that_is_taken_is_told(capsys, server):
    code, _, wrong = commanded(
        capsys, "view", "scene:radial:particles=50", "--size", "8x8", "--no-browser", "--port", str(server.port)
    )
    assert code == 1 and len(wrong) == 1


def test_without_the_extra_one_line_names_it(capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "websockets", None)
    code, _, wrong = commanded(capsys, "view", "scene:radial:particles=50")
    assert code == 1 and wrong == [
        'jaxsph view: the library `websockets` is needed for an interactive view: pip install "jaxsph[view]"'
    ]


@pytest.mark.skipif(os.name != "posix", reason="signals are POSIX's")
@pytest.mark.parametrize("late", [False, True], ids=["while it compiles", "once it stands"])
def test_an_interrupt_ends_it_with_exit_code_0(late):
    size, how = ["--size", f"{WIDTH}x{HEIGHT}", "--samples", "16"], ["--integrator", "samples", "--no-browser"]
    words = [sys.executable, "-m", "jaxsph", "view", "scene:radial:particles=200", *size, *how]
    flags = [f"--{name}={str(value).lower()}" for name, value in QUICKLY.items()]
    environment = {**os.environ, "XLA_FLAGS": " ".join([os.environ.get("XLA_FLAGS", ""), *flags])}
    process = subprocess.Popen(words, stdout=subprocess.PIPE, text=True, cwd=ROOT, env=environment)
    try:
        line = process.stdout.readline()
        found = re.fullmatch(r"http://127\.0\.0\.1:(\d+)/\?token=([\w-]{20,})\n", line)
        assert found, line
        if late:
            with connect(f"ws://127.0.0.1:{found[1]}/{found[2]}/socket", max_size=None) as page:
                while not heard(page, "picture")[0]["final"]:
                    pass
        process.send_signal(signal.SIGINT)
        assert process.wait(60) == 0
        assert process.stdout.read() == ""
    finally:
        process.kill()
        process.wait()


def test_settings_of_the_command():
    fog = scene()
    fluid = dataclasses.replace(fog, surface=js.Surface())

    def made(asked, shown=fog):
        return command._settings(asked, shown)

    assert made(command.Asked()).tolerance == 0.01
    assert made(command.Asked(samples=64)).samples == 64
    asked = made(command.Asked(tolerance=0.1))
    assert (asked.tolerance, asked.integrator_used) == (0.1, "segments")
    assert made(command.Asked(tolerance=0.1, estimator="pilot")).integrator_used == "samples"
    assert made(command.Asked(integrator="samples")).tolerance is None
    assert made(command.Asked(), fluid).tolerance is None  # a surface has none


def test_a_view_fits_its_window_unless_a_size_was_asked_for(monkeypatch, capsys):
    opened = []
    monkeypatch.setattr(command, "run", lambda server, ready: opened.append(server.session))
    for size in ([], ["--size", "8x8"]):
        assert commanded(capsys, "view", "scene:radial:particles=50", "--no-browser", *size)[0] == 0
    for session, size in zip(opened, ([64, 48], [8, 8]), strict=True):
        session.do({"do": "size", "width": 64, "height": 48})
        space, seen = {}, session.snapshot().camera
        exec(session.code()["python"].partition("image = ")[0], space)
        assert session.state()["size"] == size == [space["camera"].width, space["camera"].height]
        for one, other in zip(jax.tree.leaves(space["camera"]), jax.tree.leaves(seen), strict=True):
            np.testing.assert_array_equal(one, other)


def test_the_token_is_in_no_command_line(tmp_path, monkeypatch, capsys):
    """A browser is started with the name of a file that leads to the address, and that this user alone can read."""
    opened = []

    def browse(address):
        path = Path(address.removeprefix("file://"))
        opened.append((address, path.read_text(), path.parent.stat().st_mode & 0o077))

    monkeypatch.setattr(command.webbrowser, "open", browse)
    monkeypatch.setattr(command, "run", lambda server, ready: ready())
    assert commanded(capsys, "view", "scene:radial:particles=50", "--size", "8x8")[0] == 0
    ((address, page, others),) = opened
    token = re.search(r"token=([\w-]+)", page)[1]
    assert address.startswith("file://") and token not in address and not others and "127.0.0.1" in page
    assert not Path(address.removeprefix("file://")).exists()


def test_the_python_of_a_view_opens_what_its_words_opened(empty):
    position = np.random.default_rng(0).normal(size=(60, 3))
    np.savez("a.npz", position=position, support=np.full(60, 0.8), heat=position[:, 0])
    words = {"exposure": 1.0, "support": 0.9, "range": (-1.0, 2.0), "fov_degrees": 30.0, "where": "heat > -1"}
    asked = command.Asked(source="a.npz", clips=(values.clip("~sphere:0,0,0,0.5"),), size=(12, 8), **words)
    made = cli_scene.opened_of(asked)
    opened, seen = made.scene, made.camera
    space = {"js": js}
    exec(command._source(asked).python, space)
    for one, other in zip(*(jax.tree.leaves(made) for made in ((opened, seen), (space["scene"], space["camera"]))), strict=True):
        np.testing.assert_array_equal(one, other)
    assert "points" in command._source(dataclasses.replace(asked, points=("stars",), words=("a.npz", "--points=stars"))).python
