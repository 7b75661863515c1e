"""What public calls are given of a wrong kind, or what is no number, is refused by the name of the argument."""

import numpy as np
import pytest

import jaxsph as js

PLACES = np.random.default_rng(2).random((12, 3))
FLUID = js.Particles.from_arrays(PLACES, 0.4, PLACES[:, 0])
SHOWN = js.Scene(particles=FLUID, surface=js.Surface(0.5))
PLANE = js.Plane((0, 0, 0.5), (0, 0, 1))
LOOK = js.TransferFunction.from_points([0.0, 1.0], [(0, 0, 0), (1, 1, 1)], [0.0, 1.0])
VIEW = js.Camera.look_at((0, 0, 3), (0, 0, 0), width=4, height=4, near=1, far=5)
PATH = js.CameraPath.from_keys([(0, VIEW), (1, VIEW)])
CALLS = {
    "capacity": lambda bad: js.Particles.from_arrays(PLACES, 0.3, 1.0, capacity=bad),
    "kernel": lambda bad: js.Particles.from_arrays(PLACES, 0.3, 1.0, kernel=bad),
    "box": lambda bad: js.Particles.from_arrays(PLACES, 0.3, 1.0, box=bad),
    "attributes": lambda bad: js.Points.from_arrays(PLACES, 0.1, extinction=1.0, attributes=bad),
    "splats_beyond": lambda bad: js.Points.from_arrays(PLACES, 0.1, extinction=1.0, splats_beyond=bad),
    "spread": lambda bad: js.Points.from_arrays(PLACES, 0.1, extinction=1.0, spread=bad),
    "spacing": lambda bad: js.Volume.from_array(np.ones((2, 2, 2)), spacing=bad),
    "level": lambda bad: js.Surface(bad),
    "antialias": lambda bad: js.Surface(antialias=bad),
    "radius": lambda bad: js.Sphere((0, 0, 0), bad),
    "mix": lambda bad: js.Scene(FLUID, LOOK, mix=bad),
    "memory_limit": lambda bad: js.Settings(memory_limit=bad),
    "merge": lambda bad: js.Settings(merge=bad),
    "values": lambda bad: js.TransferFunction.from_points(bad, [(0, 0, 0)], [1.0]),
    "colors": lambda bad: js.TransferFunction.from_points([1.0], bad, [1.0]),
    "extinction": lambda bad: js.TransferFunction.from_colormap("viridis", [0.0, 1.0], bad),
    "points": lambda bad: js.TransferFunction.from_matplotlib("viridis", low=0.0, high=1.0, points=bad),
    "low": lambda bad: js.TransferFunction.control_values("linear", low=bad, high=1.0),
    "quantity": lambda bad: js.TransferFunction.control_values("linear", bad),
    "shown": lambda bad: js.TransferFunction.preset("density", bad),
    "near": lambda bad: js.Camera.look_at((0, 0, 1), (0, 0, 0), near=bad, far=2),
    "fov_degrees": lambda bad: js.Camera.look_at((0, 0, 1), (0, 0, 0), fov_degrees=bad),
    "view_height": lambda bad: js.Camera.orthographic((0, 0, 1), (0, 0, 0), view_height=bad),
    "direction": lambda bad: js.Camera.framing(FLUID, direction=bad),
    "depth_range": lambda bad: js.Camera.along_axis(FLUID, "z", depth_range=bad),
    "margin": lambda bad: js.Camera.along_axis(FLUID, "z", margin=bad),
    "width": lambda bad: js.Camera.along_axis(FLUID, "z", width=bad),
    "scene": lambda bad: js.Camera.fitted(bad),
    "time": lambda bad: PATH.at(bad),
    "frames": lambda bad: PATH.cameras(bad),
    "keys": lambda bad: js.CameraPath.from_keys(bad),
    "other": lambda bad: PATH.then(bad),
    "headroom": lambda bad: js.plan(SHOWN, VIEW, headroom=bad),
    "particles": lambda bad: js.prepare(bad),
    "plane": lambda bad: js.slice(FLUID, bad),
    "center": lambda bad: js.slice(FLUID, PLANE, width=4, height=4, center=bad),
    "up": lambda bad: js.slice(FLUID, PLANE, width=4, height=4, up=bad),
    "shape": lambda bad: js.resample(FLUID, (0, 0, 0), 0.1, bad),
    "fill": lambda bad: js.resample(FLUID, (0, 0, 0), 0.1, (2, 2, 2), fill=bad),
    "cell": lambda bad: js.mesh(SHOWN, cell=bad),
    "tolerance": lambda bad: js.project(FLUID, VIEW, tolerance=bad),
    "pixel": lambda bad: js.project(FLUID, VIEW, pixel=bad),
    "path": lambda bad: js.TransferFunction.load(bad),
}
WRONG = {"object": object(), "complex": 1 + 2j, "numbers": np.ones(2), "nothing": np.zeros(0), "pair": ("1", "2")}


@pytest.mark.parametrize("name", CALLS)
@pytest.mark.parametrize("bad", WRONG.values(), ids=WRONG)
def test_a_wrong_kind_is_refused_by_name(name, bad):
    right = {
        ("shown", "numbers"),
        ("quantity", "numbers"),
        ("quantity", "nothing"),
        ("extinction", "numbers"),
        ("values", "numbers"),
    }
    if (name, next(key for key, value in WRONG.items() if value is bad)) not in right:
        with pytest.raises(ValueError, match=rf"`{name}\b"):
            CALLS[name](bad)


SLIPS = [("shape", (10**5, 10**5, 10**5)), ("shape", 5), ("cell", np.inf), ("capacity", 10**40), ("capacity", 30.5)]
SLIPS += [("points", 10**40), ("width", 0), ("memory_limit", "4 GiB"), ("near", "1 kpc"), ("center", "densest")]
SLIPS += [("radius", None), ("values", None)]


@pytest.mark.parametrize(("name", "bad"), SLIPS)
def test_a_plausible_slip_is_refused_by_name(name, bad):
    with pytest.raises(ValueError, match=rf"`{name}`"):
        CALLS[name](bad)
