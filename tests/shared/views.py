"""A small scene to look around in, and its view."""

import time

import numpy as np

import jaxsph as js

WIDTH, HEIGHT = 48, 32
SETTINGS = js.Settings(samples=16)
NUMBER = 5  # of frames of a sequence
SECONDS = 240


def scene(seed=0):
    """Particles in a ball, and a look of four points."""
    rng = np.random.default_rng(seed)
    position = rng.normal(0, 0.35, (80, 3)).clip(-1, 1).astype(np.float32)
    particles = js.Particles.from_arrays(position, np.float32(0.4), position[:, 0])
    colors = [(0.1, 0.2, 0.9), (0.1, 0.8, 0.3), (0.9, 0.9, 0.2), (0.9, 0.3, 0.1)]
    transfer = js.TransferFunction.from_points(np.float32([-0.6, -0.2, 0.2, 0.6]), colors, np.float32([1, 4, 6, 8]))
    return js.Scene(particles=particles, transfer=transfer)


def camera(width=WIDTH, height=HEIGHT):
    return js.Camera.look_at((0.3, 0.5, 4.0), (0, 0, 0), width=width, height=height, fov_degrees=35.0, near=2.0, far=6.0)


def rested(session):
    """The last picture of a view, once all that is made after it, its histogram, is made, too."""
    picture = session.wait(seconds=SECONDS)
    until(lambda: (session.histogram or {}).get("version") == session.version)
    return picture


def sequence(folder, wrong=(3,)):
    """Files of a ball that moves, some of which are none."""
    for number in range(NUMBER):
        path = folder / f"s_{number}.npz"
        position = np.asarray(scene().particles.position) + np.float32(0.1 * number)
        columns = {"support": np.full(80, 0.4, np.float32), "heat": position[:, 0], "id": np.arange(80)}
        np.savez(path, position=position, time=0.5 * number, **columns)
        if number in wrong:
            path.write_bytes(path.read_bytes()[:99])
    paths = sorted(folder.glob("s_*.npz"))
    return js.sequence.Snapshots.from_files(paths, "heat", transfer=scene().transfer, strict=False)


def same(image, other):
    """Whether images are the same bits."""
    names = ("color", "transmittance", "depth")
    return all(np.array_equal(np.asarray(getattr(image, name)), np.asarray(getattr(other, name))) for name in names)


def as_it_began(session):
    """Undo what was done to look, cut and camera."""
    session.do({"do": "reset_look"})
    session.do({"do": "cut", "kind": "off"})
    session.do({"do": "home"})


def until(happens):
    """Wait."""
    end = time.monotonic() + SECONDS
    while not happens():
        assert time.monotonic() < end
        time.sleep(0.01)


def asked(session, number):
    """The picture of a frame."""
    session.do({"do": "frame", "number": number})
    until(lambda: session.state()["frames"]["number"] == number)
    return session.wait(seconds=SECONDS)
