import dataclasses

import jax
import numpy as np
import pytest
from refusals import refused

import jaxsph.io as io
from jaxsph.io.settle import assemble, supports
from jaxsph.io.settle.assemble import chosen
from jaxsph.io.table import ParticleTable

position = np.random.default_rng(0).random((50, 3))
density = np.linspace(1, 2, 50)


def there(values):
    """Those of the fifty particles; what is behind them fills the capacity."""
    return values[:50]


def test_the_tables_support_and_volume_are_used_where_it_has_them():
    table = ParticleTable(
        position, {"a": density}, support=np.full(50, 0.5), volume=np.full(50, 0.25), conventions=("support = s",)
    )
    particles, report = io.particles_from_table(table)
    np.testing.assert_array_equal(there(particles.support), np.full(50, 0.5, np.float32))
    np.testing.assert_array_equal(there(particles.volume), np.full(50, 0.25, np.float32))
    assert report.support == "support = s" and report.support_range == (0.5, 0.5)


def test_a_given_support_overrides_the_tables_and_may_differ_between_particles_but_not_in_number():
    table = ParticleTable(position, support=np.full(50, 0.5), conventions=("support = s",))
    for given in (0.125, density):
        particles, report = io.particles_from_table(table, "x", given)
        np.testing.assert_allclose(there(particles.support), np.broadcast_to(given, 50), rtol=1e-6)
        assert report.support == "given by the caller" and "support = s" not in report.notes
    for bad in (0, -1, np.nan, np.inf):
        refused("`support` must be finite and positive", io.particles_from_table, table, "x", bad)
    refused(r"shape \(50,\) .*, got float64 of shape \(3,\)", io.particles_from_table, table, "x", np.ones(3))


def test_without_support_the_nearest_neighbours_give_it_where_particles_cluster():
    clustered = position**4
    particles, report = io.particles_from_table(ParticleTable(clustered), "x")
    np.testing.assert_allclose(there(particles.support), io.nearest_neighbour_supports(clustered), rtol=1e-6)
    assert report.support == "distance to neighbour 32"


def test_without_support_particles_that_lie_evenly_have_one_of_two_spacings():
    lattice = np.stack(np.meshgrid(*[np.arange(5.0)] * 3), -1).reshape(-1, 3)
    splash = np.array([[2.0, 2.0, 40.0]])
    particles, report = io.particles_from_table(ParticleTable(np.concatenate([lattice, splash])), "x")
    np.testing.assert_allclose(particles.to_numpy()["support"], 2.0, rtol=1e-6)
    assert report.support == "2 spacings of 1, as particles lie evenly"


def test_a_few_particles_are_seen_one_by_one():
    few = position[:20] ** 4
    particles, report = io.particles_from_table(ParticleTable(few), "x")
    np.testing.assert_allclose(particles.to_numpy()["support"], 0.025 * np.ptp(few, axis=0).max(), rtol=1e-5)
    assert report.support == "2.5 % of their extent, as 20 are fewer than the 32 neighbours of a support"


def test_smoothing_lengths_that_differ_are_of_particles_of_several_sizes():
    coarse = np.stack(np.meshgrid(*[np.arange(5.0)] * 3), -1).reshape(-1, 3)
    fine = np.stack(np.meshgrid(*[np.arange(0, 5, 0.5)] * 3), -1).reshape(-1, 3) - (5, 0, 0)
    both, sizes = np.concatenate([fine, coarse]), np.repeat([0.5, 1.0], [len(fine), len(coarse)])
    particles, report = io.particles_from_table(ParticleTable(both, {"h": sizes}), "x")
    support = particles.to_numpy()["support"]
    assert np.median(support[len(fine) :]) > 1.5 * np.median(support[: len(fine)]) and not report.evenly
    assert io.particles_from_table(ParticleTable(both, {"h": np.ones(len(both))}), "x")[1].evenly


def test_the_volume_is_mass_over_density_where_both_are_there():
    particles, report = io.particles_from_table(ParticleTable(position, {"Masses": 3 * density, "rho": density}), "x", 0.5)
    np.testing.assert_allclose(there(particles.volume), 3, rtol=1e-6)
    assert report.volume == "Masses / rho"


def test_the_volume_is_the_inverse_kernel_sum_where_density_is_missing_or_not_positive():
    for columns in ({}, {"mass": density}, {"mass": density, "density": np.append(density[1:], 0)}):
        particles, report = io.particles_from_table(ParticleTable(position, columns), "x", 0.5, "cubic_spline")
        expected = 1 / io.kernel_sum(position, 0.5, kernel="cubic_spline")
        np.testing.assert_allclose(there(particles.volume), expected, rtol=1e-5)
        assert report.volume.startswith("1 / sum of kernels")


def test_a_summed_density_weighs_with_the_masses():
    table = ParticleTable(position, {"mass": density})
    particles, report = io.particles_from_table(table, "density", 0.5)
    np.testing.assert_allclose(there(particles.quantity), io.kernel_sum(position, np.full(50, 0.5), density), rtol=1e-6)
    assert "density = sum of kernels times mass" in report.notes


def test_read_particles_passes_every_choice_on(samples, tmp_path):
    samples.write_gadget_binary(tmp_path / "a.gadget", samples.particles(), dark=3)
    particles = io.read_particles(str(tmp_path / "a.gadget"), quantity="z", support=0.25, kernel="wendland_c2", part_type=1)
    assert particles.num_particles == 3 and particles.kernel == "wendland_c2"
    np.testing.assert_array_equal(particles.support, [0.25] * 3)


def test_positions_that_float32_has_moved_are_noted_and_those_that_it_has_destroyed_refused():
    _, report = io.particles_from_table(ParticleTable((position + 1e4).astype(np.float32)), "x", 0.1)
    assert any("float32 has rounded positions" in note for note in report.notes)
    destroyed = ParticleTable((position + 1e10).astype(np.float32))
    refused(r"positions reach 1e\+10.*subtract a common offset", io.particles_from_table, destroyed, "x", 0.1)


@pytest.mark.parametrize("double", [False, True])
def test_float64_positions_far_from_the_origin_are_kept_whole(double):
    with jax.enable_x64(double):
        particles, report = io.particles_from_table(ParticleTable(position + 1e10), "x", 0.1)
        assert report.notes == () and particles.dtype == (np.float64 if double else np.float32)
        np.testing.assert_allclose(there(particles.exact_position()), position + 1e10, rtol=0 if double else 2.0**-48)


def test_volumes_beyond_float32_are_scaled_and_keep_their_ratios():
    table = ParticleTable(position * 1e10, volume=density * 1e50)
    particles, _ = io.particles_from_table(table, "x")
    np.testing.assert_allclose(there(particles.volume) / particles.volume[0], density, rtol=1e-6)


def test_one_particle_is_enough_and_of_none_there_is_a_report_that_cannot_be_changed():
    particles, report = io.particles_from_table(ParticleTable(np.ones((1, 3))))
    assert particles.num_particles == 1 and "single particle" in report.support
    particles, report = io.particles_from_table(ParticleTable(np.zeros((0, 3))))
    assert particles.num_particles == 0 and "nan" in str(report)
    with pytest.raises(dataclasses.FrozenInstanceError):
        report.quantity = "z"


def gas(decades):
    """Fifty particles whose stored densities span so many decades."""
    rho = 10 ** np.linspace(0, decades, 50)
    return ParticleTable(position, {"rho": rho, "temperature": density, "mass": np.ones(50)}, support=np.full(50, 0.5))


def test_opacity_is_by_log_density_where_densities_spread_over_a_decade():
    particles, report = io.particles_from_table(gas(3), "temperature", opacity_by="auto")
    assert report.opacity_by == "log10:rho" and "opacity   by log10:rho" in str(report)
    np.testing.assert_allclose(there(particles.extinction_quantity), np.linspace(0, 3, 50), atol=1e-6)
    np.testing.assert_allclose(there(particles.quantity), density, rtol=1e-6)
    refused(r"no quantity 'dust'; there are rho", io.particles_from_table, gas(3), opacity_by="dust")
    clustered = ParticleTable(np.linspace(0.01, 1, 50)[:, None] ** 4 * (1, 1, 1), {"rho": 1 + density / density.max()})
    assert io.particles_from_table(clustered, opacity_by="auto")[1].opacity_by is None  # by what would be looked up


@pytest.mark.parametrize(
    ("decades", "quantity", "wanted", "told"),
    [(0.5, "temperature", "auto", None), (3, "temperature", None, None), (3, "log10:rho", "auto", "log10:rho")],
)
def test_opacity_is_by_the_quantity_itself_of_fluids_and_unless_asked_for(decades, quantity, wanted, told):
    particles, report = io.particles_from_table(gas(decades), quantity, opacity_by=wanted)
    assert particles.extinction_quantity is None and report.opacity_by == told


def test_values_that_have_no_logarithm_are_told_with_their_number():
    values, log = density - 1.25, {"opacity_by": "log10:a"}
    table, none = ParticleTable(position, {"a": values}, support=np.full(50, 0.5)), values <= 0
    for name, more, count in (
        ("log10: a", {}, none.sum()), ("a", log, none.sum()), ("log10:a", {"where": "a > -0.1"}, (none & (values > -0.1)).sum()),
        ("log10:a", {"where": "a > 0"}, 0), ("a", {}, 0), ("log10:density", {}, 0),
    ):  # fmt: skip
        told = [note for note in io.particles_from_table(table, name, **more)[1].notes if "least" in note]
        assert [note.partition(" > 0: their logarithm")[0] for note in told] == [f"{count} values of a are not"] * bool(count)


@pytest.mark.parametrize("name", ["support", "box"])
def test_lengths_with_a_unit_are_refused_as_a_file_has_its_own(name):
    unyt = pytest.importorskip("unyt")
    length = unyt.unyt_array([400.0, 400, 400] if name == "box" else 400.0, "pc")
    with pytest.raises(ValueError, match=rf"`{name}` is in pc, but lengths are numbers in the unit of the file"):
        io.particles_from_table(ParticleTable(position), **{name: length})
    with pytest.raises(ValueError, match=r"`radius` is in pc, but lengths are numbers in the unit of the file"):
        io.points_from_table(ParticleTable(position), radius=unyt.unyt_quantity(400, "pc"))


@pytest.mark.parametrize(("text", "factor"), [("2*h", 2), ("h", 1), ("h*3 - h", 2), ("max(h, 0*h) / 0.5", 2), ("`my h`*2", 4)])
def test_a_given_support_may_be_an_expression_of_columns(text, factor):
    table = ParticleTable(position, {"h": density, "my h": 2 * density}, support=np.full(50, 0.5))
    particles, report = io.particles_from_table(table, "x", text)
    np.testing.assert_allclose(there(particles.support), factor * density, rtol=1e-6)
    assert report.support == f"{text}, given by the caller"
    particles, _ = io.particles_from_table(table, "x", "support*2", where="x > 0.5")
    np.testing.assert_array_equal(particles.to_numpy()["support"], 1.0)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("k*2", "no quantity 'k'"), ("h*", "at its end"), ("h > 1", "not a number"), ("h - 1.5", "finite and positive, .* -0.5"),
        ("", "is empty"), ("__import__('os')", "functions are"),
    ],
)  # fmt: skip
def test_an_expression_that_gives_no_supports_is_refused(text, said):
    refused(rf"`support`.*{said}", io.particles_from_table, ParticleTable(position, {"h": density}), "x", text)


def clustered(count=2000):
    rng = np.random.default_rng(3)
    return (
        rng.uniform(0, 9, (40, 3))[rng.integers(0, 40, count)]
        + rng.normal(0, 0.2, (count, 3)) * rng.uniform(0, 2, (count, 1)) ** 3
    )


@pytest.fixture
def asked(monkeypatch):
    """How many particles were asked for their neighbours, at a time."""
    counts, slices = [0], supports._slices

    def counted(pairs, *more):
        counts.append(len(pairs))
        return slices(pairs, *more)

    monkeypatch.setattr(supports, "_slices", counted)
    return counts


@pytest.mark.parametrize("quantity", ["x", "density", "log10:density"])
@pytest.mark.parametrize("where", [None, "x > 3", "density > 1"])
def test_a_share_is_drawn_before_neighbours_are_found(asked, quantity, where):
    table = ParticleTable(clustered(), {"mass": np.linspace(1, 2, 2000)})
    particles, report = io.particles_from_table(table, quantity, share=0.05, where=where)
    assert 0 < max(asked) <= 100 and "for a quick look" in " ".join(report.notes)
    inside = 2000 if where is None else (table.position[:, 0] > 3).sum()
    assert particles.num_particles == round(0.05 * inside) or where == "density > 1"
    asked[:] = [0]
    rows = chosen(table, quantity, share=0.05, where=where)
    assert max(asked) <= 100 and rows.stands_for == pytest.approx(20, rel=0.02)
    columns = particles.to_numpy()
    np.testing.assert_array_equal(rows.position.astype(np.float32), columns["position"])
    for name in ("support", "volume"):
        np.testing.assert_allclose(getattr(rows, name), columns[name], rtol=1e-6)


def test_each_of_a_share_stands_for_as_many():
    held = {"mass": np.ones(2000), "rho": np.ones(2000)}
    given = {"support": np.full(2000, 0.5), "volume": np.full(2000, 0.3)}
    table = ParticleTable(clustered(), held, **given, conventions=("support = as said",))
    particles, report = io.particles_from_table(table, "mass", share=0.125)
    columns = particles.to_numpy()
    np.testing.assert_allclose(columns["volume"].sum(), 600, rtol=1e-5)
    np.testing.assert_allclose(columns["support"], 1.0, rtol=1e-6)
    assert (columns["quantity"] == 1).all() and "2 times as far as in the file" in report.support
    assert "has the mass and the volume of 8" in " ".join(report.notes)
    own = io.particles_from_table(table, "mass", 0.25, share=0.125)[0].to_numpy()["support"]
    np.testing.assert_allclose(own, 0.25)
    lattice = np.stack(np.meshgrid(*[np.arange(10.0)] * 3), -1).reshape(-1, 3)
    even, report = io.particles_from_table(ParticleTable(lattice), "x", share=0.125)
    np.testing.assert_allclose(even.to_numpy()["support"], 4.0, rtol=1e-5)
    assert report.evenly
    dense = [io.particles_from_table(ParticleTable(lattice), "density", share=share)[0].to_numpy() for share in (None, 0.125)]
    assert np.median(dense[1]["quantity"]) == pytest.approx(np.median(dense[0]["quantity"]), rel=0.2)


def test_a_glance_has_what_some_particles_have_among_all(asked, monkeypatch):
    monkeypatch.setattr(assemble, "GLANCED", 60)
    table = ParticleTable(clustered(), {"mass": np.linspace(1, 2, 2000)})
    some, report = io.particles_from_table(table, "density", effort="glance")
    assert max(asked) == 60 and "a glance at 60 of 2,000 particles" in " ".join(report.notes)
    whole, few = (made.to_numpy() for made in (io.particles_from_table(table, "density")[0], some))
    rows = [int(np.flatnonzero((whole["position"] == place).all(1))[0]) for place in few["position"]]
    for name, column in few.items():
        np.testing.assert_allclose(column, whole[name][rows], rtol=1e-6, err_msg=name)


def test_a_share_has_those_of_given_supports_that_are_its_own():
    radii = np.linspace(0.1, 0.2, 2000)
    table = ParticleTable(clustered(), {"h": radii})
    for given in (radii, "2*h / 2"):
        columns = io.particles_from_table(table, "h", given, share=0.1)[0].to_numpy()
        np.testing.assert_allclose(columns["support"], columns["quantity"], rtol=1e-6)


def test_a_file_says_that_particles_share_places():
    lattice = np.stack(np.meshgrid(*[np.linspace(0, 2, 9)] * 3), -1).reshape(-1, 3)
    notes = io.particles_from_table(ParticleTable(np.repeat(lattice[:20], 30, 0)), "x")[1].notes
    assert "600 particles share 20 places" in notes
    assert not any("share" in note for note in io.particles_from_table(ParticleTable(lattice), "x")[1].notes)


def test_rounding_that_makes_particles_share_places_is_told():
    lattice = np.stack(np.meshgrid(*[np.linspace(0, 4, 9)] * 3), -1).reshape(-1, 3)
    notes = io.particles_from_table(ParticleTable((lattice + 1e7).astype(np.float32)), "x", 6.0)[1].notes
    assert any("729 particles share 125 places, as float32 holds" in note and "write them in float64" in note for note in notes)


def test_supports_of_one_place_alone_are_told():
    report = io.particles_from_table(ParticleTable(np.full((40, 3), 3.0)), "x")[1]
    assert report.support == "1, as all particles are at one place" and "40 particles share 1 place" in report.notes
