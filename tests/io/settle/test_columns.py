"""Promises of named columns: whatever holds them, the particles are those of the same numbers."""

import numpy as np
import pytest
from refusals import refused

import jaxsph as js
from jaxsph.io.settle.columns import particles_from_columns

COUNT = 90
RNG = np.random.default_rng(11)
POSITION = RNG.uniform(0, 1, (COUNT, 3))
H, RHO = RNG.uniform(0.1, 0.2, COUNT), RNG.uniform(1, 3, COUNT)
VELOCITY = RNG.normal(size=(COUNT, 3))
X, Y, Z = POSITION.T
FLAT = {"x": X, "y": Y, "z": Z, "h": H, "rho": RHO, "mass": RHO / COUNT, **dict(zip(("vx", "vy", "vz"), VELOCITY.T, strict=True))}
EXPECTED = js.Particles.from_arrays(POSITION, 2 * H, RHO)


def same(found, expected=EXPECTED, but=("volume",)):
    for name, value in expected.to_numpy().items():
        if name not in but:
            np.testing.assert_allclose(found.to_numpy()[name], value, rtol=1e-6, err_msg=name)


def structured():
    made = np.zeros(COUNT, [("Coordinates", "f8", 3), ("SmoothingLength", "f4"), ("Density", "f8"), ("name", "U3")])
    made["Coordinates"], made["SmoothingLength"], made["Density"] = POSITION, H, RHO
    return made


class Lazy:
    """A snapshot that has columns as attributes, and lists none."""

    coordinates, smoothing_lengths, densities = POSITION, H, RHO

    def masses(self):
        raise AssertionError("a method is no column")


class OnDemand(dict):
    """A snapshot that loads columns when they are asked for."""

    def loadable_keys(self):
        return ["pos", "smooth", "rho", "broken"]

    def __getitem__(self, name):
        return {"pos": POSITION, "smooth": H, "rho": RHO}[name]


SOURCES = {
    "dictionary": (FLAT, "rho"),
    "positions": ({"pos": POSITION, "hsml": H[:, None], "density": RHO, "label": ["a"] * COUNT}, "density"),
    "structured": (structured(), "Density"),
    "attributes": (Lazy(), "densities"),
    "on demand": (OnDemand(), "rho"),
}


@pytest.mark.parametrize("source", SOURCES)
def test_columns_are_found_in_whatever_holds_them(source):
    columns, name = SOURCES[source]
    same(js.Particles.from_columns(columns, quantity=name, support_in_h=2))


def test_data_frames_are_columns():
    pandas = pytest.importorskip("pandas")
    frame = pandas.DataFrame(FLAT | {"name": ["gas"] * COUNT}, index=np.arange(COUNT) + 7)
    same(js.Particles.from_columns(frame, quantity="rho", support_in_h=2))
    chosen = js.Particles.from_columns(frame, quantity="speed", support=0.3, where="rho > 2")
    np.testing.assert_allclose(chosen.to_numpy()["quantity"], np.linalg.norm(VELOCITY, axis=1)[RHO > 2], rtol=1e-6)


@pytest.mark.parametrize(("quantity", "expected"), [("log10:rho", np.log10(RHO)), (X * 2, 2 * X), ("x", X)])
def test_quantities_are_named_derived_or_given(quantity, expected):
    found = js.Particles.from_columns(FLAT, quantity=quantity, opacity_by="rho", support=0.3)
    np.testing.assert_allclose(found.to_numpy()["quantity"], expected, rtol=1e-5)
    np.testing.assert_allclose(np.asarray(found.extinction_quantity)[:COUNT], RHO, rtol=1e-6)


def test_supports_are_given_named_or_of_neighbours():
    with_column = FLAT | {"support": 3 * H}
    for given, expected in (({"support": 0.3}, 0.3), ({"support": 3 * H}, 3 * H), ({"support": "h"}, H), ({}, 3 * H)):
        found = js.Particles.from_columns(with_column, quantity="rho", **given)
        np.testing.assert_allclose(found.to_numpy()["support"], np.broadcast_to(expected, COUNT), rtol=1e-6)
    named = js.Particles.from_columns(FLAT | {"own": H}, quantity="rho", support="own", support_in_h=1.5)
    np.testing.assert_allclose(named.to_numpy()["support"], 1.5 * H, rtol=1e-6)
    bare, report = particles_from_columns({"pos": POSITION, "a": RHO}, quantity="a")
    assert "spacings" in report.support and len(bare) == COUNT


def test_volumes_are_columns_too_one_number_stands_for_all_and_a_box_makes_them_periodic():
    found = js.Particles.from_columns({"pos": POSITION, "volume": RHO, "a": 2.0}, quantity="a", support=0.3, box=1.0)
    columns = found.to_numpy()
    np.testing.assert_allclose(columns["volume"] / columns["volume"][0], RHO / RHO[0], rtol=1e-5)
    assert (columns["quantity"] == 2).all() and found.box is not None


def test_lengths_are_converted_to_the_unit_of_positions():
    unyt = pytest.importorskip("unyt")
    columns = {
        "pos": unyt.unyt_array(POSITION, "kpc"),
        "h": unyt.unyt_array(H * 1000, "pc"),
        "rho": unyt.unyt_array(RHO, "g/cm**3"),
    }
    found = js.Particles.from_columns(columns, quantity="rho", support_in_h=2)
    same(found)
    assert found.length_unit == "kpc"
    flat = {"x": unyt.unyt_array(X, "kpc"), "y": unyt.unyt_array(Y * 1000, "pc"), "z": Z, "rho": RHO}
    same(js.Particles.from_columns(flat, quantity="rho", support=unyt.unyt_array(2000 * H, "pc")))
    with pytest.raises(ValueError, match="`h` is in s, which cannot be converted to kpc"):
        js.Particles.from_columns(columns | {"h": unyt.unyt_array(H, "s")}, quantity="rho", support_in_h=2)


@pytest.mark.parametrize(
    ("columns", "given", "said"),
    [
        (FLAT, {}, "column `h` is a smoothing length.*`support_in_h=2`"),
        ({"a": RHO}, {}, "`columns` must hold positions.*there are a"),
        ({"x": X, "y": Y}, {}, "nor x, y and z"),
        ({"x": X, "y": Y[:5], "z": Z}, {}, "`x`, `y` and `z` must have one length, got 5, 90"),
        ({"pos": X}, {}, r"`pos` must have shape \(N, 3\)"),
        ({"pos": POSITION, "a": RHO[:4]}, {"support": 1.0}, "column `a` has 4 rows, but there are 90"),
        ({"pos": POSITION, "a": RHO}, {"support": "b"}, "`support` must be numbers, or the name of a column, got 'b'"),
        ({"pos": POSITION, "a": RHO}, {"support_in_h": 2}, "needs a column of smoothing lengths"),
        (FLAT, {"support": 0.3, "support_in_h": 2}, "`support_in_h` = 2 is for a column"),
        (FLAT, {"support": 0.3, "quantity": "nope"}, "nope"),
        (3.5, {}, "`columns` must have columns by name.*float"),
        (np.zeros((4, 3)), {}, "`columns` must have columns by name.*ndarray"),
    ],
)
def test_what_cannot_be_settled_is_refused_by_name(columns, given, said):
    refused(said, js.Particles.from_columns, columns, **given)
