"""Points of files: which columns are radius, colour and strength, what may be said instead, and what is refused."""

import jax.numpy as jnp
import numpy as np
import pytest
from refusals import refused

import jaxsph as js
from jaxsph.io import ParticleTable, points_from_table, read_points
from jaxsph.io.settle.points import glow

HEADER = "x,y,z,radius,r,g,b,opacity"
ROWS = ["0,1,2,0.5,1,0.5,0,0.25", "3,4,5,1.5,0,0,0.25,0.75"]
PLACES = np.arange(6, dtype=np.float32).reshape(2, 3)


@pytest.fixture
def stars(tmp_path):
    """`stars(header, *rows)`: a CSV file."""

    def write(header=HEADER, *rows):
        path = tmp_path / "stars.csv"
        path.write_text("\n".join([header, *(rows or ROWS)]) + "\n")
        return path

    return write


def opacity(points):
    """Through the centre of Gaussian points."""
    return -np.expm1(-np.asarray(points.extinction * points.radius, np.float64) * 2 * 0.4166435)[np.asarray(points.valid)]


def table(**columns):
    return ParticleTable(PLACES, {name: np.asarray(column) for name, column in columns.items()})


def test_a_csv_of_all_columns_is_read_as_it_is(stars):
    points = read_points(stars())
    assert points.num_points == 2
    np.testing.assert_array_equal(points.position[:2], PLACES)
    np.testing.assert_array_equal(points.radius[:2], [0.5, 1.5])
    np.testing.assert_array_equal(points.color[:2], [(1, 0.5, 0), (0, 0, 0.25)])
    np.testing.assert_allclose(opacity(points), [0.25, 0.75], rtol=1e-5)


@pytest.mark.parametrize("name", ["a.npz", "polydata.vtk", "a.vtu", "ascii.ply", "plain.bgeo", "points.hdf5", "a.csv", "a.xyz"])
def test_every_format_of_particles_is_one_of_points(written, samples, name):
    points = read_points(written / name, radius=0.25, color="density" if name != "a.xyz" else None, extinction=2)
    particles = samples.particles()
    np.testing.assert_array_equal(points.exact_position()[: len(particles.position)], particles.position)
    assert points.num_points == len(particles.position) and float(points.radius[0]) == 0.25 and float(points.extinction[0]) == 2


def test_types_of_particles_are_asked_for_by_number_and_by_name(tmp_path, samples):
    path = tmp_path / "snapshot.hdf5"
    samples.write_gadget_hdf5(path, samples.particles())
    for kind in (0, "0", "gas"):
        assert read_points(path, part_type=kind).num_points == 7  # the radius is the support
    refused("no particles of type 5", read_points, path, part_type=5)
    refused("no particles of type 4", read_points, path, part_type="stars")
    refused("did you mean stars", read_points, path, part_type="strs")
    refused("one type of particles, without a look", read_points, path, part_type="gas,stars")


def test_what_glows_has_its_mass_in_its_columns_and_few_are_marks():
    rng = np.random.default_rng(0)
    place, mass = rng.normal(size=(4000, 3)), rng.uniform(1, 3, 4000)
    many = ParticleTable(place, {"mass": mass})
    made, told = glow(many, "stars", "inferno", place)
    strength = np.asarray(made.extinction * made.radius**3)[:4000]
    np.testing.assert_allclose(strength / strength.mean(), mass / mass.mean(), rtol=1e-5)
    assert "inferno" in told and len(np.unique(np.asarray(made.color)[:4000], axis=0)) > 100
    marks, told = glow(table(h=[0.0, 5.0]), "sinks", "#ff0000", place)
    assert told == "as marks" and float(marks.radius[0]) > 0.03 and float(marks.radius[1]) == 5
    refused("colormap", glow, many, "stars", "nothing", place)


@pytest.mark.parametrize("name", ["radius", "Radius", "rad", "r", "size", "smoothing_length", "hsml", "h"])
def test_radii_go_by_many_names(name):
    points, report = points_from_table(table(**{name: [1.0, 2.0]}))
    np.testing.assert_array_equal(points.radius[:2], [1, 2])
    assert name in report.radius and report.radius_range == (1, 2)
    red = {"r": [0.5, 1.0], "g": [0.0, 0.0], "b": [0.0, 0.0]}  # beside green and blue
    refused("has no radius", points_from_table, table(**red))
    points, report = points_from_table(table(**red, size=[3.0, 4.0]))
    np.testing.assert_array_equal(points.radius[:2], [3, 4])
    np.testing.assert_array_equal(points.color[:2, 0], [0.5, 1])
    assert report.color == "columns `r`, `g`, `b`"


@pytest.mark.parametrize(
    "columns",
    [
        {"red": [255, 0], "green": [51, 0], "blue": [0, 102]},
        {"red": np.array([255.0, 0]), "green": np.array([51.0, 0]), "blue": np.array([0, 102.0])},
        {"Color": np.array([(255, 51, 0), (0, 0, 102)], np.uint8)},
        {"RGBA": np.array([(1, 0.2, 0, 1), (0, 0, 0.4, 1)])},
    ],
)
def test_colours_are_numbers_up_to_one_or_bytes(columns):
    points, _ = points_from_table(table(**columns), radius=1)
    np.testing.assert_allclose(points.color[:2], [(1, 0.2, 0), (0, 0, 0.4)], rtol=1e-6)
    for dark, largest in ((np.ones((2, 3)), 1), (np.ones((2, 3), np.uint8), 1 / 255)):  # bytes where the file says so
        np.testing.assert_allclose(points_from_table(table(color=dark), radius=1)[0].color.max(), largest)


def test_any_quantity_is_shown_by_a_colour_map():
    data = table(mass=[1.0, 2.0], velocity=np.array([(3.0, 0, 4), (0, 0, 0)]))
    low, high = js.scenes.colormap("heat")[[0, -1]]
    for name, first, last in (("mass", low, high), ("log10:mass", low, high), ("speed", high, low), ("velocity.x", high, low)):
        points, report = points_from_table(data, radius=1, color=name, colormap="heat")
        np.testing.assert_allclose(points.color[:2], [first, last], atol=1e-3)
        assert report.color.startswith("heat over " + name)


def test_what_is_said_overrides_the_file(stars):
    points = read_points(stars(), radius=2, color=(0, 1, 0), extinction="radius")
    np.testing.assert_array_equal(points.radius[:2], [2, 2])
    np.testing.assert_array_equal(points.color[:2], [(0, 1, 0)] * 2)
    np.testing.assert_array_equal(points.extinction[:2], [0.5, 1.5])
    np.testing.assert_allclose(opacity(read_points(stars(), opacity=0.5)), 0.5, rtol=1e-5)
    np.testing.assert_allclose(opacity(read_points(stars(), opacity="r", radius=[1, 2])), [0.999, 0], rtol=1e-5)


def test_where_nothing_says_points_are_white_and_nearly_opaque_and_the_report_says_so():
    points, report = points_from_table(table(), radius=1)
    assert (np.asarray(points.color) == 1).all()
    np.testing.assert_allclose(opacity(points), 0.8, rtol=1e-5)
    assert len(report.notes) == 1 and "neither extinction nor opacity is there: 0.8 through the centre" in report.notes[0]
    assert all(said in str(report) for said in ("2 points", "radius    1 .. 1: given by the caller", "white", "0.8", "note"))


def test_opacities_of_one_are_nearly_one():
    points, report = points_from_table(table(alpha=np.array([255, 51], np.uint8)), radius=1)
    np.testing.assert_allclose(opacity(points), [0.999, 0.2], rtol=1e-4)
    assert report.notes == ("opacities above 0.999 are taken for 0.999",)
    assert not points_from_table(table(extinction=[3.0, 4.0], opacity=[0.5, 1.0]), radius=1)[1].notes


def test_a_function_reads_the_scalar_columns_as_attributes():
    def profile(offset, attributes):
        return jnp.exp(-attributes["age"])

    points, _ = points_from_table(table(age=[5.0, 6.0], radius=[1.0, 1.0]), extinction=1, profile=profile)
    assert set(points.attributes) == {"age"} and points_from_table(table(age=[5.0, 6.0]), radius=1)[0].attributes == {}


REFUSED = [
    ({}, {}, "has no radius of its points: there are positions alone; give `radius=NUMBER` .:radius=R., or the name"),
    ({"mass": [1.0, 2.0]}, {}, "has no radius of its points: there are mass; give"),
    ({"radius": [1.0, np.nan]}, {}, "column `radius` must be finite, but 1 of 2 values are not, the first at index 1: nan"),
    ({"radius": [0.0, 1.0]}, {}, "`radius` must be finite and positive, but 1 of 2 values are not, the first at index 0: 0"),
    ({"mass": [1.0, 2.0]}, {"radius": "size"}, "`radius`: there is no column 'size': there are mass; choose one of them"),
    ({"mass": [1.0, 2.0]}, {"radius": "density"}, "`radius`: there is no column 'density'"),
    ({"v": PLACES}, {"radius": "v"}, "`radius`: 'v' has 3 components; choose one: v.x"),
    ({}, {"radius": -1}, "`radius` must be finite and positive, but 2 of 2 values are not, the first at index 0: -1"),
    ({}, {"radius": [1, 2, 3]}, "`radius` must be a number, one for each of shape .2,. or the name of a column"),
    ({"r": [2.5, 0], "g": [0, 0], "b": [0, 0]}, {"radius": 1}, r"column `r, g, b` must be .* whole .* index 0: \[2.5, 0"),
    ({"color": PLACES - 1}, {"radius": 1}, r"column `color` must be in \[0, 1\], or whole numbers .* index 0: \[-1"),
    ({"color": PLACES * np.nan}, {"radius": 1}, "column `color` must be finite, .* the first at index 0"),
    ({"color": PLACES * 1000}, {"radius": 1}, r"index 0: \[0\.0, 1000"),
    ({}, {"radius": 1, "color": (2, 0, 0)}, r"`color` must be in \[0, 1\]"),
    ({"m": [1.0, 2]}, {"radius": 1, "color": "m", "colormap": "nope"}, "`colormap` must be one of viridis"),
    ({"opacity": [0.5, -0.5]}, {"radius": 1}, "column `opacity` must be in"),
    ({"opacity": [0.5, np.nan]}, {"radius": 1}, "column `opacity` must be finite, .* index 1"),
    ({"extinction": [0.5, -0.5]}, {"radius": 1}, r"`extinction` must be >= 0, but extinction\[1\] = -0.5"),
    ({}, {"radius": 1, "opacity": 1}, r"`opacity` must be in \[0, 1\)"),
    ({}, {"radius": 1, "opacity": 0.5, "extinction": 1}, "two names for one thing"),
]


@pytest.mark.parametrize(("columns", "asked", "match"), REFUSED)
def test_what_is_no_point_is_refused_by_name(columns, asked, match):
    refused(match, points_from_table, table(**columns), **asked)


def test_refusals_name_the_file_and_a_file_of_names_alone_is_an_empty_set(stars):
    path = stars("x,y,z,mass", "1,2,3,4")
    refused(rf"{path}: has no radius of its points: there are mass", read_points, path)
    refused(
        r"stars.csv: column `radius` must be finite, .* index 1: nan", read_points, stars("x,y,z,radius", "1,2,3,4", "1,2,3,nan")
    )
    path.write_text(HEADER + "\n")
    assert read_points(path).num_points == 0


def test_places_far_away_are_kept(stars):
    points = read_points(stars("x,y,z,radius", "1000000.1,0,0.001,0.01"))
    np.testing.assert_allclose(points.exact_position()[0], (1000000.1, 0, 0.001), rtol=0, atol=1e-9)
