"""The front door: what a file becomes with no options, and with those of a figure."""

import numpy as np
import pytest

import jaxsph as js
from jaxsph.io.opening.opened import load, staged
from jaxsph.io.opening.options import Look, Source, View, length_of
from jaxsph.io.parsing import choose_type
from jaxsph.io.table import LENGTH, CodeUnit
from jaxsph.model.preview.glimpse import glimpse

h5py = pytest.importorskip("h5py")

KPC = 3.0857e21
SIZE = (48, 32)
SEEN = js.Settings(samples=32)


def disc(count=3000):
    """A turning disc in the x-z plane about (3, 2, 1), and one particle far away."""
    rng = np.random.default_rng(0)
    radius, angle = rng.exponential(1.0, count), rng.uniform(0, 2 * np.pi, count)
    flat = np.stack([radius * np.cos(angle), 0.05 * rng.normal(size=count), radius * np.sin(angle)], 1)
    turning = np.stack([-np.sin(angle), 0 * angle, np.cos(angle)], 1)
    density = 1e3 * np.exp(-3 * radius)
    position = flat + (3.0, 2.0, 1.0)
    position[-1] = (3.0, 2.0, 500.0)
    return {
        "Coordinates": position,
        "Velocities": turning,
        "Masses": np.ones(count),
        "Density": density,
        "SmoothingLength": 0.1 + 0.3 * radius,
        "InternalEnergy": 1 + radius,
    }


def snapshot(path, columns, **header):
    """A Gadget-like file, with lengths in kpc."""
    with h5py.File(path, "w") as file:
        file.create_group("Header").attrs.update({"Time": 0.5, "MassTable": np.zeros(6), **header})
        for name, values in columns.items():
            file[f"PartType0/{name}"] = values
        scalings = {"length_scaling": 1.0, "mass_scaling": 0.0, "velocity_scaling": 0.0, "a_scaling": 0.0, "h_scaling": 0.0}
        file["PartType0/Coordinates"].attrs.update(scalings | {"to_cgs": KPC})
    return path


@pytest.fixture(scope="module")
def galaxy(tmp_path_factory):
    return snapshot(tmp_path_factory.mktemp("galaxy") / "disc.hdf5", disc())


def middle(camera, scene):
    """The place in the middle of the picture, at the depth of the disc."""
    forward = np.asarray(camera.axes, np.float64)[2]
    return camera.exact_eye() + forward * ((np.array([3.0, 2.0, 1.0]) - camera.exact_eye()) @ forward)


def test_with_no_options_the_disc_fills_the_picture(galaxy):
    scene, camera = js.io.read_scene(galaxy, size=SIZE)
    image = js.reference.render(scene, camera, SEEN)
    brightest = np.asarray(image.color).max(-1)
    rows, columns = np.nonzero(brightest > 24 / 255)
    assert max(np.ptp(rows) / SIZE[1], np.ptp(columns) / SIZE[0]) > 0.6
    assert np.percentile(brightest, 99) > 0.5
    assert np.abs(middle(camera, scene) - (3, 2, 1)).max() < 1.0
    assert scene.particles.extinction_quantity is None and scene.transfer.extinction_values is not None


def test_what_moves_along_the_line_of_sight_is_positive_away_from_the_camera(galaxy):
    position, velocity = disc()["Coordinates"], disc()["Velocities"]
    for view in ({"view": "x"}, {"view": "edge-on"}, {"eye": (9, 4, 2)}):
        scene, camera = js.io.read_scene(galaxy, color_by="velocity.los", size=SIZE, **view)
        sight = position - camera.exact_eye() if "eye" in view else np.asarray(camera.axes, np.float64)[2][None]
        expected = (velocity * sight).sum(1) / np.linalg.norm(sight, axis=1)
        found = scene.particles.to_numpy()["quantity"]  # the last lies far away, where only an eye that is placed may see it
        np.testing.assert_allclose(found, expected[: 3000 if "eye" in view else 2999], atol=2e-6)
        scene, _ = js.io.read_scene(galaxy, color_by="y", where="velocity.los > 0", size=SIZE, **view)
        assert scene.particles.num_particles == (expected[: 3000 if "eye" in view else 2999] > 0).sum()
    scene, camera = js.io.read_scene(galaxy, color_by="velocity.los", size=SIZE)  # not face-on, where next to nothing moves
    np.testing.assert_allclose(
        scene.particles.to_numpy()["quantity"], (velocity @ np.asarray(camera.axes, np.float64)[2])[:2999], atol=2e-6
    )
    with pytest.raises(ValueError, match="there is none; name x"):
        js.io.read_particles(galaxy, "velocity.los")


def test_the_line_of_sight_in_a_period_is_to_where_particles_are_shown(tmp_path):
    rng = np.random.default_rng(0)
    position, velocity = rng.uniform(0, 1, (60, 3)), rng.normal(size=(60, 3))
    columns = {"Coordinates": position, "Velocities": velocity, "Masses": np.ones(60), "SmoothingLength": np.full(60, 0.1)}
    path, eye = snapshot(tmp_path / "box.hdf5", columns, BoxSize=1.0), np.array([3.0, 0.4, 0.6])
    for center in ((0.0, 0.0, 0.0), (0.5, 0.5, 0.5)):
        moved = position - np.floor(position - center + 0.5)
        expected = (velocity * (moved - eye)).sum(1) / np.linalg.norm(moved - eye, axis=1)
        for where, kept in (None, position[:, 0] >= 0), ("x < 0.5", position[:, 0] < 0.5):
            scene, _ = js.io.read_scene(path, color_by="velocity.los", eye=eye, center=center, where=where, size=SIZE)
            np.testing.assert_allclose(scene.particles.exact_position()[: kept.sum()], moved[kept], atol=1e-6)
            np.testing.assert_allclose(scene.particles.to_numpy()["quantity"], expected[kept], atol=2e-6)
    scene, _ = js.io.read_scene(path, color_by="velocity.los", view="z", size=SIZE)
    np.testing.assert_allclose(scene.particles.to_numpy()["quantity"], -velocity[:, 2], atol=2e-6)


UPS = {"y is up": ("rho", 1), "z is up, as DualSPHysics has it": ("Rhop", 2), "z is up, as a liquid lies low": ("pool", 2)}


@pytest.mark.parametrize(("column", "k"), UPS.values(), ids=UPS)
@pytest.mark.parametrize("view", [{}, {"view": "x"}, {"eye": (9, 0.1, 0.2)}, {"up": (1, 0, 0)}])
def test_up_is_y_unless_the_kind_of_file_has_z_or_it_is_said(tmp_path, column, k, view):
    rng = np.random.default_rng(2)
    path = tmp_path / "table.csv"
    rows = rng.uniform(size=(60, 4)) ** (1, 1, 2 if column == "pool" else 1, 1)
    np.savetxt(path, rows, header=f"x,y,z,{column}", comments="", delimiter=",")
    opened = staged(load(path), view=View(size=SIZE, **view))
    up = np.eye(3)[0 if "up" in view else k]
    np.testing.assert_array_equal(opened.up, up)
    right, upright, ahead = np.asarray(opened.camera.axes, np.float64) @ up
    assert abs(right) < 1e-6 and upright > 0.7 and ahead < 0.1
    told = dict(opened.said).get("up", "")
    assert told.startswith("" if "up" in view else "yz"[k - 1]) and ("--up" in told) == ("up" not in view)


LIQUIDS = {
    "ParaView": ("Points:0,Points:1,Points:2,pressure,velocity:0,velocity:1,velocity:2", 1.0, ""),
    "DualSPHysics by ParaView": ("Points:0,Points:1,Points:2,Rhop,Vel:0,Vel:1,Vel:2", 1000.0, "Rhop"),
    "DualSPHysics": ("Pos.x [m],Pos.y [m],Pos.z [m],Rhop [kg/m^3],Vel.x [m/s],Vel.y [m/s],Vel.z [m/s]", 1000.0, "Rhop"),
}


@pytest.mark.parametrize("name", LIQUIDS)
@pytest.mark.parametrize("moves", [True, False])
def test_tables_of_liquids_are_surfaces_coloured_by_speed_with_their_density(tmp_path, name, moves):
    header, density, called = LIQUIDS[name]
    steps = 0.1 * np.stack(np.meshgrid(*[np.arange(7.0)] * 3), -1).reshape(-1, 3)
    rows = np.concatenate([steps, density + steps[:, :1], moves * steps], 1)
    np.savetxt(tmp_path / "water.csv", rows, header=header, comments="", delimiter=",")
    loaded = load(tmp_path / "water.csv")
    opened = staged(loaded, view=View(size=SIZE))
    assert opened.scene.surface is not None and loaded.quantity == "speed"
    said = dict(opened.said)
    assert "(speed)" in said["colours"] and "= -" not in said["colours"]
    assert not any("sum of kernels" in note for note in loaded.report.notes)
    if called:
        named = js.io.read_particles(tmp_path / "water.csv", quantity="density").to_numpy()["quantity"]
        np.testing.assert_allclose(named, rows[:, 3])


@pytest.mark.parametrize(
    ("present", "mass", "expected"),
    [((0, 1, 4), {}, 0), ((1, 2, 3), {1: 4.0, 2: 1.0, 3: 1.0}, 2), ((1, 2, 3), {1: 1.0, 2: 8.0, 3: 64.0}, 1), ((1, 2), {}, 1)]
    + [((1, 4), {1: 5.0}, 4), ((2, 3), {}, 2), ((1, 2, 4), {1: 1.0, 2: 8.0, 4: 0.1}, 4), ((1,), {}, 1)],
)
def test_what_shines_is_shown_before_haloes_and_coarse_dark_matter_is_not_taken_for_it(present, mass, expected):
    assert choose_type(present, None, mass=mass) == expected


def test_boundaries_of_dualsphysics_are_not_before_the_fluid(tmp_path):
    steps = 0.1 * np.stack(np.meshgrid(*[np.arange(5.0)] * 3), -1).reshape(-1, 3)
    kind = np.where(steps[:, :1] > 0.15, 3, 0)
    rows = np.concatenate([steps, 1000 + 0 * kind, kind, steps], 1)
    header = "Points:0,Points:1,Points:2,Rhop,Type,Vel:0,Vel:1,Vel:2"
    np.savetxt(tmp_path / "dam.csv", rows, header=header, comments="", delimiter=",")
    loaded = load(tmp_path / "dam.csv")
    assert loaded.shown.num_particles == 75 and any("Type == 3" in note for note in loaded.report.notes)
    assert load(tmp_path / "dam.csv", Source(where="Type >= 0")).shown.num_particles == 125


def test_what_is_flat_is_seen_face_on_and_a_map_is_light_first_on_white(tmp_path):
    random = np.random.default_rng(2)
    np.savez(tmp_path / "disc.npz", position=random.normal(size=(3000, 3)) * (3, 0.1, 3), density=1 + random.random(3000))
    opened = staged(load(tmp_path / "disc.npz"), view=View(size=SIZE))
    axes = np.asarray(opened.camera.axes)  # though what lies at random is tilted by a little
    assert "face-on" in dict(opened.said)["view"] and axes[2, 1] == -1 and axes[0, 0] == 1
    colors = np.asarray(opened.scene.transfer.colors).mean(1)
    turned, said = (opened := staged(load(tmp_path / "disc.npz"), Look(background="white"), View(size=SIZE))).scene, opened.said
    dense = np.asarray(turned.transfer.colors).mean(1)
    assert colors[0] < colors[-1] and dense[0] > dense[-1] and "light background" in dict(said)["colours"]


def test_a_disc_in_a_halo_a_hundred_times_as_large_is_what_is_seen(tmp_path):
    random = np.random.default_rng(4)
    away = random.normal(size=(2300, 3)) * (1, 1, 0.1)
    away[2000:] = 100 * random.normal(size=(300, 3))
    density = np.exp(-2 * np.linalg.norm(away, axis=1) ** 0.4)
    np.savez(tmp_path / "halo.npz", position=away, density=density, mass=np.ones(2300), support=np.cbrt(8 / density) / 9)
    scene, camera = js.io.read_scene(tmp_path / "halo.npz", size=SIZE)
    assert 2 * float(camera.half_height) < 20 and scene.particles.extinction_quantity is None


def test_what_was_chosen_is_said(galaxy):
    said = dict(staged(load(galaxy), view=View(size=SIZE)).said)
    assert "heat (density)" in said["colours"] and "log10:Density" in said["colours"]
    assert "of 3,000 particles lie outside of the picture" in said["frame"]


@pytest.mark.parametrize("view", ["x", "y", "z", "iso", "face-on", "edge-on"])
def test_a_width_is_that_of_the_picture_in_every_view(galaxy, view):
    scene, camera = js.io.read_scene(galaxy, center=(3, 2, 1), width="2 kpc", view=view, size=SIZE)
    away = np.linalg.norm(np.array([3, 2, 1]) - camera.exact_eye()) if camera.is_perspective else 1.0
    across = 2 * float(camera.half_height) * away * SIZE[0] / SIZE[1]
    assert across == pytest.approx(2.0, rel=1e-5)
    np.testing.assert_allclose(middle(camera, scene), (3, 2, 1), atol=1e-4)
    assert scene.within is not None


@pytest.mark.parametrize("view", ["z", "face-on", "iso"])
def test_depths_of_parallel_rays_are_those_of_the_picture_and_not_of_the_camera(galaxy, view):
    asked = {"center": (3, 2, 1), "width": 2, "view": view, "size": SIZE}
    scene, camera = js.io.read_scene(galaxy, **asked)
    framed = staged(load(galaxy), view=View(**asked)).camera
    assert (camera.near is None) == (camera.far is None) == (view != "iso")
    assert camera.near_and_far() == framed.near_and_far()
    np.testing.assert_array_equal(js.reference.render(scene, camera, SEEN).color, js.reference.render(scene, framed, SEEN).color)


def test_face_on_looks_along_the_axis_and_edge_on_across_it(galaxy):
    _, face = js.io.read_scene(galaxy, view="face-on", center="mass", size=SIZE)
    _, edge = js.io.read_scene(galaxy, view="edge-on", center="densest", size=SIZE)
    assert abs(float(face.axes[2, 1])) > 0.999
    assert abs(float(edge.axes[2, 1])) < 0.05 and abs(float(edge.axes[1, 1])) > 0.999


def test_the_densest_place_is_the_middle_of_the_disc(galaxy):
    scene, camera = js.io.read_scene(galaxy, center="densest", width=1.0, view="y", size=SIZE)
    assert np.abs(middle(camera, scene) - (3, 2, 1)).max() < 0.3


def test_clips_that_are_given_stand_instead_of_that_of_the_width(galaxy):
    everything, _ = js.io.read_scene(galaxy, center=(3, 2, 1), width=2, clips=(), size=SIZE)
    half, _ = js.io.read_scene(galaxy, clips=(js.Plane((3, 2, 1), (1, 0, 0)),), size=SIZE)
    assert everything.within is None and half.within is not None


def test_everything_is_in_the_frame_where_that_is_asked_for(galaxy):
    _, camera = js.io.read_scene(galaxy, frame_all=True, size=SIZE)
    view = (np.array([[3.0, 2.0, 500.0]]) - camera.exact_eye()) @ np.asarray(camera.axes, np.float64).T
    assert (np.abs(view[0, :2]) < view[0, 2] * float(camera.half_height) * np.array([1.5, 1])).all()


def test_named_opacity_over_decades_is_by_its_logarithm(galaxy):
    loaded = load(galaxy, Source(color_by="InternalEnergy", opacity_by="Density"))
    assert loaded.opacity_by == "log10:Density"
    np.testing.assert_allclose(
        np.asarray(loaded.shown.extinction_quantity)[:3000], np.log10(disc()["Density"]).clip(-30), rtol=1e-4, atol=1e-3
    )
    assert "logarithm of Density" in dict(loaded.said)["opacity"]
    assert load(galaxy, Source(opacity_by="InternalEnergy")).opacity_by in (None, "InternalEnergy")


def test_stops_of_exposure_double_extinction(galaxy):
    plain, _ = js.io.read_scene(galaxy, size=SIZE)
    brighter, _ = js.io.read_scene(galaxy, exposure=2, size=SIZE)
    np.testing.assert_allclose(brighter.transfer.extinction, 4 * np.asarray(plain.transfer.extinction), rtol=1e-6)


def test_a_transfer_function_that_is_given_stays_as_it_is(galaxy, tmp_path):
    look = js.TransferFunction.from_points([1, 4], [[1, 0, 0], [0, 0, 1]], [0.1, 2.0])
    look.save(tmp_path / "look.json")
    for given in (look, tmp_path / "look.json"):
        scene, _ = js.io.read_scene(galaxy, transfer=given, size=SIZE)
        np.testing.assert_allclose(scene.transfer.extinction, [0.1, 2.0], rtol=1e-6)
        assert scene.particles.extinction_quantity is None


def test_conditions_and_shares_choose_particles(galaxy):
    scene, _ = js.io.read_scene(galaxy, where="InternalEnergy < 2", size=SIZE)
    assert 0 < scene.particles.num_particles < 3000


def test_a_periodic_box_is_centred_where_it_is_asked_for(tmp_path):
    rng = np.random.default_rng(0)
    position = np.mod(0.05 * rng.normal(size=(800, 3)), 1.0)
    columns = {"Coordinates": position, "SmoothingLength": np.full(800, 0.05), "Density": np.ones(800), "Masses": np.ones(800)}
    path = snapshot(tmp_path / "box.hdf5", columns, BoxSize=1.0)
    for center in ((0.0, 0.0, 0.0), "mass", "densest"):
        scene, camera = js.io.read_scene(path, center=center, width=0.5, view="z", size=SIZE)
        assert np.abs((middle_of(scene) + 0.5) % 1 - 0.5).max() < 0.1
        assert np.asarray(js.reference.render(scene, camera, SEEN).alpha)[16, 24] > 0.5


@pytest.mark.parametrize("view", [{}, {"view": "z"}, {"view": "x", "width": 0.7}])
def test_matter_across_the_faces_of_a_box_is_shown_in_one_piece(tmp_path, view):
    """Wherever its middle is, the picture is the same."""
    rng = np.random.default_rng(5)
    away = 0.01 * rng.normal(size=(400, 3))
    pictures = []
    for nth, middle in enumerate(((0.4, 0.55, 0.5), (0.0, 0.55, 0.99), (0.5, 0.0, 0.5))):
        columns = {"SmoothingLength": np.full(400, 0.02), "Density": np.ones(400), "Masses": np.ones(400)}
        path = snapshot(tmp_path / f"{nth}.hdf5", {"Coordinates": np.mod(away + middle, 1.0), **columns}, BoxSize=1.0)
        scene, camera = js.io.read_scene(path, size=SIZE, **view)
        moved = [not np.allclose(low, 0) for low in scene.particles.bounds()[0]]
        assert moved == [[False] * 3, [True, False, True], [False, True, False]][nth]
        pictures.append(glimpse(scene, camera).picture())
        np.testing.assert_allclose(pictures[nth], pictures[0], atol=0.05)
    assert (pictures[0].max(-1) > 0.05).mean() > (0.002 if "width" in view else 0.1)


@pytest.mark.parametrize("given", [{"eye": (0.5, 0.5, 3.0)}, {"clips": (js.Box((0.9, 0, 0), (1.0, 1, 1)),)}, {"filled": True}])
def test_a_box_stays_where_a_place_in_it_is_said_and_where_it_is_filled(tmp_path, given):
    filled, rng = given.pop("filled", False), np.random.default_rng(5)
    position = rng.uniform(size=(400, 3)) if filled else np.mod(0.01 * rng.normal(size=(400, 3)), 1.0)
    columns = {"SmoothingLength": np.full(400, 0.05), "Density": np.ones(400), "Masses": np.ones(400)}
    path = snapshot(tmp_path / "box.hdf5", {"Coordinates": position, **columns}, BoxSize=1.0)
    scene, _ = js.io.read_scene(path, size=SIZE, **given)
    np.testing.assert_array_equal(scene.particles.bounds(), [np.zeros(3), np.ones(3)])


def middle_of(scene):
    lower, upper = scene.particles.bounds()
    return (lower + upper) / 2


def test_a_volume_is_framed_and_exposed(tmp_path):
    values = np.zeros((24, 24, 24), np.float32)
    values[6:12, 6:12, 6:12] = np.random.default_rng(0).random((6, 6, 6)) + 0.5
    np.save(tmp_path / "scan.npy", values)
    scene, camera = js.io.read_scene(tmp_path / "scan.npy", size=SIZE)
    alpha = np.asarray(js.reference.render(scene, camera, SEEN).alpha)
    assert np.percentile(alpha, 99) > 0.8 and (alpha > 0.1).mean() > 0.2


BAD = [
    ({"width": 0}, "`width` must be > 0"), ({"width": "3 furlongs"}, "furlongs"), ({"width": "3 K"}, "does not agree"),
    ({"width": "wide"}, "`width` must be a length"), ({"center": (0, 0, 1e9)}, "outside of everything"),
    ({"center": "middle"}, "`center` must be x, y and z"), ({"view": "top"}, "`view` must be one of"),
    ({"target": (0, 0, 0)}, "`target` needs `eye`"), ({"eye": (9, 9, 9), "width": 3}, "exclude each other"),
    ({"view": "x", "fov_degrees": 30}, "parallel"), ({"frame_all": True, "width": 3}, "exclude each other"),
    ({"norm": "logarithmic"}, "`norm` must be one of"), ({"range": (3, 1)}, "ascend"), ({"exposure": 99}, "stops"),
    ({"optical_depth": -1}, "`optical_depth` must be > 0"), ({"support": -1}, "`support` must be > 0"),
    ({"where": "InternalEnergy > 1e9"}, "no particle"), ({"color_by": "Temperatur"}, "there is no quantity"),
]  # fmt: skip


@pytest.mark.parametrize(("options", "told"), BAD)
def test_what_makes_no_sense_is_refused_by_name(galaxy, options, told):
    with pytest.raises(ValueError, match=told):
        js.io.read_scene(galaxy, **options)


def test_an_option_that_there_is_not_is_named(galaxy):
    with pytest.raises(TypeError, match=r"'colour_by'; there are color_by.*; did you mean color_by\?"):
        js.io.read_scene(galaxy, colour_by="viridis")
    with pytest.raises(TypeError, match=r"`read_particles` has no argument `part_typ`; .*; did you mean part_type\?"):
        js.io.read_particles(galaxy, part_typ=0)


def test_a_transfer_function_and_a_colour_map_exclude_each_other():
    with pytest.raises(ValueError, match="leave out `colormap`"):
        Look(transfer="look.json", colormap="viridis")


def test_lengths_with_units_are_converted_by_what_the_file_states():
    unit = CodeUnit(KPC, LENGTH)
    assert length_of("3 Mpc", "width", unit)[0] == pytest.approx(3000, rel=1e-3)
    assert length_of("30kpc", "width", unit)[0] == pytest.approx(30, rel=1e-3)
    assert length_of("2.5e1", "width", None) == (25.0, None)
    with pytest.raises(ValueError, match="does not state"):
        length_of("3 Mpc", "width", None)


def test_types_share_a_picture_each_with_its_look_and_move_with_their_period(tmp_path):
    columns = {**disc(50), "Coordinates": 2 + 0.02 * disc(50)["Coordinates"]}
    path = snapshot(tmp_path / "box.hdf5", columns, BoxSize=16.0)
    with h5py.File(path, "a") as file:
        file["PartType4/Coordinates"] = np.array([[15.5, 8, 8], [0.5, 8, 8]])
        file["PartType4/Masses"] = np.ones(2)
    scene, _ = js.io.read_scene(path, part_type="gas:ice,stars:red", center=(0, 8, 8), size=SIZE)
    np.testing.assert_allclose(scene.points[0].exact_position()[:2, 0], [-0.5, 0.5])
    np.testing.assert_array_equal(scene.points[0].color[0], [1, 0, 0])
    np.testing.assert_array_equal(scene.transfer.colors, js.io.read_scene(path, colormap="ice", size=SIZE)[0].transfer.colors)
    assert "2 of stars, as marks" in dict(load(path, Source(part_type="gas,stars")).said)["beside"]
    assert len(load(path, Source(part_type="gas,stars"), Look(surface_of="Masses")).beside) == 1


def test_particles_that_share_places_are_drawn_as_one_and_told(tmp_path):
    rng = np.random.default_rng(7)
    places = rng.uniform(0, 1, (12, 3))
    np.savez(tmp_path / "piled.npz", position=np.repeat(places, 50, 0), mass=np.ones(600), heat=rng.uniform(0, 1, 600))
    loaded = load(tmp_path / "piled.npz", Source(color_by="heat"))
    opened = staged(loaded, Look(), View(size=SIZE))
    said = dict(opened.said)
    assert opened.scene.particle_set.num_particles == 12 and loaded.report.num_particles == loaded.shown.num_particles == 600
    assert said["places"].startswith("600 particles share 12 places: ") and "drawn as one" in said["places"]
